"""Options that say how a recording is to be read, and the recordings opened by them."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cdpipe.io.foreign import HowToRead
    from cdpipe.model.config import Site
    from cdpipe.model.types import ScanSource
    from eval.core.terminal.progress import RunProgress

RECORDING = "session folder, or a recording: scans with a trajectory, bag, MCAP, E57, OSF, PCAP"
Format = Annotated[
    str | None, typer.Option("--format", metavar="NAME", help="format, where the guess is wrong", show_default=False)
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic", metavar="NAME", help="topic of a bag, clouds or poses; again for a second, or for the other bag"
    ),
]
Trajectories = Annotated[
    list[str] | None,
    typer.Option(
        "--trajectory", metavar="FILE", help="poses of the sensor, TUM, KITTI or CSV; once per recording, - for none"
    ),
]
Odometry = Annotated[
    str | None, typer.Option(metavar="kiss-icp|genz-icp", help="estimate the poses", show_default=False)
]
Metadata = Annotated[
    list[str] | None,
    typer.Option("--metadata", metavar="FILE.json", help="sensor of a .pcap; else the .json beside it"),
]
Deskew = Annotated[
    bool, typer.Option("--deskew/--no-deskew", help="--no-deskew: points that have times are deskewed already")
]
Origin = Annotated[
    str | None,
    typer.Option(
        "--origin",
        metavar="X,Y,Z",
        help="metres to subtract from maps and poses in a grid (UTM)",
        show_default=False,
    ),
]
NONE = "-"
# which recordings need no file of an option
_WITHOUT = {"trajectory": "has its own poses, or whose poses --odometry estimates", "metadata": "has its own"}
_FARTHEST_M = 1e8  # as poses may lie


def how_to_read(
    n_inputs: int,
    form: str | None,
    topics: list[str] | None,
    trajectories: list[str] | None,
    odometry: str | None,
    metadata: list[str] | None,
    *,
    deskew: bool,
    origin: str | None = None,
) -> list[HowToRead]:
    """Return how to read each of the recordings that a command names.

    Raises:
        InputError: An option is given for some of them only, or two options exclude each other.
    """
    from cdpipe.io.foreign import HowToRead

    HowToRead(odometry=odometry)  # a wrong name is refused, whether or not it is used
    files, origin_m = _each("trajectory", trajectories, n_inputs), read_metres("origin", origin or "0,0,0")
    if all(files) and odometry is not None:
        HowToRead(odometry=odometry, trajectory=files[0])  # which refuses them together
    return [
        HowToRead(form, tuple(topics or ()), trajectory, None if trajectory else odometry, beside, deskew, origin_m)
        for trajectory, beside in zip(files, _each("metadata", metadata, n_inputs), strict=True)
    ]


def read_metres(option: str, text: str) -> tuple[float, float, float]:
    """Return the three numbers of an option.

    Raises:
        InputError: They are not three numbers within 100,000 km.
    """
    from cdpipe.core.errors import InputError

    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(abs(value) <= _FARTHEST_M for value in (x, y, z)):
        raise InputError(f"--{option} {text}: expected three numbers in metres, as 12.5,-1.8,0.9")
    return x, y, z


def with_surface(preset: str, settings: Sequence[str], site: Site) -> list[str]:
    """Return settings that measure displacement: by `planes`, unless the preset or a setting names a method.

    Raises:
        InputError: A setting says that it is not measured.
    """
    import cdpipe
    from cdpipe.core.errors import InputError

    if cdpipe.load_config(preset, settings, site).surface.method != "none":
        return [*settings]
    if any(setting.partition("=")[0].strip() == "surface.method" for setting in settings):
        raise InputError("--set surface.method=none: displacement is to be measured: leave it out, or name a method")
    return ["surface.method=planes", *settings]


def tell_recordings(
    paths: Sequence[Path],
    form: str | None,
    topics: list[str] | None,
    trajectory: list[str] | None,
    odometry: str | None,
    metadata: list[str] | None,
    *,
    deskew: bool,
    origin: str | None,
) -> dict[str, Any]:
    """Return one or two recordings and how they are read, as keys of `scenarios.grafted.Recording`.

    Raises:
        InputError: None or more than two are named, or two options exclude each other.
    """
    from cdpipe.core.errors import InputError

    if not 1 <= len(paths) <= 2:
        raise InputError(
            f"{len(paths)} recordings: expected one, which is split, two of one place, or --recording NAME"
        )
    hows = how_to_read(len(paths), form, topics, trajectory, odometry, metadata, deskew=deskew, origin=origin)
    guess_formats(paths, hows)  # which refuses options that none of them has a use for
    told: dict[str, Any] = {"sessions": [str(path) for path in paths], "format": form, "topics": list(topics or ())}
    for name, option, files in (
        ("trajectories", "trajectory", [how.trajectory for how in hows]),
        ("metadata", "metadata", [how.metadata for how in hows]),
    ):
        if any(files) and not all(files):
            raise InputError(f"--{option} -: a grafted pair takes a file for each of its recordings, or for none")
        told[name] = [str(file) for file in files if file is not None]
    return {**told, "odometry": odometry, "deskew": deskew, "origin_m": hows[0].origin_m}


def open_inputs(paths: Sequence[Path], hows: Sequence[HowToRead], progress: RunProgress) -> list[Path | ScanSource]:
    """Open recordings; session folders stay paths.

    Raises:
        InputError: One cannot be read, or options are given for sessions alone.
    """
    from cdpipe.io.foreign import share_topics
    from cdpipe.io.readers import open_session

    guess_formats(paths, hows)  # a long reading does not end at a wrong second name
    hows = share_topics(paths, hows)
    opened: list[Path | ScanSource] = []
    for path, how, checked in zip(paths, hows, _check_sessions(paths, hows), strict=True):
        source = path if checked is None else open_session(path, checked, progress.stage)
        opened.append(source)
        if getattr(source, "is_temporary", False):
            command = shlex.join(["tunnelcd", "convert", str(path), "FOLDER", *_options(how)])
            progress.note(f"{path} was read into a temporary folder: `{command}` keeps it")
    return opened


def _options(how: HowToRead) -> list[str]:
    """Return the options that say how to read one recording."""
    values = {"format": how.format, "trajectory": how.trajectory, "odometry": how.odometry, "metadata": how.metadata}
    found = [word for name, value in values.items() if value is not None for word in (f"--{name}", str(value))]
    found += [word for topic in how.topics for word in ("--topic", topic)]
    if not how.deskew:
        found.append("--no-deskew")
    if any(how.origin_m):
        found += ["--origin", ",".join(str(value) for value in how.origin_m)]
    return found


def guess_formats(paths: Sequence[Path], hows: Sequence[HowToRead]) -> list[str]:
    """Return the format of each recording.

    Raises:
        InputError: One has none, or an option is given that none of them has a use for.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.io.foreign import guess_format
    from cdpipe.io.foreign.sniff import OUSTER

    names = [guess_format(path, how.format) for path, how in zip(paths, hows, strict=True)]
    if "bag" not in names and any(how.topics for how in hows):
        raise InputError(f"--topic: {paths[0]} is no bag: leave it out")
    for path, how, name in zip(paths, hows, names, strict=True):
        if how.metadata is not None and name not in OUSTER:
            more = f", or give {NONE} for it" if len(paths) > 1 else ""
            raise InputError(f"{path}: --metadata is the sensor of a .pcap: leave it out{more}")
    return names


