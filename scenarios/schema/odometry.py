"""Where the poses of a session come from."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings
from scenarios.schema.values import NotNegative, Positive

DEFAULT_SOURCE = "drift"
# The random walk fitted to KISS-ICP on validation pairs of narrow, wide and cave together: sim/drive/DRIVES.md.
FITTED_WALK: dict[str, float] = {
    "scale_percent": 0.88,
    "scale_length_m": 1.0,
    "yaw_deg_per_m": 0.0048,
    "yaw_length_m": 23.0,
    "tilt_deg": 0.34,
    "tilt_length_m": 200.0,
    "jitter_along_m": 0.032,
    "jitter_across_m": 0.0056,
    "jitter_yaw_deg": 0.034,
    "jitter_roll_deg": 0.29,
    "jitter_pitch_deg": 0.054,
}
_KEYS_OF_SOURCE: dict[str, tuple[str, ...]] = {
    "drift": ("translation_percent", "yaw_deg_per_100m"),
    "kiss-icp": (),
    "random-walk": tuple(FITTED_WALK),
    "file": ("file",),
}


def source_of(odometry: dict[str, Any]) -> Any:
    """Return the source that a plain tree of `Odometry` names; a file names itself."""
    return odometry.get("source", "file" if "file" in odometry else DEFAULT_SOURCE)


class Odometry(GrownSettings):
    """What a session's poses come from.

    - `drift`: truth with a systematic error in KITTI's terms, its signs drawn from the seed; both figures 0: truth.
    - `random-walk`: truth with the errors of a scan-matching odometry, drawn from the seed. Errors of scale, yaw rate
      and tilt are first-order Gauss-Markov processes over the path; jitter is white noise of each revolution's pose.
      Keys left out have the values fitted to KISS-ICP.
    - `kiss-icp`: KISS-ICP on the session's own scans.
    - `file`: the poses of a TUM file; naming the file is enough.
    """

    newer: ClassVar[frozenset[str]] = frozenset({*FITTED_WALK, "file"})

    source: Literal["drift", "kiss-icp", "random-walk", "file"] = "drift"  # what the poses come from
    translation_percent: NotNegative = 0.0  # of drift: error of the way; with yaw_deg_per_100m 0, too, the truth
    yaw_deg_per_100m: NotNegative = 0.0  # of drift: error of the heading
    scale_percent: NotNegative | None = None  # standard deviation of the error of scale
    scale_length_m: Positive | None = None  # correlation length of the error of scale
    yaw_deg_per_m: NotNegative | None = None  # standard deviation of the error of the yaw rate
    yaw_length_m: Positive | None = None
    tilt_deg: NotNegative | None = None  # standard deviation of the error of roll and of pitch, which gravity bounds
    tilt_length_m: Positive | None = None
    jitter_along_m: NotNegative | None = None  # standard deviation of each pose along the direction of travel
    jitter_across_m: NotNegative | None = None  # and to the side and up
    jitter_yaw_deg: NotNegative | None = None
    jitter_roll_deg: NotNegative | None = None  # about the direction of travel
    jitter_pitch_deg: NotNegative | None = None
    file: Annotated[str, Field(pattern=r"^[^\x00]+$")] | None = (
        None  # TUM file of odom_T_sensor; from the scenario's file
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        source = source_of(given)
        said = {key: value for key, value in given.items() if value is not None}
        return {"source": source, **(FITTED_WALK if source == "random-walk" else {}), **said}

    @model_validator(mode="after")
    def _one_source(self) -> Odometry:
        fields = type(self).model_fields
        for source, keys in _KEYS_OF_SOURCE.items():
            said = [key for key in keys if getattr(self, key) != fields[key].default]
            if source != self.source and said:
                raise ValueError(
                    f"source {self.source} has no {', '.join(said)} (of source {source}): leave that out, "
                    f"or give source: {source}"
                )
        if self.source == "file" and self.file is None:
            raise ValueError("source file needs file: the name of a TUM file")
        return self
