"""`tunnelcd convert`: a session becomes an OSF or a folder of PCD files; a recording becomes a session."""

# ruff: noqa: PLC0415 - heavy imports stand inside the functions, so that --help and completion are instant
from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eval.cli.inputs import RECORDING, Deskew, Format, Metadata, Odometry, Topics, Trajectories, how_to_read
from eval.cli.options import Quiet
from eval.core.printing import say, shown_warnings
from eval.core.progress import RunProgress, shown_progress

if TYPE_CHECKING:
    from cdpipe.io.foreign import HowToRead
    from cdpipe.io.session import Session

GT_CLOUD = "gt_cloud.pcd"
_FEW_SCANS = 10


def convert(
    source: Annotated[Path, typer.Argument(metavar="SRC", help=RECORDING)],
    out: Annotated[Path, typer.Argument(metavar="DST", help="new .osf file or folder of .pcd files; or new session")],
    metadata: Metadata = None,
    trajectory: Trajectories = None,
    odometry: Odometry = None,
    form: Format = None,
    topics: Topics = None,
    deskew: Deskew = True,
    with_truth: Annotated[
        bool, typer.Option("--with-truth/--without-truth", help="LABEL and INSTANCE in the .osf; gt_cloud.pcd")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Convert a session to OSF for the vendor's SDK, or to PCD files; or a recording to a session.

    An OSF or PCAP becomes a session folder; scans of any other format become a folder of deskewed PLY scans with a TUM
    trajectory, which all commands take as a session.

    A folder of PCD files has the layout of DynamicMap_Benchmark: pcd/000000.pcd and so on, the points in one frame, and
    gt_cloud.pcd with the truth, where what moves has intensity 1.
    """
    from cdpipe.core.errors import InputError
    from cdpipe.io.foreign import HowToRead, guess_format
    from cdpipe.io.readers import RECORDING_SUFFIXES
    from cdpipe.io.session import is_session

    (how,) = how_to_read(1, form, topics, trajectory, odometry, metadata, deskew=deskew)
    if is_session(source) or is_session(source / "before"):
        if how != HowToRead():
            given = {"metadata": metadata, "trajectory": trajectory, "odometry": odometry, "format": form}
            name = next((name for name, value in given.items() if value is not None), "topic")
            raise InputError(f"{source}: a session has its own poses and sensor: leave --{name} out")
        with shown_progress(quiet) as progress:
            say(quiet, _export(source, out, progress, with_truth=with_truth))
        return
    name = how.format or guess_format(source)
    if with_truth:
        raise InputError(f"{source}: a recording has no truth: leave --with-truth out")
    if out.suffix.lower() in RECORDING_SUFFIXES:
        raise InputError(f"{out}: a recording becomes a session: name a new folder")
    with shown_progress(quiet) as progress:
        say(quiet, _import(source, out, name, how, progress))


def _import(source: Path, out: Path, name: str, how: HowToRead, progress: RunProgress) -> str:
    from cdpipe.io.foreign import convert_recording
    from cdpipe.io.foreign.sniff import OUSTER
    from cdpipe.io.ouster.recording import import_recording
    from eval.core.output import made_parents, new_folder

    if name not in OUSTER:
        with shown_warnings(), new_folder(out) as partial:
            n_scans, poses = convert_recording(source, partial, how, progress.stage)
        told = "1 scan" if n_scans == 1 else f"{n_scans} scans"
        return f"{out}: {told} as PLY, trajectory.tum, poses: {poses}{_too_short(n_scans)}"
    with made_parents(out):
        imported = import_recording(
            source,
            out,
            metadata=how.metadata,
            trajectory=how.trajectory,
            odometry=how.odometry,
            on_progress=progress.stage,
        )
    told = f"{out}: session of {_revolutions(imported.n_scans)}, {imported.sensor}, poses: {imported.poses}"
    if imported.n_left_out:
        told += f"; {imported.n_left_out} left out, of which half the columns or fewer arrived"
    return told + _too_short(imported.n_scans)


def _too_short(n_scans: int) -> str:
    """Return what to record where there are too few scans to compare two recordings."""
    if n_scans >= _FEW_SCANS:
        return ""
    return "; so few are one place, seldom enough to compare: record a path of ten metres or more, twice"


def _export(source: Path, out: Path, progress: RunProgress, *, with_truth: bool) -> str:
    from cdpipe.core.errors import InputError
    from cdpipe.io.session import is_session, read_session

    if out.suffix.lower() not in ("", ".osf"):
        raise InputError(f"{out}: a session becomes an OSF, a new file that ends in .osf, or a new folder of PCD files")
    if is_session(source / "before"):
        raise InputError(f"{source}: a pair of sessions: convert {source / 'before'} and {source / 'after'} one by one")
    session = read_session(source)
    if with_truth and not (source / "truth").is_dir():
        raise InputError(f"{source}: there is no truth in it: leave --with-truth out")
    write, kept = (_write_osf, "with truth as fields LABEL and INSTANCE") if out.suffix else (
        _write_pcds, f"and what moves is 1 in {GT_CLOUD}")  # fmt: skip
    size = write(session, out, progress, with_truth=with_truth)
    return f"{out}: {_revolutions(session.n_scans)}, {kept if with_truth else 'without truth'}, {size / 1e6:.1f} MB"


def _write_osf(session: Session, out: Path, progress: RunProgress, *, with_truth: bool) -> int:
    """Write a session as OSF; return its size in bytes."""
    from dataclasses import replace

    import numpy as np

    from cdpipe.io.ouster.osf import write_osf
    from eval.core.output import made_parents
    from sim.session.truth import read_labels

    if not with_truth:  # a profile of one's own is a path, which can tell the scenario
        told = {name: value for name, value in session.provenance.items() if name != "sensor_profile"}
        session = replace(session, provenance=told)
    # LABEL is the change's id, 0 none, 65535 for the -1 of mixed returns; INSTANCE is as in sim.session.truth
    labels = read_labels(session.path, session.n_chunks)
    fields = ({"LABEL": of.astype(np.uint16), "INSTANCE": instance.astype(np.int16)} for instance, of in labels)
    with made_parents(out):
        write_osf(session, out, fields if with_truth else None, progress.stage)
    return out.stat().st_size


def _write_pcds(session: Session, out: Path, progress: RunProgress, *, with_truth: bool) -> int:
    """Write a session as PCD files, one a revolution, into a new folder; return their size in bytes.

    The truth is one file of one return per 0.1 m cell: intensity 1 on what moves while the session is recorded, else 0.
    """
    from itertools import chain

    import numpy as np

    from cdpipe.core.geometry import transform
    from cdpipe.io.pcd import write_pcd
    from cdpipe.io.readers import open_session
    from eval.core.output import new_folder
    from eval.truth.scoring_points import build_scoring_points
    from sim.session.truth import read_pair_truth

    movers = [mover.instance for mover in read_pair_truth(session.path.parent).movers] if with_truth else None
    counts = chain.from_iterable(chunk.reflectivity for chunk in session.chunks())
    with new_folder(out) as folder:
        (folder / "pcd").mkdir()
        for scan, reflectivity in zip(open_session(session.path).scans(), counts, strict=True):
            points_odom = transform(scan.odom_T_sensor, scan.points_sensor)
            path = folder / "pcd" / f"{scan.index:06d}.pcd"
            write_pcd(path, points_odom, reflectivity.ravel()[scan.pixels], scan.odom_T_sensor)
            progress.stage("write", scan.index + 1, session.n_scans)
        if movers is not None:
            points = build_scoring_points(session)
            write_pcd(folder / GT_CLOUD, points.points_odom.astype(np.float64), np.isin(points.instance, movers))
        return sum(path.stat().st_size for path in folder.rglob("*.pcd"))


def _revolutions(n: int) -> str:
    return "1 revolution" if n == 1 else f"{n} revolutions"
