"""Score of the sphere descriptor by its size, its training data and the precision of its numbers.

Run as `python -m eval.studies.descriptors.curves DATA --out DIR`, where DATA is a folder of `tunnelcd dataset` with
tunnels of both splits. The program trains one network after another at a shorter schedule than the shipped one: without
early stopping, with the weights of the last step, so that the validation tunnels only calibrate. It measures the
shipped network as well. It writes DIR/curves.csv, a row for each network and precision, and DIR/curves.png after every
network; the same command resumes an interrupted run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import process_time
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
import typer
from torch import Tensor

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import BoolArray, Float64Array, Int64Array, stream
from cdpipe.core.ranking import auroc
from cdpipe.descriptors import use_threads
from cdpipe.descriptors.sphere_network import (
    SphereNetwork,
    SphereSize,
    load_trained_sphere_network,
    make_untrained_sphere_network,
)
from cdpipe.training.data import TunnelShard, open_dataset
from cdpipe.training.fit import FitConfig, fit
from cdpipe.training.shard import read_shard
from cdpipe.training.sphere_training import SphereData, SphereTask, local_scores, pool_within_reach, read_sphere_data
from eval.core.figures import picture, png
from eval.core.output import make_writable
from eval.core.statistics import mean
from eval.core.tablefile import read_table
from eval.core.terminal.exits import run_program
from eval.report.render import write_file
from eval.studies.descriptors.curve_plots import curves_chart
from eval.tables.rows import records
from eval.training.training_run import data_digest

FLOAT_BITS = 32
BITS = (FLOAT_BITS, 8, 4, 2)
SHIPPED = "shipped"
DRAW = 1  # of each keyframe: the first draw is merged exactly


@dataclass(frozen=True, slots=True)
class Point:
    """One network to train.

    Attributes:
        size: Of the network.
        share: Of the training tunnels of each family that it sees.
        seed: Of weights, draws and the choice of tunnels.
    """

    size: SphereSize = field(default_factory=SphereSize)
    share: float = 1.0
    seed: int = 0

    @property
    def name(self) -> str:
        """Return what it is called in the table."""
        head = "image" if self.size.reads_after else "numbers"
        return f"{self.size.numbers}-{head}-width{self.size.width:g}-data{self.share:g}-seed{self.seed}"


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Tunnels to measure on.

    Attributes:
        data: Their keyframes.
        families: (T,) family of each tunnel.
        centroids: (C, 3) of their observable changes, world frame, metres.
        change_tunnels: (C,) tunnel of each.
    """

    data: SphereData
    families: npt.NDArray[np.str_]
    centroids: Float64Array
    change_tunnels: Int64Array


def read_held_out(tunnels: Sequence[TunnelShard]) -> HeldOut:
    """Read tunnels into memory.

    Raises:
        InputError: A shard is missing or damaged.
    """
    centroids = []
    for tunnel in tunnels:
        arrays, _ = read_shard(tunnel.path, ("change_centroid_world", "change_is_observable"))
        centroids.append(arrays["change_centroid_world"][arrays["change_is_observable"]])
    return HeldOut(
        read_sphere_data(tunnels),
        np.array([tunnel.family for tunnel in tunnels]),
        np.concatenate(centroids),
        np.repeat(np.arange(len(tunnels)), [len(own) for own in centroids]),
    )


def rounded(spheres: Tensor, bits: int) -> Tensor:
    """Return descriptors in (-1, 1) as that many bits keep them.

    32 as they are, 8 as 127ths (`descriptor.precision: int8`), fewer as the middle of one of 2^bits equal cells.
    """
    if bits == FLOAT_BITS:
        return spheres
    if bits == 8:
        return torch.round(spheres * 127.0).div(127.0)
    n_cells = 2**bits
    cell = torch.floor((spheres + 1.0) * (n_cells / 2)).clamp(max=n_cells - 1)
    middle: Tensor = (cell + 0.5) * (2 / n_cells) - 1.0
    return middle