def open_sources(*inputs: Path | ScanSource) -> list[ScanSource]:
    """Open the session folders among inputs."""
    from cdpipe.io.readers import open_session

    return [open_session(each) if isinstance(each, Path) else each for each in inputs]


def _check_sessions(paths: Sequence[Path], hows: Sequence[HowToRead]) -> list[HowToRead | None]:
    """Return how to read each recording, None for a session folder, which needs no options."""
    from cdpipe.core.errors import InputError
    from cdpipe.io.session import is_session

    checked = [None if is_session(path) else how for path, how in zip(paths, hows, strict=True)]
    if not any(checked):
        for path, how in zip(paths, hows, strict=True):
            how.require_nothing(path, "a session has its own poses and sensor")
    for path, how, kept in zip(paths, hows, checked, strict=True):
        if kept is None and how.trajectory is not None:
            raise InputError(f"{path}: a session has its own poses: give --trajectory {NONE} for it")
    if any(how.odometry for how in hows) and not any(kept is not None and kept.odometry for kept in checked):
        raise InputError("--odometry: no recording needs it, each has its own poses or a --trajectory: leave it out")
    return checked


def _each(name: str, values: list[str] | None, n_inputs: int) -> list[Path | None]:
    from cdpipe.core.errors import InputError

    if not values:
        return [None] * n_inputs
    if len(values) != n_inputs:
        what = "one recording" if n_inputs == 1 else f"{n_inputs} recordings"
        raise InputError(
            f"--{name}: given {len(values)} times for {what}: give it once for each, in their order"
            + (f"; {NONE} for one that {_WITHOUT[name]}" if n_inputs > 1 else "")
        )
    return [None if value == NONE else Path(value) for value in values]


def sampled_points(source: ScanSource, most: int) -> Any:
    """Return at most about `most` returns (N, 3) of a source, spread over its scans, in its odom frame."""
    import numpy as np

    from cdpipe.core.geometry import transform

    n_scans = len(source.odom_T_sensor)
    # each station of a whole map has the points that are nearest to it
    step = 1 if getattr(source, "is_whole_map", False) else max(1, n_scans // 200)
    kept = []
    share = -(-most // -(-n_scans // step))
    for scan in source.scans():
        if scan.index % step == 0:
            points = scan.points_sensor[:: max(1, len(scan.points_sensor) // share)]
            kept.append(transform(scan.odom_T_sensor, points))
    return np.concatenate(kept)
