"""Write a session as OSF, the format of the vendor's SDK: ranges, reflectivity, signal, stamps and column poses.

The file has the complete sensor metadata, `body_to_world` of a column is its `odom_T_column`, and the caller can add
fields per pixel. Every column is marked valid; a missing column has no returns.
"""

# ruff: noqa: PLC0415 - the vendor's SDK is an extra, and everybody else must be able to import this

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from cdpipe.core.progress import Progress, report_nothing
from cdpipe.io.ouster.sdk import SECOND, one_line, require_sdk
from cdpipe.io.session import ScanChunk, Session

_CHANNELS = {"RANGE": "range_mm", "REFLECTIVITY": "reflectivity", "SIGNAL": "signal"}

Fields = Mapping[str, npt.NDArray[Any]]


def write_osf(
    session: Session, path: Path, fields: Iterable[Fields] | None = None, on_progress: Progress | None = None
) -> None:
    """Write a session as an OSF file; the file gets its name when it is complete.

    Args:
        session: The session.
        path: The new file.
        fields: For each chunk, further fields (s, R, W) by name; default: none. With two returns, those of the second
            ones have a 2 after the name.
        on_progress: Called with the stage, the number of finished revolutions and their total.

    Raises:
        InputError: The file exists or cannot be written, a chunk is damaged or its stamps do not rise, or the vendor's
            SDK is not installed or rejects this sensor.
    """
    core = require_sdk()
    from ouster.sdk.osf import OsfDropFrameError

    if path.exists():
        raise InputError(f"{path} exists already: name a new file or remove it")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    info = sensor_info(session)
    report = on_progress or report_nothing
    report("write", 0, session.n_scans)
    done = 0
    try:
        with _new_osf(path, info) as writer:
            for chunk, more in zip(session.chunks(), fields or repeat({}), strict=fields is not None):
                _check_fields(session, chunk, more)
                for row in range(len(chunk.range_mm)):
                    writer.save(0, frame_of(core, info, session, chunk, more, row, done))
                    done += 1
                    report("write", done, session.n_scans)
    except OsfDropFrameError as error:
        raise InputError(
            f"{session.path}: revolution {done} does not come after the one before it: the stamps of its chunks are "
            "damaged, an OSF's must rise"
        ) from error
    except (OSError, RuntimeError) as error:
        way_out = "give it a disk with room and a folder you may write to"
        raise InputError(f"{path}: cannot be written ({one_line(error)}): {way_out}") from error


@contextmanager
def _new_osf(path: Path, info: Any) -> Iterator[Any]:
    """Yield the SDK's writer of a file in a hidden folder; the file is renamed if the block succeeds.

    A failed writer writes again when it is destroyed and terminates the process if that fails too. It opens the file by
    name each time, so after a failure the name is a link to the null device.
    """
    from ouster.sdk import osf

    folder = path.with_name(f".{path.name}.partial")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    partial = folder / path.name
    try:
        writer = osf.Writer(str(partial), info)
        try:
            yield writer
            writer.close()
        except BaseException:
            partial.unlink(missing_ok=True)
            partial.symlink_to(os.devnull)
            writer.close()
            raise
        partial.rename(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def sensor_info(session: Session) -> Any:
    """Return the SDK's description of a session's sensor.

    Raises:
        InputError: The SDK rejects it, for example because of its number of beams.
    """
    core = require_sdk()
    document = {**session.sensor.to_json(), "status": "RUNNING"}
    try:
        info = core.SensorInfo(json.dumps(document))
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{session.path}: the vendor's SDK does not take its sensor: {one_line(error)}") from error
    profile = core.UDPProfileLidar
    one, two = profile.RNG19_RFL8_SIG16_NIR16, profile.RNG19_RFL8_SIG16_NIR16_DUAL
    info.format.udp_profile_lidar = one if session.n_returns == 1 else two
    info.user_data = json.dumps({"tunnelcd": session.provenance})
    return info


def _check_fields(session: Session, chunk: ScanChunk, fields: Fields) -> None:
    for name, values in fields.items():
        if values.shape != chunk.range_mm.shape:
            raise InputError(
                f"{session.path}: field {name} is {values.shape} where ranges are {chunk.range_mm.shape}: it does not "
                "belong to this session"
            )


def frame_of(core: Any, info: Any, session: Session, chunk: ScanChunk, fields: Fields, row: int, number: int) -> Any:
    """Return one revolution as the SDK's `LidarFrame`."""
    whole = {name: getattr(chunk, own)[row] for name, own in _CHANNELS.items()}
    whole |= {name: values[row] for name, values in fields.items()}
    parts = [np.split(values, session.n_returns) for values in whole.values()]
    arrays = {
        name + suffix: part
        for number, suffix in enumerate(("", SECOND)[: session.n_returns])
        for name, part in zip(whole, (own[number] for own in parts), strict=True)
    }
    frame = core.LidarFrame(info, [core.FieldType(name, values.dtype) for name, values in arrays.items()])
    for name, values in arrays.items():
        frame.field(name)[:] = values
    start_ns = session.provenance.get("sensor_clock_start_ns", 0)
    frame.frame_id = number
    frame.timestamp[:] = chunk.column_stamps_ns[row] + start_ns
    frame.packet_timestamp[:] = frame.timestamp[:: info.format.columns_per_packet]
    frame.measurement_id[:] = np.arange(frame.w)
    frame.status[:] = 1
    sensor_T_column = chunk.column_poses[row].astype(np.float64)
    rotations = Rotation.from_quat(sensor_T_column[:, 3:]).as_matrix()
    frame.body_to_world[:] = session.odom_T_sensor[number] @ make_pose(rotations, sensor_T_column[:, :3])
    return frame
