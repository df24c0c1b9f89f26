"""Guess the format of a recording from what is in it: the first bytes of a file, the files of a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible

RECORDING_SUFFIXES = (".osf", ".pcap", ".pcapng")
"""File suffixes of sensor recordings, which `cdpipe.io.ouster` reads."""
OUSTER = ("osf", "pcap")
"""Formats that `cdpipe.io.ouster` reads."""
_MOST_FILES = 1_000_000
_N_MAGIC = 16


@dataclass(frozen=True, slots=True)
class Format:
    """One format.

    Attributes:
        about: What it is, for messages.
        suffixes: Of its files, lower case.
        magic: Byte position and bytes that its files begin with; empty for none.
        in_folders: Whether a folder may hold one file per scan.
        has_several: Whether a file may hold several scans, and a folder several such files.
    """

    about: str
    suffixes: tuple[str, ...] = ()
    magic: tuple[tuple[int, bytes], ...] = ()
    in_folders: bool = False
    has_several: bool = False


_PCAP = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x0a\x0d\x0d\x0a")
FORMATS = {
    "session": Format("a session folder (session.json)"),
    "ply": Format("PLY scans", (".ply",), ((0, b"ply\n"), (0, b"ply\r")), in_folders=True),
    "pcd": Format("PCD scans", (".pcd",), ((0, b"# .PCD"), (0, b"VERSION"), (0, b"#.PCD")), in_folders=True),
    "las": Format("LAS, LAZ or COPC scans", (".las", ".laz"), ((0, b"LASF"),), in_folders=True),
    "kitti": Format("KITTI or nuScenes .bin scans (float32 x, y, z, intensity)", (".bin",), in_folders=True),
    "e57": Format("E57", (".e57",), ((0, b"ASTM-E57"),), has_several=True),
    "bag": Format(
        "a ROS 1 bag, ROS 2 bag or MCAP",
        (".bag", ".mcap", ".db3"),
        ((0, b"#ROSBAG V2.0"), (0, b"\x89MCAP0\r\n"), (0, b"SQLite format 3")),
    ),
    "osf": Format("an Ouster OSF", (".osf",), ((8, b"OSF$"),)),
    "pcap": Format("an Ouster PCAP", (".pcap", ".pcapng"), tuple((0, magic) for magic in _PCAP)),
}
"""One row is one format, by the name that `--format` takes."""
_OF_AN_ANSWER = {"objects.ply", "surface.ply"}  # they are no scans
# Sub-folders in which other people's tools put the scans.
_SCAN_FOLDERS = ("velodyne", "pcd", "scans", "clouds", "velodyne_points/data", "lidar", "points")


def guess_format(path: Path, said: str | None = None) -> str:
    """Return the name in `FORMATS` of what a file or folder holds.

    Args:
        path: A recording.
        said: The format that somebody names, which is taken, unless a file begins as those of another one do.

    Raises:
        InputError: It does not exist, or is none of them, or could be two; or it is not what it is said to be.
    """
    if said is not None:
        begins_as = [name for name in _begins_as(path) if name != said] if path.is_file() else []
        if begins_as:
            raise InputError(
                f"{path}: --format {said}: begins as {FORMATS[begins_as[0]].about} does: leave --format out"
            )
        return said
    if path.is_dir():
        return _guess_folder(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder: expected a session, or a recording ({_known()})")
    if not path.is_file():
        raise InputError(f"{path}: a device or a pipe: expected a session, or a recording ({_known()})")
    found, suffix = _begins_as(path), path.suffix.lower()
    # a damaged file is called what its name says
    named = [name for name, each in FORMATS.items() if suffix in each.suffixes]
    if not (found or named):
        raise InputError(f"{path}: expected a session folder, or a recording ({_known()}); --format NAME overrides")
    return (found or named)[0]


def _begins_as(path: Path) -> list[str]:
    """Return the formats that begin as a file does."""
    with path.open("rb") as file:
        head = file.read(_N_MAGIC)
    return [name for name, each in FORMATS.items() if any(head[at:].startswith(it) for at, it in each.magic)]


def holds_scans(folder: Path) -> bool:
    """Return whether a folder holds a recording, of one format or of several."""
    try:
        return len(_formats_in(folder)) > 0
    except OSError:
        return False


def require_format_name(name: str) -> str:
    """Return the name of a format; raise `InputError` if there is none of this name."""
    if name not in FORMATS:
        raise InputError(f"--format {visible(name)}: expected one of {', '.join(FORMATS)}")
    return name


def find_scans(folder: Path, name: str) -> list[Path]:
    """Return the files of one format in a folder, or in the usual sub-folder that has more of them, sorted."""
    suffixes = FORMATS[name].suffixes
    places = [_files(place, suffixes) for place in (folder, *(folder / sub for sub in _SCAN_FOLDERS))]
    return max(map(sorted, places), key=len)


def _formats_in(folder: Path) -> dict[str, int]:
    """Return the formats in a folder with their numbers of files."""
    if (folder / "session.json").is_file():
        return {"session": 1}
    named = [name for name, each in FORMATS.items() if each.in_folders or each.has_several]
    counts = {name: len(find_scans(folder, name)) for name in named}
    if (folder / "metadata.yaml").is_file():  # its files may be compressed: x.db3.zstd
        counts["bag"] = int(any({".db3", ".mcap"} & set(file.suffixes) for file in folder.iterdir()))
    else:
        counts["bag"] = len(_files(folder, FORMATS["bag"].suffixes))
    found = {name: count for name, count in counts.items() if count}
    # one map beside scans or a bag is no scan
    return {name: count for name, count in found.items() if count > 1 or name == "bag"} or found


def _guess_folder(folder: Path) -> str:
    found = _formats_in(folder)
    if not found and (folder / "answer.json").is_file():
        raise InputError(f"{folder}: an answer, no session: name the session that it was made from")
    if len(found) > 1:
        told = ", ".join(f"{count} {name}" for name, count in found.items())
        raise InputError(f"{folder}: scans of several formats ({told}): name one, --format {' or '.join(found)}")
    if not found:
        if (folder / "before").is_dir() and (folder / "after").is_dir():
            raise InputError(f"{folder}: a pair, no session: name {folder / 'before'} and {folder / 'after'}")
        raise InputError(
            f"{folder}: no scans in it{_tell_content(folder)}: expected session.json (a session of ours), or *.ply, "
            "*.pcd, *.las, *.laz or *.bin scans with a trajectory, or *.e57 scans, or a bag"
        )
    return next(iter(found))


def _tell_content(folder: Path) -> str:
    """Return what a folder without scans holds, in brackets, or "" for nothing."""
    inside = sorted(folder.iterdir())
    if names := [each.name for each in inside if each.is_dir()][:3]:
        return f" (there are folders: {', '.join(map(visible, names))})"
    counts = Counter(each.suffix for each in inside).most_common(3)
    told = ", ".join(f"{count} {visible(f'*{suffix}') if suffix else 'without suffix'}" for suffix, count in counts)
    single = {suffix for each in FORMATS.values() if not each.in_folders for suffix in each.suffixes}
    way_out = "; name one of them" if single & {suffix for suffix, _ in counts} else ""
    return f" (there are {told}{way_out})" if told else " (it is empty)"


def _files(folder: Path, suffixes: Iterable[str]) -> list[Path]:
    """Return the files of a folder with some suffixes, without those of an answer that lies there."""
    if not folder.is_dir():
        return []
    wanted = set(suffixes)
    left_out = _OF_AN_ANSWER if (folder / "answer.json").is_file() else set()
    found = []
    for number, file in enumerate(folder.iterdir()):
        if number >= _MOST_FILES:
            raise InputError(f"{folder}: more than {_MOST_FILES} files: split it")
        if file.suffix.lower() in wanted and not file.name.startswith(".") and file.name not in left_out:
            found.append(file)
    return found


def _known() -> str:
    return ", ".join(suffix for each in FORMATS.values() for suffix in each.suffixes)
