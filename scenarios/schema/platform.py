"""What carries the sensor, and how it walks."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from cdpipe.core.yamlfile import GrownSettings, Settings
from scenarios.schema.values import Finite, NotNegative, Positive


class Gait(Settings):
    """What walking adds to the movement of the sensor: amplitudes of oscillations; a stride is two steps."""

    step_hz: Annotated[float, Field(gt=0, le=5)]  # steps a second
    bob_m: NotNegative  # up and down, once a step
    sway_m: NotNegative  # to the sides, once a stride
    pitch_deg: NotNegative  # once a step
    roll_deg: NotNegative  # once a stride
    yaw_deg: NotNegative  # once a stride


# Of platforms that walk. A hand: fitted to real walks; a legged robot: unverified (sim/drive/DRIVES.md).
GAITS: dict[str, dict[str, float]] = {
    "handheld": {"step_hz": 1.4, "bob_m": 0.05, "sway_m": 0.08, "pitch_deg": 0.5, "roll_deg": 0.4, "yaw_deg": 0.95},
    "legged": {"step_hz": 2.6, "bob_m": 0.012, "sway_m": 0.01, "pitch_deg": 1.0, "roll_deg": 1.0, "yaw_deg": 0.5},
}


class Platform(GrownSettings):
    """What carries the sensor, and how the sensor is mounted on it."""

    newer: ClassVar[frozenset[str]] = frozenset({"mount_yaw_deg", "mount_pitch_deg", "gait"})

    kind: Literal["ground_robot", "quadrotor", "handheld", "legged"] = "ground_robot"  # what carries the sensor
    sensor_height_m: Positive = 0.8  # above the floor
    speed_mps: Positive = 1.0
    speed_variation: Annotated[float, Field(ge=0, le=0.5)] = 0.0  # standard deviation, as a share of the speed
    scan_spacing_m: Positive = 0.25  # path between the recorded revolutions
    clearance_m: Positive = 0.5  # kept to walls and props
    wheelbase_m: Positive = 0.6  # the robot's four wheels or feet find the floor: roll, pitch and bounce follow
    track_m: Positive = 0.5
    tilt_deg: NotNegative = 1.0  # standard deviation of roll and pitch on top of that
    bounce_m: NotNegative = 0.0  # and of the height
    wander_m: NotNegative = 0.0  # standard deviation of the line from side to side, where there is room
    mount_yaw_deg: Finite = 0.0  # of the sensor's x axis against the platform's, to the left; recorded drives have none
    mount_pitch_deg: Annotated[float, Field(ge=-30, le=30)] = 0.0  # of the sensor then, nose down positive
    gait: Gait | None = None  # of a platform that walks; keys left out are those of its kind

    @model_validator(mode="before")
    @classmethod
    def _walk(cls, given: Any) -> Any:
        usual = GAITS.get(str(given.get("kind"))) if isinstance(given, dict) else None
        gait = given.get("gait") or {} if usual else None
        return {**given, "gait": usual | gait} if usual and isinstance(gait, dict) else given

    @model_validator(mode="after")
    def _only_walkers_have_a_gait(self) -> Platform:
        if self.gait is not None and self.kind not in GAITS:
            raise ValueError(f"a {self.kind} has no gait: leave gait out, or give kind {' or '.join(GAITS)}")
        return self
