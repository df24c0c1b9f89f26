"""One file of points in each format: PLY and KITTI's .bin here, PCD, LAS and E57 by libraries in another process."""

# ruff: noqa: PLC0415 - the libraries are extras, and they are imported in the process that reads

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_bytes, require_plain_file
from cdpipe.core.isolated_reader import IsolatedReader, Message
from cdpipe.core.plugins import require_extra
from cdpipe.io.foreign.clouds import INTENSITY_FIELDS, TIME_FIELDS, Cloud, check_cloud, field_of
from cdpipe.io.ply import read_ply

_HERE = __name__
_LIBRARIES = {"pcd": "pypcd4", "las": "laspy", "e57": "pye57"}
_LIBRARY_MODULES = ("laspy", "lazrs", "pye57", "pyo3_runtime")
# Points of one scan, or of one whole map: 24 bytes each.
MOST_POINTS = 20_000_000
_BLOCK = 1_000_000
_HEADER_LINES = 10  # of a PCD file
_KITTI = np.dtype("<f4")
_MOST_NEGATIVE = 0.02  # share of intensities below 0 in scans of a layout that is read
# What the libraries raise for a faulty file.
_ERRORS = (OSError, RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, AssertionError)


def cloud_reader(name: str, folder: Path) -> Callable[[Path], Cloud]:
    """Return what reads one file of a format; a library's process serves all files of a folder.

    Raises:
        InputError: The extra is not installed.
    """
    if name == "ply":
        return read_ply_cloud
    if name == "kitti":
        return read_bin
    require_extra("formats", str(folder))
    reader = IsolatedReader(_HERE, folder, _LIBRARIES[name])

    def read(path: Path) -> Cloud:
        parts = [arrays for _, arrays in reader.read(f"read_{name}", path=str(path)) if arrays]
        joined = {key: np.concatenate([part[key] for part in parts]) for key in (parts[0] if parts else ())}
        cloud = check_cloud(str(path), joined)
        cloud.points[~np.isfinite(cloud.points).all(axis=1)] = np.nan  # missing returns, some say by one coordinate
        return cloud

    return read


def read_ply_cloud(path: Path) -> Cloud:
    """Read the points of a PLY file, with their intensity where it has one; they are taken as deskewed.

    Raises:
        InputError: As `cdpipe.io.ply.read_ply`.
    """
    points, scalars = read_ply(path, INTENSITY_FIELDS)
    shone = field_of(scalars, INTENSITY_FIELDS)
    return check_cloud(str(path), {"points": points} | ({} if shone is None else {"intensity": scalars[shone]}))


def read_bin(path: Path) -> Cloud:
    """Read x, y, z, intensity as little-endian float32, as KITTI stores scans, or with a ring behind, as nuScenes does.

    Raises:
        InputError: The file is missing, its size is not that of whole points, or it is of another layout.
    """
    content = read_bytes(path, MOST_POINTS * 20)
    n_columns = 5 if _has_rings(content) else 4
    if not content or len(content) % (4 * n_columns):
        raise InputError(
            f"{path}: {len(content)} bytes: expected x, y, z, intensity as float32, 16 bytes a point: cut short, or of "
            "another layout"
        )
    with np.errstate(invalid="ignore"):
        rows = np.frombuffer(content, _KITTI).reshape(-1, n_columns)
        if (rows[:, 3] < 0).mean() > _MOST_NEGATIVE:
            raise InputError(
                f"{path}: {(rows[:, 3] < 0).mean():.0%} of its intensities are negative: expected x, y, z, intensity "
                "as float32, 16 bytes a point, or 20 with a ring: it is of another layout"
            )
        return Cloud(rows[:, :3].astype(np.float64), intensity=rows[:, 3].astype(np.float32))


def _has_rings(content: bytes) -> bool:
    """Tell whether a fifth number of every point is that of a ring: 0 to 255, whole, not always the same."""
    if not content or len(content) % 20:
        return False
    with np.errstate(invalid="ignore"):
        rings = np.frombuffer(content, _KITTI).reshape(-1, 5)[:, 4]
        return bool(((rings >= 0) & (rings < 256) & (rings == np.floor(rings))).all() and np.ptp(rings) > 0)


def read_viewpoints(folder: Path, files: list[Path]) -> np.ndarray[Any, Any]:
    """Return the VIEWPOINT (S, 7) of PCD files: x, y, z, qx, qy, qz, qw.

    Raises:
        InputError: A file cannot be read.
    """
    reader = IsolatedReader(_HERE, folder, _LIBRARIES["pcd"])
    rows = [about["viewpoint"] for about, _ in reader.read("read_pcd_heads", paths=[str(file) for file in files])]
    return np.array([[*row[:3], *row[4:], row[3]] for row in rows], np.float64).reshape(-1, 7)


# What follows runs in a process of its own.