def measures(network: SphereNetwork, held: HeldOut, bits: int = FLOAT_BITS) -> dict[str, float]:
    """Return what a calibrated network reaches on all tunnels, and `NAME_FAMILY` the same on each family.

    Args:
        network: Its calibration is used as it is.
        held: Where.
        bits: Of each stored number.

    Returns:
        `log_likelihood` of a keyframe's label; `auroc` of the keyframes, the mean over tunnels; `unchanged_above_0`
        and `changes_found`, shares; `n_unchanged` and `n_changes`, which they are shares of.
    """
    data = held.data
    local = network.calibrate(torch.from_numpy(local_scores(network, data, DRAW, partial(rounded, bits=bits)))).numpy()
    log_odds = pool_within_reach(local, data)
    is_found = _found(local, held)
    found = _of_group(log_odds, data, is_found, np.ones(len(log_odds), np.bool_))
    for family in np.unique(held.families):
        of_family = held.families == family
        own = _of_group(log_odds, data, is_found[of_family[held.change_tunnels]], of_family[data.tunnels])
        found |= {f"{name}_{family}": value for name, value in own.items()}
    return found


def _found(local: Float64Array, held: HeldOut) -> BoolArray:
    """Return (C,) which changes have a keyframe above 0 within the score radius of their centroid."""
    data, found = held.data, np.zeros(len(held.centroids), np.bool_)
    for index, (centroid, tunnel) in enumerate(zip(held.centroids, held.change_tunnels, strict=True)):
        distances_m = np.linalg.norm(data.positions - centroid, axis=1)
        found[index] = (local[(data.tunnels == tunnel) & (distances_m <= data.score_radius_m)] >= 0).any()
    return found


def _of_group(log_odds: Float64Array, data: SphereData, is_found: BoolArray, is_member: BoolArray) -> dict[str, float]:
    is_used = is_member & (data.labels >= 0)
    is_positive = data.labels == 1
    surprise = np.logaddexp(0.0, np.where(is_positive, -log_odds, log_odds))
    by_tunnel = [
        auroc(log_odds[mask], is_positive[mask])
        for mask in (is_used & (data.tunnels == tunnel) for tunnel in np.unique(data.tunnels[is_used]))
    ]
    is_unchanged = is_used & ~is_positive
    return {
        "log_likelihood": -mean(surprise[is_used]),
        "auroc": mean(np.array(by_tunnel)),
        "unchanged_above_0": mean(log_odds[is_unchanged] >= 0),
        "changes_found": mean(is_found),
        "n_unchanged": int(is_unchanged.sum()),
        "n_changes": len(is_found),
    }


def points(n_seeds: int) -> list[Point]:
    """Return all networks to train, in the order in which they are: what matters first, then its spread over seeds."""
    base = SphereSize()
    others: list[tuple[SphereSize, float]] = [
        (SphereSize(per_sector=8), 1.0),
        (SphereSize(per_sector=1), 1.0),
        (SphereSize(reads_after=False), 1.0),
        (base, 0.25),
        (base, 0.5),
        (SphereSize(width=0.5), 1.0),
        (SphereSize(per_sector=2), 1.0),
        (SphereSize(width=2.0), 1.0),
        (base, 0.125),
        (SphereSize(per_sector=8, reads_after=False), 1.0),
        (SphereSize(per_sector=1, reads_after=False), 1.0),
        (SphereSize(per_sector=2, reads_after=False), 1.0),
    ]
    seeds = range(n_seeds)
    return [Point(seed=seed) for seed in seeds] + [Point(size, share, seed) for seed in seeds for size, share in others]


