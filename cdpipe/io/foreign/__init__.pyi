from .opening import HowToRead, convert_recording, folder_of_options, open_recording
from .sniff import FORMATS, guess_format, holds_scans
from .topics import share_topics
from .trajectory import Trajectory, read_poses

__all__ = [
    "FORMATS",
    "HowToRead",
    "Trajectory",
    "convert_recording",
    "folder_of_options",
    "guess_format",
    "holds_scans",
    "open_recording",
    "read_poses",
    "share_topics",
]
