"""The table of formats in which sessions, answers and worlds leave, and the choice of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.yamlfile import suggest
from eval.converting import writers
from eval.converting.request import Request


@dataclass(frozen=True, slots=True)
class OutFormat:
    """One format.

    Attributes:
        about: What it is, for messages.
        suffixes: Endings that name it, lower case; none for a folder.
        write: Writes a session or a recording to a path that does not exist; of a folder, into an empty one. None
            where only maps of answers or worlds leave so.
        truth: What the truth adds, for the printed line; empty where there is no room for it.
        truth_of_story: What it adds to a session of a story, which has no truth about changes; empty where that is
            needed.
        beside: Ending of a second file, put in place of the suffix; written always, or with the truth alone.
        is_map: Whether it is one map: that of an answer leaves so, and one without scans in no other format.
        is_ours_alone: Whether sessions leave so, and other recordings do not.
    """

    about: str
    suffixes: tuple[str, ...] = ()
    write: Callable[[Request, Path], None] | None = None
    truth: str = ""
    truth_of_story: str = ""
    beside: str = ""
    is_map: bool = False
    is_ours_alone: bool = False

    @property
    def is_folder(self) -> bool:
        """Whether a folder is written."""
        return not self.suffixes


_FIELDS = "with truth as fields change and instance"
_INSTANCE = "with truth as field instance"
_TRUE = "with the true poses beside it"
FORMATS = {
    "osf": OutFormat(
        "Ouster OSF",
        (".osf",),
        writers.write_osf,
        "with truth as fields LABEL and INSTANCE",
        "with truth as field INSTANCE",
        is_ours_alone=True,
    ),
    "pcap": OutFormat(
        "Ouster PCAP with its metadata .json", (".pcap",), writers.write_pcap, beside=".json", is_ours_alone=True
    ),
    "mcap": OutFormat("MCAP of ROS 2 messages", (".mcap",), writers.write_mcap, _FIELDS, _INSTANCE),
    "ros1": OutFormat("ROS 1 bag", (".bag",), writers.write_ros1, _FIELDS, _INSTANCE),
    "ros2": OutFormat("folder of a ROS 2 bag (sqlite3)", (), writers.write_ros2, _FIELDS, _INSTANCE),
    "pcd": OutFormat(
        "folder of PCD files", (), writers.write_pcds, f"and what moves is 1 in {writers.GT_CLOUD}", is_ours_alone=True
    ),
    "semantic-kitti": OutFormat("folder as of SemanticKITTI", (), writers.write_semantic_kitti, "with truth as labels"),
    "tum": OutFormat("TUM poses", (".tum",), writers.write_tum, _TRUE, _TRUE, ".true.tum"),
    "kitti-poses": OutFormat("KITTI poses", (".kitti",), writers.write_kitti_poses, _TRUE, _TRUE, ".true.kitti"),
    "laz": OutFormat("LAZ or LAS map", (".laz", ".las"), writers.write_laz, _FIELDS, _INSTANCE, is_map=True),
    "ply": OutFormat("PLY map", (".ply",), writers.write_ply, _FIELDS, _INSTANCE, is_map=True),
    "rrd": OutFormat("recording for Rerun", (".rrd",), writers.write_rrd, "with what changed in red"),
    "glb": OutFormat("GLB of a world", (".glb",)),
}
"""One row is one format, by the name that `--to` takes."""
DEFAULT_FOLDER = "pcd"


def endings_of_recordings() -> list[str]:
    """Return the endings of the formats in which recordings leave that are no session of ours."""
    open_to_all = (each for each in FORMATS.values() if each.write is not None and not each.is_ours_alone)
    return [suffix for each in open_to_all for suffix in each.suffixes]


def choose_format(out: Path, name: str | None) -> str:
    """Return the name in `FORMATS` of what to write: the one that is named, else that of the ending.

    Raises:
        InputError: There is none of that name or ending.
    """
    if name is not None:
        if name not in FORMATS:
            raise InputError(f"--to {visible(name)}: expected one of {', '.join(FORMATS)}{suggest(name, FORMATS)}")
        return name
    suffix = out.suffix.lower()
    if not suffix:
        return DEFAULT_FOLDER
    found = next((name for name, each in FORMATS.items() if suffix in each.suffixes), None)
    if found is None:
        known = ", ".join(suffix for each in FORMATS.values() for suffix in each.suffixes)
        raise InputError(
            f"{out}: expected a new file that ends in {known}, or a new folder without a dot in its name; --to "
            f"NAME overrides ({', '.join(FORMATS)})"
        )
    return found
