"""Recognition and cost of each descriptor: the table of reports/descriptor/notes.

Run as `python -m eval.studies.descriptors.compare FAMILY... --seeds A:B --out DIR`. Each pair of sessions is simulated,
measured (`eval.studies.descriptors.rows`) and removed. The program writes DIR/rows/<family>-<seed>.json for each pair,
from which an interrupted run continues; DIR/descriptors.csv, one row for each pair, descriptor and precision; and
DIR/places.csv and DIR/spheres.csv, means over session pairs with 95 % intervals. Nothing is tuned with it.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Int64Array
from cdpipe.core.threads import THREADS
from cdpipe.descriptors import checkpoint_digest, list_checkpoints, sphere_digest, use_threads
from cdpipe.model.config import load_config
from eval.core.domains import domain_of
from eval.core.output import make_writable, remove
from eval.core.provenance import digest, git_commit, machine
from eval.core.statistics import interval_over_tunnels, mean, median
from eval.core.terminal.exits import run_program
from eval.core.terminal.progress import RunProgress, shown_progress
from eval.plans.seeds import parse_seeds_option
from eval.plans.worlds import world_slug
from eval.report.render import write_file
from eval.running.runfolder import read_json, write_json
from eval.studies.descriptors.rows import METHODS, SPHERE, measure_pair
from eval.tables.rows import numbers, tunnels_of
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario
from sim.session.simulate import simulate_pair
from sim.session.truth import read_pair_truth

_FAMILIES = ("narrow", "wide", "network")
_SEEDS = "10300:10304"  # of the validation seeds
_VERSION = 2  # of a row; raised when its figures change, so that stored rows are measured again


def measure(
    families: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    progress: RunProgress,
    settings: Sequence[str] = (),
    *,
    keep: bool = False,
) -> pd.DataFrame:
    """Return one row for each pair, descriptor and precision; stored pairs are not measured again.

    Args:
        families: Names or files of scenarios.
        seeds: Seeds of each family.
        out: Folder of the run.
        progress: Receives each pair and stage.
        settings: Over those of `tunnelcd`, e.g. `sphere.weights=mine/sphere.safetensors`.
        keep: Keep the simulated pairs, in `out`/pairs.

    Raises:
        ScenarioError: A world cannot be drawn or built.
        InputError: `out` cannot be written, or a setting is wrong.
    """
    config = load_config("tunnelcd", settings)
    if config.regions.source != "sphere":
        raise InputError(
            f"--set: regions.source = {config.regions.source}: expected sphere, which is what is measured here"
        )
    list_checkpoints(config)
    make_writable(out)
    use_threads(THREADS)
    todo = [(family, seed, load_scenario(family, seed)) for seed in seeds for family in families]
    rows = []
    for done, (family, seed, scenario) in enumerate(todo):
        progress.cells(f"{family} {seed}", done, len(todo))
        path = out / "rows" / f"{world_slug(family)}-{seed}.json"
        key = _key(scenario, seed, settings)
        document = read_json(path)
        if document.get("key") != key or not _are_rows(document.get("rows")):
            pair = out / "pairs" / path.stem
            if not _is_made_of(pair, scenario, seed):  # of another world, or cut short
                remove(pair)
            try:
                if not pair.exists():
                    pair.parent.mkdir(parents=True, exist_ok=True)
                    simulate_pair(scenario, seed, pair, on_progress=progress.stage)
                progress.stage("describe", 0, 1)
                measured = measure_pair(pair, settings)
            finally:
                if not keep:
                    remove(pair)
            own = [{"family": family, "seed": seed, **row} for row in measured]
            document = {"key": key, "commit": git_commit(), "machine": machine(), "rows": own}
            write_json(path, document)
        rows += document["rows"]
    progress.cells("done", len(todo), len(todo))
    return pd.DataFrame(rows)


def _is_made_of(pair: Path, scenario: Scenario, seed: int) -> bool:
    try:
        truth = read_pair_truth(pair)
    except InputError:
        return False
    is_same = digest(truth.scenario) == digest(scenario.model_dump(mode="json"))
    return is_same and truth.seed == seed and truth.files == file_digests(scenario)


def _are_rows(rows: Any) -> bool:
    """Tell whether stored rows are rows; others are measured again."""
    return isinstance(rows, list) and all(isinstance(row, dict) for row in rows)


def _key(scenario: Scenario, seed: int, settings: Sequence[str]) -> str:
    config = load_config("tunnelcd", settings)
    # the scores do not depend on these settings of the query, nor on where a file of weights lies
    unused = {"query": {"threshold", "n_regions", "suppression"}, "descriptor": {"weights"}}
    return digest(
        {
            "version": _VERSION,
            "scenario": scenario.model_dump(mode="json"),
            "files": file_digests(scenario),
            "seed": seed,
            "config": config.model_dump(
                mode="json", include={"map", "descriptor", "merge", "regions", "query"}, exclude=unused
            ),
            "checkpoints": [
                checkpoint_digest(config.descriptor.model_copy(update={"method": method})) for method in METHODS
            ],
            "sphere": sphere_digest(config.sphere),
            "frames": config.sphere.frames,
        }
    )


_PAIR = ["family", "seed"]


def tabulate_places(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what each descriptor of scans recognises, by group.

    Returns:
        `place_recall_at_1` and `yaw_flip_share`, means over pairs, and `yaw_error_deg`, the median over pairs of each
        pair's median, all with `_low` and `_high`; `n_pairs`, `n_places` that were asked for; `bytes_per_keyframe`,
        the pose included; `ms_per_keyframe`, the median over pairs.
    """
    table = []
    for group, own in _groups(rows[rows["descriptor"] != SPHERE]):
        for (descriptor, precision), cases in own.groupby(["descriptor", "precision"], sort=False):
            yaws_deg = numbers(cases, "yaw_error_deg")
            low, high = interval_over_tunnels(yaws_deg, _tunnels(cases), "median")
            table.append(
                {
                    "group": group,
                    "descriptor": descriptor,
                    "precision": precision,
                    **_mean(cases, "place_recall_at_1"),
                    "yaw_error_deg": median(yaws_deg),
                    "yaw_error_deg_low": low,
                    "yaw_error_deg_high": high,
                    **_mean(cases, "yaw_flip_share"),
                    "n_pairs": len(cases),
                    "n_places": int(cases["n_places"].sum()),
                    **_price(cases),
                }
            )
    return pd.DataFrame(table)


