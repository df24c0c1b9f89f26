"""Makes the data of the scan descriptor, trains it, and writes checkpoint and model card.

Run as `python -m eval.descriptor_training --data DIR --out DIR`; the data is made once and kept in DIR.
"""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from cdpipe.descriptor import use_threads
from cdpipe.descriptor.network import checkpoint_bytes, digest, initial_network
from cdpipe.descriptor.range_image import range_image
from cdpipe.descriptor.training import PlaceData, PlaceScores, TrainingConfig, evaluate, train
from cdpipe.errors import ScenarioError
from cdpipe.geometry import travelled_m, yaw_rad
from cdpipe.session import load_arrays
from cdpipe.types import SessionName
from eval.adapters import pipeline_input
from eval.cli import input_errors
from eval.output import make_writable
from eval.provenance import git_commit
from scenarios.library import load_scenario
from sim.simulate import simulate_pair
from sim.truth import read_true_poses

KEYFRAME_SPACING_M = 1.0
FAMILIES = ("narrow", "wide", "network")
FIRST_VALIDATION_SEED = 10000
SESSIONS: tuple[SessionName, ...] = ("before", "after")


def make_tunnel(family: str, seed: int, path: Path) -> None:
    """Simulate one pair and keep the range images and true poses of its keyframes in an npz file."""
    pair = path.with_suffix(".pair")
    shutil.rmtree(pair, ignore_errors=True)
    simulate_pair(load_scenario(family, seed), seed, pair)
    images, positions, headings, sessions = [], [], [], []
    for number, session in enumerate(SESSIONS):
        source = pipeline_input(pair, session)
        world_T_sensor = read_true_poses(pair / session)
        metres = np.floor(travelled_m(world_T_sensor) / KEYFRAME_SPACING_M)
        for index in np.unique(metres, return_index=True)[1]:
            images.append(range_image(source.scan(int(index)).points_sensor))
            positions.append(world_T_sensor[index, :3, 3])
            headings.append(yaw_rad(world_T_sensor[index]))
            sessions.append(number)
    partial = path.with_suffix(".partial.npz")
    np.savez(
        partial,
        allow_pickle=False,
        images_m=np.array(images, dtype=np.float16),
        positions=np.array(positions),
        headings_rad=np.array(headings),
        sessions=np.array(sessions, dtype=np.int64),
    )
    partial.replace(path)
    shutil.rmtree(pair)


def load_data(folder: Path, seeds: Iterable[int]) -> tuple[PlaceData, str, list[str]]:
    """Read the tunnels of all families and the given seeds, making those that are missing.

    Returns:
        The keyframes, their digest, and the tunnels that could not be built, each with its reason.
    """
    make_writable(folder)
    wanted = [(family, seed) for seed in seeds for family in FAMILIES]
    tunnels: list[dict[str, Any]] = []
    refused: list[str] = []
    hasher = hashlib.sha256()
    with Progress(console=Console(stderr=True)) as progress:
        for family, seed in progress.track(wanted, description="tunnels"):
            path = folder / f"{family}-{seed}.npz"
            try:
                if not path.is_file():
                    make_tunnel(family, seed, path)
            except ScenarioError as error:
                refused.append(f"{family} {seed}: {error}")
                continue
            arrays = load_arrays(path)
            arrays["tunnels"] = np.full(len(arrays["sessions"]), len(tunnels))
            hasher.update(arrays["images_m"].tobytes())
            tunnels.append(arrays)
    fields = PlaceData.__dataclass_fields__
    data = PlaceData(**{name: np.concatenate([t[name] for t in tunnels]) for name in fields})
    return data, hasher.hexdigest()[:16], refused


def main(
    data: Annotated[Path, typer.Option(help="where simulated keyframes are kept")],
    out: Annotated[Path, typer.Option(help="folder for 3deg.safetensors and 3deg.json")],
    train_tunnels: int = 30,
    validation_tunnels: int = 8,
    steps: int = 1500,
    seed: int = 0,
    threads: int = 2,
) -> None:
    """Train the scan descriptor on families narrow, wide and network; validation seeds only judge it."""
    use_threads(threads)
    make_writable(out)
    training, data_digest, refused = load_data(data, range(train_tunnels))
    validation, _, refused_validation = load_data(
        data, range(FIRST_VALIDATION_SEED, FIRST_VALIDATION_SEED + validation_tunnels)
    )
    config = TrainingConfig(seed=seed, steps=steps)
    start = time.perf_counter()
    losses: list[tuple[float, float]] = []
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("training", total=steps)

        def on_step(step: int, place_loss: float, yaw_loss: float) -> None:
            losses.append((place_loss, yaw_loss))
            recent = np.mean(losses[-50:], axis=0)
            progress.update(task, completed=step + 1, description=f"place {recent[0]:.3f} yaw {recent[1]:.3f}")

        network = train(training, config, on_step)
    seconds = time.perf_counter() - start
    content = checkpoint_bytes(network)
    card = {
        "descriptor": "3deg (re-implementation of arXiv 2210.07285)",
        "checkpoint": digest(content),
        "data": {
            "families": list(FAMILIES),
            "train_seeds": f"0:{train_tunnels}",
            "n_keyframes": len(training.positions),
            "digest": data_digest,
            "refused": refused,
        },
        "validation": {
            "seeds": f"{FIRST_VALIDATION_SEED}:{FIRST_VALIDATION_SEED + validation_tunnels}",
            "n_keyframes": len(validation.positions),
            "refused": refused_validation,
            "trained": _scores(evaluate(network, validation)),
            "untrained": _scores(evaluate(initial_network(), validation)),
        },
        "settings": {name: getattr(config, name) for name in config.__dataclass_fields__},
        "last_losses": {
            "place": float(np.mean(losses[-100:], axis=0)[0]),
            "yaw": float(np.mean(losses[-100:], axis=0)[1]),
        },
        "command": (
            f"python -m eval.descriptor_training --data DATA --out OUT --train-tunnels {train_tunnels} "
            f"--validation-tunnels {validation_tunnels} --steps {steps} --seed {seed} --threads {threads}"
        ),
        "commit": git_commit(),
        "device": f"{platform.machine()} CPU, {threads} threads",
        "seconds": round(seconds, 1),
    }
    (out / "3deg.safetensors").write_bytes(content)
    (out / "3deg.json").write_text(json.dumps(card, indent=1) + "\n")
    Console().print_json(json.dumps(card))


def _scores(scores: PlaceScores) -> dict[str, float]:
    return {name: round(getattr(scores, name), 4) for name in scores.__slots__}


if __name__ == "__main__":
    with input_errors():
        typer.run(main)
