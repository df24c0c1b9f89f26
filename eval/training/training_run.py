"""Trains a descriptor on the folder of `tunnelcd dataset`: checkpoint, model card, curves as CSV and as a plot."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from cdpipe.core.errors import InputError
from cdpipe.core.whole_file import whole_file
from cdpipe.descriptors import use_threads
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.devices import find_device
from cdpipe.descriptors.network import make_untrained_network
from cdpipe.descriptors.sphere_network import SphereNetwork, make_untrained_sphere_network
from cdpipe.descriptors.weights_file import digest, numbered_checkpoint_bytes
from cdpipe.training.change_training import ChangeTask
from cdpipe.training.data import TunnelShard, open_dataset, read_place_data
from cdpipe.training.fit import FitConfig, Progress, Task, fit
from cdpipe.training.scan_training import PlaceTask
from cdpipe.training.sphere_training import SphereTask, read_sphere_data
from eval.core.charts import BLUE, VERMILLION, Axis, Drawing, Look, Panel, Series
from eval.core.figures import picture, png
from eval.core.output import make_writable, only_writer
from eval.core.provenance import git_commit
from eval.core.terminal.progress import RunProgress

SOURCES = {
    "sphere": "what the map around a keyframe looks like, 64 numbers (cdpipe.descriptors.sphere_network)",
    "3deg": "re-implementation of 3DEG, arXiv 2210.07285 (cdpipe.descriptors.network)",
    "range-net": "which pixels of two range images have changed (cdpipe.descriptors.change_network)",
}


def train_descriptor(
    data: Path,
    out: Path,
    name: str,
    config: FitConfig,
    threads: int,
    command: str,
    progress: RunProgress,
    device: str = "cpu",
) -> tuple[Path, dict[str, Any]]:
    """Train one descriptor on the tunnels of split train; those of split validation decide when to stop.

    Args:
        data: Folder of `tunnelcd dataset` with tunnels of both splits.
        out: Folder for NAME.safetensors, NAME.json, curves.csv, curves.png and the state to resume from.
        name: Which descriptor of `SOURCES`.
        config: Seed, steps, rates, patience.
        threads: Of torch.
        command: What to write into the card.
        progress: Told of every step.
        device: `cpu` or `cuda`, where the network computes.

    Returns:
        The checkpoint and the content of its model card.

    Raises:
        InputError: The folder lacks a split, is damaged, `out` holds another run, or no GPU can be used.
    """
    if (out / "dataset.json").exists():
        raise InputError(f"{out}: holds training data, and weights among them would be taken for it: name a new folder")
    own = {"state.safetensors", "curves.csv", "curves.png", f"{name}.json", f"{name}.safetensors"}
    if others := sorted({path.name for path in out.glob("[!.]*")} - own):
        raise InputError(f"{out}: holds {others[0]}, which is of no training of {name}: name a new folder")
    use_threads(threads)
    place = find_device(device)
    tunnels = open_dataset(data, "train"), open_dataset(data, "validation")
    digests = tuple(data_digest(part) for part in tunnels)
    task = _make_task(name, *tunnels, config.seed)
    task.network.to(place)
    make_writable(out)
    with only_writer(out, "tunnelcd train"):
        before = task.scores()
        latest: list[Progress] = []

        def on_step(step: int, losses: Mapping[str, float]) -> None:
            told = ", ".join(f"{part} {value:.3f}" for part, value in losses.items())
            scored = next(iter(latest[-1].scores.items())) if latest else None
            told += f"; {scored[0]} {scored[1]:.4f}" if scored else ""
            progress.cells(told, step, config.steps)

        def on_validation(done: Progress) -> None:
            latest.append(done)
            rows = [{"step": each.step, **each.losses, **each.scores, "is_best": each.is_best} for each in latest]
            with whole_file(out / "curves.csv") as partial:
                pd.DataFrame(rows).to_csv(partial, index=False, lineterminator="\r\n")

        # another number of threads or another device adds in another order, and gives other weights
        computed_by = [f"{threads} threads", *([device] if device != "cpu" else [])]
        identity = " ".join([name, *digests, *computed_by])
        history = fit(task, config, out, identity, on_step, on_validation)
        draw_curves(out / "curves.png", name, history)
        task.network.to("cpu")
        finished = task.finish()
        content = numbered_checkpoint_bytes(task.network)
        best = next(done for done in reversed(history) if done.is_best)
        card = {
            "descriptor": f"{name}: {SOURCES[name]}",
            "checkpoint": digest(content),
            **({"network": asdict(task.network.size)} if isinstance(task.network, SphereNetwork) else {}),
            "data": _described(tunnels[0], digests[0]),
            "validation": {
                **_described(tunnels[1], digests[1]),
                "trained": _rounded(best.scores),
                "untrained": _rounded(before),
                **({"calibration": _rounded(finished)} if finished else {}),
            },
            "settings": asdict(config),
            "best_step": best.step,
            "steps_done": history[-1].step,
            "losses": _rounded(history[-1].losses),
            "command": command,
            "commit": git_commit(),
            "device": _describe_device(place, threads),
            "seconds": round(history[-1].seconds, 1),
        }
        checkpoint = out / f"{name}.safetensors"
        with whole_file(checkpoint) as partial:
            partial.write_bytes(content)
        with whole_file(out / f"{name}.json") as partial:
            partial.write_text(json.dumps(card, indent=1) + "\n")
        return checkpoint, card


def data_digest(tunnels: Sequence[TunnelShard]) -> str:
    """Return the digest of the shards' bytes, in the order of family and seed."""
    hasher = hashlib.sha256()
    for tunnel in sorted(tunnels, key=lambda tunnel: (tunnel.family, tunnel.seed)):
        hasher.update(hashlib.sha256(tunnel.path.read_bytes()).digest())
    return hasher.hexdigest()[:16]


