"""The names in an answer's two files: which there are, which may be left out, and what is told of the others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cdpipe.errors import InputError
from cdpipe.yamlfile import suggestion

FORMAT = "tunnelcd-answer"
FORMAT_VERSION = 1
# names, and what is expected where there is no default
DOCUMENT = {
    "format": FORMAT, "format_version": str(FORMAT_VERSION), "status": "ok, failed or merge_refused",
    "method": "a name", "before_T_after": "4 x 4 numbers", "radius_m": "metres",
    "until": None, "error": None, "seconds": None, "evidence": None, "config": None, "objects": None,
}  # fmt: skip
OBJECT = {
    "session": "before or after", "kind": "added, removed, moved or reshaped",
    "region": None, "score": None, "partner": None, "shape": None, "displacement_map": None,
}  # fmt: skip
ARRAYS = {
    "region_centres_map": "(R, 3)", "region_scores": "(R,)", "region_pairs": None, "region_is_reported": None,
    "region_is_withdrawn": None, "region_direction": None, "keyframe_scores": None, "before_keyframe_scans": None,
    "after_keyframe_scans": None, "object_returns": None, "object_return_offsets": "(O + 1,)",
    "object_points_map": None, "object_point_offsets": "(O + 1,)", "object_points_odom": None,
    "object_point_odom_offsets": "(O + 1,)", "local_before_T_after": None,
}  # fmt: skip


class Parts(dict[str, Any]):
    """The named parts of a file: all of them are known, and what is asked for and missing is told with its name."""

    def __init__(self, where: str, what: str, known: Mapping[str, str | None], parts: Any) -> None:
        """Take the parts.

        Args:
            where: File, and place in it.
            what: What a part is called: key, array.
            known: Every name there may be, and what is expected where it may not be left out.
            parts: The parts as read.

        Raises:
            InputError: They are not named, or one has a name that is not known.
        """
        if not isinstance(parts, dict):
            raise InputError(f"{where}: expected names and values, got {type(parts).__name__}")
        super().__init__(parts)
        self.where, self._what, self._known = where, what, known
        for name in parts:
            if name not in known and not name.startswith("figure_"):
                near = suggestion(name, known) or f" (known: {', '.join(known)})"
                raise InputError(f"{where}: {what} {name} is unknown{near}")

    def __missing__(self, name: str) -> Any:
        raise InputError(f"{self.where}: {self._what} {name} is missing: expected {self._known[name]}")