def tabulate_spheres(rows: pd.DataFrame) -> pd.DataFrame:
    """Return what `sphere` finds in each precision, by group.

    Returns:
        `region_auroc`, mean over the pairs that have one (`n_used` of `n_pairs`), with `_low` and `_high`;
        `auroc_loss` against float32, mean over the same pairs, with `_low` and `_high`, and the largest of any pair;
        `n_refused` pairs whose merge was; `map_over_kept`, the bytes of the thinned before map over those kept of it,
        median over pairs, and `map_over_kept_least`; price as in `tabulate_places`.
    """
    table = []
    for group, own in _groups(rows[rows["descriptor"] == SPHERE]):
        exact = own[own["precision"] == "float32"].set_index(_PAIR)["region_auroc"]
        for precision, cases in own.groupby("precision", sort=False):
            loss = exact - cases.set_index(_PAIR)["region_auroc"]
            ratio = numbers(cases, "map_bytes_per_keyframe") / numbers(cases, "bytes_per_keyframe")
            table.append(
                {
                    "group": group,
                    "precision": precision,
                    **_mean(cases, "region_auroc"),
                    **_mean(loss.rename("auroc_loss").reset_index(), "auroc_loss"),
                    "auroc_loss_most": float(loss.max()),
                    "n_pairs": len(cases),
                    "n_used": int(cases["region_auroc"].notna().sum()),
                    "n_refused": int((cases["status"] != "ok").sum()),
                    "map_over_kept": median(ratio),
                    "map_over_kept_least": float(ratio.min()),
                    **_price(cases),
                }
            )
    return pd.DataFrame(table)


def _groups(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for family, own in rows.groupby("family", sort=False):
        yield str(family), own
    domains = rows["family"].map(domain_of)
    for domain in ("in", "out"):
        own = rows[domains == domain]
        if own["family"].nunique() > 1:
            yield f"all {domain} of distribution" if domain == "out" else "all in distribution", own


def _mean(cases: pd.DataFrame, column: str) -> dict[str, float]:
    values = numbers(cases, column)
    low, high = interval_over_tunnels(values, _tunnels(cases))
    value = mean(values)
    return {column: value, f"{column}_low": low, f"{column}_high": high}


def _tunnels(cases: pd.DataFrame) -> Int64Array:
    return tunnels_of(cases.assign(scenario=cases["family"]))


def _price(cases: pd.DataFrame) -> dict[str, Any]:
    return {
        "bytes_per_keyframe": int(cases["bytes_per_keyframe"].iloc[0]),
        "ms_per_keyframe": median(numbers(cases, "ms_per_keyframe")),
    }


def main(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="new folder, or of an earlier run to continue")],
    families: Annotated[
        list[str] | None, typer.Argument(metavar="FAMILY...", help="names from `tunnelcd list`, or .yaml files")
    ] = None,
    seeds: Annotated[str, typer.Option(metavar="A:B", help="B excluded")] = _SEEDS,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="one setting; may be repeated")
    ] = None,
    keep: Annotated[bool, typer.Option("--keep", help="keep the simulated pairs, about 0.3 GB each")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False,
) -> None:
    """Measure every descriptor on simulated pairs."""
    with shown_progress(quiet, "pairs") as progress:
        rows = measure(families or _FAMILIES, parse_seeds_option(seeds), out, progress, settings or (), keep=keep)
    tables = {"descriptors": rows, "places": tabulate_places(rows), "spheres": tabulate_spheres(rows)}
    for name, table in tables.items():
        write_file(out / f"{name}.csv", table.to_csv(index=False))
    command = shlex.join(["python", "-m", "eval.studies.descriptors.compare", *sys.argv[1:]])
    write_file(out / "command.txt", f"{command}\n")
    for name in ("places", "spheres"):
        typer.echo(tables[name].to_string(index=False, float_format="{:.4g}".format, na_rep="-") + "\n")


if __name__ == "__main__":
    run_program(main, "eval.studies.descriptors.compare")