def draw_curves(path: Path, name: str, history: Sequence[Progress]) -> None:
    """Draw the loss and the deciding score over the steps."""
    score = next(iter(history[0].scores))
    drawn = {
        "loss on the training tunnels": (BLUE, [sum(done.losses.values()) for done in history]),
        f"{score} on the validation tunnels": (VERMILLION, [done.scores[score] for done in history]),
    }
    steps = [done.step for done in history]
    panels = [
        Panel(Axis(f"training step of {name}"), Axis(title), [Series(steps, values, Look(colour))])
        for title, (colour, values) in drawn.items()
    ]
    with whole_file(path) as partial:
        partial.write_bytes(png(picture(Drawing([panels], 240))))


def _make_task(name: str, training: Sequence[TunnelShard], validation: Sequence[TunnelShard], seed: int) -> Task:
    if name == "sphere":
        network = make_untrained_sphere_network(seed)
        return SphereTask(network, read_sphere_data(training), read_sphere_data(validation), seed)
    if name == "range-net":
        pixels = read_sphere_data(training), read_sphere_data(validation)
        return ChangeTask(make_untrained_change_network(seed), *pixels, seed)
    return PlaceTask(make_untrained_network(seed), read_place_data(training), read_place_data(validation), seed)


def _name_ranges(seeds: Sequence[int]) -> str:
    """Return seeds as ranges, ends excluded: `3:5, 50:51`."""
    numbers = np.unique(seeds)
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{part[0]}:{part[-1] + 1}" for part in parts)


def _described(tunnels: Sequence[TunnelShard], data_digest: str) -> dict[str, Any]:
    seeds = [tunnel.seed for tunnel in tunnels]
    n_tunnels = len({(tunnel.family, tunnel.seed) for tunnel in tunnels})
    return {
        "families": sorted({tunnel.family for tunnel in tunnels}),
        "seeds": _name_ranges(seeds),
        "n_tunnels": n_tunnels,
        **({"n_after_sessions": len(tunnels)} if len(tunnels) > n_tunnels else {}),
        "n_keyframes": sum(tunnel.n_before for tunnel in tunnels),
        "digest": data_digest,
    }


def _describe_device(device: torch.device, threads: int) -> str:
    processor = f"{platform.machine()} CPU, {threads} threads"
    return processor if device.type == "cpu" else f"{torch.cuda.get_device_name(device)}; {processor}"


def _rounded(scores: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in scores.items()}