def read_pcd(path: str) -> Iterator[Message]:
    """Yield the points, and the times where there are some, of a PCD file."""
    from pypcd4.pypcd4 import PointCloud

    with _reads(path, "a PCD file"):
        _require_whole_names(path)
        cloud = PointCloud.from_path(path)
        data, names = cloud.pc_data, list(cloud.fields)
        if len(data) != cloud.metadata.points:
            raise ValueError(f"{cloud.metadata.points} points are announced, {len(data)} are there: cut short")
        data = np.atleast_1d(data)
        if not {"x", "y", "z"} <= set(names):
            raise ValueError(f"its fields are {', '.join(names)[:80]}: expected x, y and z")
        arrays = {"points": np.column_stack([data[axis] for axis in "xyz"])}
        time = next((name for name in names if name.lower() in TIME_FIELDS and data[name].ndim == 1), None)
        shone = field_of((name for name in names if data[name].ndim == 1), INTENSITY_FIELDS)
    more = {"times": time, "intensity": shone}
    yield {}, arrays | {key: np.ascontiguousarray(data[name]) for key, name in more.items() if name is not None}


def _require_whole_names(path: str) -> None:
    """Raise `InputError` if pypcd4 ends the names of fields early: it takes the rows for shorter than they are."""
    from pypcd4.pypcd4 import MetaData

    lines: list[str] = []
    with Path(path).open("rb") as file:
        for line in file:
            text = line.decode("utf-8").strip()
            lines += [text] if text and not text.startswith("#") else []
            if text.startswith("DATA") or len(lines) >= _HEADER_LINES:
                break
    head = MetaData.parse_header(lines)
    if len(head.fields) < len(head.size):
        raise InputError(
            f"{path}: {len(head.fields)} of the names of its {len(head.size)} fields can be read: a bracket, # or < in "
            "a name ends the line: rename the field"
        )
    if not len(head.fields) == len(head.size) == len(head.type) == len(head.count):
        raise ValueError("its header has not as many fields as sizes, types and counts")


def read_pcd_heads(paths: list[str]) -> Iterator[Message]:
    """Yield the viewpoint of each PCD file."""
    from pypcd4.pypcd4 import PointCloud

    for path in paths:
        with _reads(path, "a PCD file"):
            _require_whole_names(path)
            viewpoint = [float(number) for number in PointCloud.from_path(path).metadata.viewpoint]
        yield {"viewpoint": viewpoint}, {}


def read_las(path: str) -> Iterator[Message]:
    """Yield the points, and the GPS times where there are some, of a LAS, LAZ or COPC file, in blocks."""
    import laspy

    with _reads(path, "a LAS or LAZ file"), laspy.open(path) as file:
        if file.header.point_count > MOST_POINTS:
            raise ValueError(f"{file.header.point_count} points: at most {MOST_POINTS} are read: thin it")
        n_found = 0
        for block in file.chunk_iterator(_BLOCK):
            n_found += len(block)
            arrays = {"points": np.column_stack([np.asarray(block[axis], np.float64) for axis in "xyz"])}
            if "gps_time" in block.point_format.dimension_names:
                arrays["times"] = np.ascontiguousarray(block["gps_time"])
            arrays["intensity"] = np.ascontiguousarray(block["intensity"])
            yield {}, arrays
        if n_found != file.header.point_count:
            raise ValueError(f"{file.header.point_count} points are announced, {n_found} are there: cut short")


def read_e57_heads(path: str) -> Iterator[Message]:
    """Yield number of points and pose (translation, then quaternion w, x, y, z) of each scan of an E57 file.

    The pose is None where the scan has none, or a number of it is missing.
    """
    import pye57

    with _reads(path, "an E57 file"):
        file = pye57.E57(path)
        heads = []
        for index in range(file.scan_count):
            head = file.get_header(index)
            pose = [*map(float, head.translation), *map(float, head.rotation)] if head.has_pose() else None
            heads.append({"points": int(head.point_count), "pose": pose if pose and len(pose) == 7 else None})
    for head in heads:
        yield head, {}


def read_e57(path: str, index: int) -> Iterator[Message]:
    """Yield the points of one scan of an E57 file, in the scanner's frame, and their intensity where there is one."""
    import pye57
    from pye57.utils import convert_spherical_to_cartesian

    with _reads(path, "an E57 file"):
        data = pye57.E57(path).read_scan(index, intensity=True, ignore_missing_fields=True, transform=False)
        if "sphericalRange" in data:
            turned = np.column_stack([data.pop(f"spherical{part}") for part in ("Range", "Azimuth", "Elevation")])
            points = convert_spherical_to_cartesian(turned)
        else:
            points = np.column_stack([data.pop(f"cartesian{axis}") for axis in "XYZ"])
    shone = {"intensity": data["intensity"]} if "intensity" in data else {}
    yield {}, {"points": points, **shone}


@contextmanager
def _reads(path: str, what: str) -> Iterator[None]:
    require_plain_file(Path(path))
    try:
        yield
    except InputError:
        raise
    except ImportError as error:
        raise InputError(f"{path}: {what} needs a package more: pip install 'tunnelcd[formats]'") from error
    except BaseException as error:  # a panic of Rust is no Exception
        is_told = isinstance(error, _ERRORS) or type(error) is Exception  # pye57 raises the base class itself
        if not is_told and type(error).__module__.split(".")[0] not in _LIBRARY_MODULES:
            raise
        told = " ".join(str(error).split()) or type(error).__name__
        raise InputError(
            f"{path}: not a readable {what.split(' ', 1)[1]}: {told[:300]}: copy or export it again"
        ) from error