def select_share(tunnels: Sequence[TunnelShard], share: float, seed: int) -> list[TunnelShard]:
    """Return that share of the tunnels of each family, one at least; a larger share holds all of a smaller one."""
    kept: set[int] = set()
    for family in sorted({tunnel.family for tunnel in tunnels}):
        own = [index for index, tunnel in enumerate(tunnels) if tunnel.family == family]
        order = stream(seed, "descriptor-curves", family).permutation(len(own))
        kept |= {own[place] for place in order[: max(1, round(share * len(own)))]}
    return [tunnel for index, tunnel in enumerate(tunnels) if index in kept]


def trained(
    point: Point, tunnels: Sequence[TunnelShard], held: HeldOut, steps: int, folder: Path, data: str
) -> SphereNetwork:
    """Train one network, calibrated on the held-out tunnels; one that lies in `folder` already is taken from there."""
    network = make_untrained_sphere_network(point.seed, point.size)
    task = SphereTask(network, read_sphere_data(tunnels), held.data, point.seed)
    config = FitConfig(seed=point.seed, steps=steps, validate_every=steps)
    make_writable(folder)
    fit(task, config, folder, f"{point.name} {data}", lambda *_: None, lambda _: None)
    task.finish()
    return network


def make_rows(network: SphereNetwork, held: HeldOut, about: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each precision of the stored numbers."""
    sizes = asdict(network.size) | {
        "numbers": network.size.numbers,
        "n_weights": sum(weight.numel() for weight in network.parameters()),
    }
    return [
        {**about, **sizes, "bits": bits, "bytes": network.size.numbers * bits // 8, **measures(network, held, bits)}
        for bits in BITS
    ]


def read_rows(path: Path, run: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of an earlier call, none where there was none.

    Raises:
        InputError: The table is damaged, or of other data or another number of steps.
    """
    if not path.is_file():
        return []
    try:
        table = read_table(path)
        is_same = all((table[name] == value).all() for name, value in run.items())
    except (InputError, ValueError, KeyError) as error:
        raise InputError(f"{path}: damaged ({error}): remove it; networks that were trained are kept") from error
    if not is_same:
        raise InputError(f"{path}: of other data or another number of steps: name another --out")
    return records(table)


def main(
    data: Annotated[Path, typer.Argument(help="folder of `tunnelcd dataset`")],
    out: Annotated[Path, typer.Option("--out", help="folder for curves.csv, curves.png and the networks")],
    steps: Annotated[int, typer.Option(min=1, help="number of training steps")] = 600,
    seeds: Annotated[int, typer.Option(min=1, help="training seeds of each network")] = 3,
) -> None:
    """Train networks of many sizes, measure them, and draw their scores."""
    use_threads(1)
    make_writable(out)
    training, validation = open_dataset(data, "train"), open_dataset(data, "validation")
    digests = f"{data_digest(training)} {data_digest(validation)}"
    run = {"data": digests, "run_steps": steps}
    held, path = read_held_out(validation), out / "curves.csv"
    rows = read_rows(path, run)
    for point in [None, *points(seeds)]:
        name = point.name if point else SHIPPED
        if any(row["point"] == name for row in rows):
            continue
        began = process_time()
        if point is None:
            network, of_point = load_trained_sphere_network()[0], dict.fromkeys(("share", "seed", "tunnels"), np.nan)
        else:
            own = select_share(training, point.share, point.seed)
            network = trained(point, own, held, steps, out / "networks" / name, digests)
            of_point = {"share": point.share, "seed": point.seed, "tunnels": len(own)}
        cpu_s = round(process_time() - began, 1)
        found = make_rows(network, held, {"point": name, **run, **of_point, "cpu_s": cpu_s})
        rows += found
        table = pd.DataFrame(rows)
        write_file(path, table.to_csv(index=False, float_format="%.5g"))
        write_file(path.with_suffix(".png"), png(picture(curves_chart(table))))
        typer.echo(f"{name}: log-likelihood {found[0]['log_likelihood']:.4f}, AUROC {found[0]['auroc']:.4f}")


if __name__ == "__main__":
    run_program(main, "eval.studies.descriptors.curves")
