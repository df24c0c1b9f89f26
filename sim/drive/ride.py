"""The movement of the sensor along a path: on wheels, on legs, in a hand or in flight, with the speed along it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import ScenarioError
from cdpipe.core.geometry import Float64Array, stream
from cdpipe.core.geometry.motion import Motion, make_motion
from scenarios.schema import Platform, Scenario
from sim.drive.path import Path
from sim.geometry.line import smooth_between, smooth_line
from sim.geometry.noise import smooth_noise
from sim.geometry.raycast import Caster
from sim.placement.lanes import AIR_BELOW_M
from sim.placement.placing import PROBE_UP_M, floor_heights
from sim.rock.centreline import left_of

_GRAVITY_MPS2 = 9.81
# Correlation lengths of what the platform adds: tilt and bounce of suspension or rotors, and the driver's foot.
_TILT_LENGTH_M = 2.5
_BOUNCE_LENGTH_M = 2.5
_HAND_TILT_LENGTH_M = 8.0  # of real walks: DRIVES.md
_SPEED_LENGTH_M = 8.0
# A tyre touches the floor over about this length; shorter bumps do not move the robot.
_CONTACT_M = 0.2
# A quadrotor holds its height over the floor as averaged over this half width, not over every bump.
_ALTITUDE_M = 3.0
# Who walks follows the floor as averaged over this half width, about the length of a step.
_STEP_LENGTH_M = 0.6
# A quadrotor takes this half width of way to change its lean.
_LEAN_M = 1.0
# Samples of a step of who walks: straight lines between so many keep 98.7 % of a sine, (sin(pi / 16) / (pi / 16))^2.
_SAMPLES_A_STEP = 16
_MOST_SAMPLES = 10_000_000  # two days and more at three steps a second


def ride(path: Path, floor: Caster, standing: Caster, scenario: Scenario, seed: int, session: str) -> Motion:
    """Return the true movement of the sensor of one session.

    It is sampled where the line is; a walk has further samples in between, so that its sines are whole at any speed.

    Args:
        path: The line.
        floor: Rock, stones and furniture: the floor under the wheels, and the level of a quadrotor's height.
        standing: The same with the session's props, which a quadrotor flies over.
        scenario: The platform and the session's plan.
        seed: Seed of the noise of tilt, bounce and speed.
        session: "before" or "after".

    Raises:
        ScenarioError: A quadrotor finds too little room between floor and roof, or a walk takes days.
    """
    platform, plan = scenario.platform, scenario.plan(session)
    height_m = plan.height_m or platform.sensor_height_m
    speed_mps = plan.speed_mps or platform.speed_mps
    time_s = integrate_time(path.distance_m, speed_mps, platform.speed_variation, seed, session)
    keys = stream(seed, session, "tilt").integers(2**63, size=2).tolist()
    tilt_m = _HAND_TILT_LENGTH_M if platform.kind == "handheld" else _TILT_LENGTH_M
    tilt = [np.deg2rad(platform.tilt_deg) * smooth_noise((path.distance_m,), tilt_m, key) for key in keys]
    bounce_key = int(stream(seed, session, "bounce").integers(2**63))
    bounce_m = platform.bounce_m * smooth_noise((path.distance_m,), _BOUNCE_LENGTH_M, bounce_key)
    sample_s = time_s
    if platform.gait is not None:
        sample_s = _refine(time_s, 1.0 / (_SAMPLES_A_STEP * platform.gait.step_hz), session)
        points, rotations = _walk(path, floor, platform, time_s, sample_s, height_m, tilt, seed, session)
        points[:, 2] += np.interp(sample_s, time_s, bounce_m)
    elif platform.kind == "ground_robot":
        centre_m, pitch, roll = follow_floor(path, floor, platform)
        rotations = Rotation.from_euler("ZYX", np.stack([path.yaw_rad, pitch + tilt[0], roll + tilt[1]], axis=1))
        mast = rotations.as_matrix()[:, :, 2] * height_m
        points = np.column_stack([path.points[:, :2], centre_m + bounce_m]) + mast
    else:
        pitch, roll = lean_angles(path, time_s)
        rotations = Rotation.from_euler("ZYX", np.stack([path.yaw_rad, pitch + tilt[0], roll + tilt[1]], axis=1))
        level_m = smooth_line(_floor_under(path.points, path.points[:, 2], floor), _ALTITUDE_M)
        flight_m = _keep_between(path, floor, standing, level_m + height_m + bounce_m, platform.clearance_m, session)
        points = np.column_stack([path.points[:, :2], flight_m])
    if platform.mount_yaw_deg or platform.mount_pitch_deg:
        mount_deg = [platform.mount_yaw_deg, platform.mount_pitch_deg]
        rotations *= Rotation.from_euler("ZY", mount_deg, degrees=True)
    return make_motion(sample_s, np.interp(sample_s, time_s, path.distance_m), points, rotations)


def _refine(time_s: Float64Array, longest_s: float, session: str) -> Float64Array:
    """Return the times (N,) with as few further ones, evenly between two, as leave no step above `longest_s`: (M,).

    Raises:
        ScenarioError: They are too many.
    """
    n_steps = np.ceil(np.diff(time_s) / longest_s)
    if n_steps.sum() > _MOST_SAMPLES:
        most_s = _MOST_SAMPLES * longest_s
        raise ScenarioError(
            f"{session}: the walk takes {time_s[-1]:.3g} s: with this platform.gait.step_hz, about {most_s:.3g} s are "
            "simulated at most: walk faster"
        )
    number = np.concatenate([[0.0], np.cumsum(n_steps)])
    return np.interp(np.arange(number[-1] + 1.0), number, time_s)


def _walk(
    path: Path,
    floor: Caster,
    platform: Platform,
    time_s: Float64Array,
    sample_s: Float64Array,
    height_m: float,
    tilt: list[Float64Array],
    seed: int,
    session: str,
) -> tuple[Float64Array, Rotation]:
    """Return positions (M, 3) and M rotations of a sensor that a person holds or a legged robot carries.

    The trunk of a legged robot is parallel to the floor under its feet, and its sensor stands on a mast; a person holds
    the sensor level, at the given height over the floor. Both follow the floor as averaged over a step. `time_s` (N,)
    are the times on the path, `sample_s` (M,) those wanted.
    """
    gait = platform.gait
    assert gait is not None
    phase = 2 * np.pi * stream(seed, session, "gait").random(5)
    step_rad = 2 * np.pi * gait.step_hz * sample_s
    bob_m, sway_m = gait.bob_m * np.sin(step_rad + phase[0]), gait.sway_m * np.sin(step_rad / 2 + phase[1])
    pitch_deg = gait.pitch_deg * np.sin(step_rad + phase[2])
    roll_deg, yaw_deg = gait.roll_deg * np.sin(step_rad / 2 + phase[3]), gait.yaw_deg * np.sin(step_rad / 2 + phase[4])
    if platform.kind == "legged":
        level_m, pitch, roll = follow_floor(path, floor, platform, _STEP_LENGTH_M)
    else:
        level_m = smooth_line(_floor_under(path.points, path.points[:, 2], floor), _STEP_LENGTH_M)
        pitch = roll = np.zeros_like(level_m)
    on_path = [*path.points[:, :2].T, level_m, path.yaw_rad, pitch + tilt[0], roll + tilt[1]]
    x, y, level_m, yaw, pitch, roll = (np.interp(sample_s, time_s, values) for values in on_path)
    angles = [yaw + np.deg2rad(yaw_deg), pitch + np.deg2rad(pitch_deg), roll + np.deg2rad(roll_deg)]
    rotations = Rotation.from_euler("ZYX", np.stack(angles, axis=1))
    left = left_of(np.stack([np.cos(yaw), np.sin(yaw)], axis=1))
    points = np.column_stack([np.stack([x, y], axis=1) + sway_m[:, None] * left, level_m + bob_m])
    mast = rotations.as_matrix()[:, :, 2] if platform.kind == "legged" else np.array([0.0, 0.0, 1.0])
    return points + height_m * mast, rotations


def integrate_time(
    distance_m: Float64Array, speed_mps: float, variation: float, seed: int, session: str
) -> Float64Array:
    """Return the time (N,) at each distance: the integral of ds / v, v being log-normal about `speed_mps`.

    The logarithm of v is smooth noise, so that v has the mean `speed_mps` and the standard deviation `variation` times
    that, and is never zero.
    """
    if variation == 0.0:
        return distance_m / speed_mps
    spread = np.sqrt(np.log1p(variation**2))
    noise = smooth_noise((distance_m,), _SPEED_LENGTH_M, int(stream(seed, session, "speed").integers(2**63)))
    slowness = np.exp(spread**2 / 2 - spread * noise) / speed_mps
    steps_s = np.diff(distance_m) * (slowness[1:] + slowness[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps_s)])


def follow_floor(
    path: Path, floor: Caster, platform: Platform, contact_m: float = _CONTACT_M
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return height (N,) of the robot's middle at the floor, pitch (nose down positive) and roll (left up), radians.

    The chassis lies in the plane through the four wheels' contact points that is nearest to them: middle, rise along
    and rise across are their means and mean differences, as on a rocker suspension. The floor under each is averaged
    over `contact_m` to either side.
    """
    forward = np.stack([np.cos(path.yaw_rad), np.sin(path.yaw_rad)], axis=1)
    left = left_of(forward)
    heights = {}
    for ahead in (1, -1):
        for side in (1, -1):
            offset = ahead * platform.wheelbase_m / 2 * forward + side * platform.track_m / 2 * left
            wheel = np.column_stack([path.points[:, :2] + offset, path.points[:, 2]])
            heights[ahead, side] = smooth_line(_floor_under(wheel, path.points[:, 2], floor), contact_m)
    front, rear = ((heights[ahead, 1] + heights[ahead, -1]) / 2 for ahead in (1, -1))
    port, starboard = ((heights[1, side] + heights[-1, side]) / 2 for side in (1, -1))
    pitch = -np.arctan((front - rear) / platform.wheelbase_m)
    roll = np.arctan((port - starboard) / platform.track_m * np.cos(pitch))
    return (front + rear) / 2, pitch, roll


def lean_angles(path: Path, time_s: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return pitch and roll (N,) by which a quadrotor turns its thrust into the acceleration it needs, radians."""
    speed_mps = np.gradient(path.distance_m, time_s)
    along = smooth_line(np.gradient(speed_mps, time_s), _LEAN_M)
    to_left = smooth_line(speed_mps**2 * np.gradient(path.yaw_rad, path.distance_m), _LEAN_M)
    return np.arctan(along / _GRAVITY_MPS2), -np.arctan(to_left / _GRAVITY_MPS2)


def _floor_under(points: Float64Array, level_m: Float64Array, floor: Caster) -> Float64Array:
    """Return the floor height (N,) under points (N, 3), interpolated over gaps; `level_m` without any floor."""
    heights = floor_heights(floor, points + np.array([0.0, 0.0, PROBE_UP_M]))
    known = np.flatnonzero(np.isfinite(heights))
    return np.interp(np.arange(len(heights)), known, heights[known]) if len(known) else level_m.copy()


def _keep_between(
    path: Path, floor: Caster, standing: Caster, wanted_m: Float64Array, clearance_m: float, session: str
) -> Float64Array:
    """Return heights (N,) near the wanted ones that keep clear of the roof above and of all surfaces below."""
    around = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]) * clearance_m / 2
    low, high = np.full(len(wanted_m), -np.inf), np.full(len(wanted_m), np.inf)
    for offset in around:
        origins = np.column_stack([path.points[:, :2] + offset, path.points[:, 2] + PROBE_UP_M])
        up_m, _, _ = floor.cast(origins, (0.0, 0.0, 1.0))
        roof_m = origins[:, 2] + up_m
        high = np.minimum(high, roof_m - clearance_m)
        origins[:, 2] = np.minimum(wanted_m, roof_m - clearance_m / 2)
        down_m, _, _ = standing.cast(origins, (0.0, 0.0, -1.0))
        low = np.maximum(low, origins[:, 2] - down_m + min(clearance_m, AIR_BELOW_M))
    if (low > high).any():
        worst = int(np.argmax(low - high))
        x, y, z = path.points[worst]
        raise ScenarioError(
            f"{session}: roof and floor leave {low[worst] - high[worst]:.2f} m too little for platform.clearance_m "
            f"{path.distance_m[worst]:.1f} m along the route, at ({x:.1f}, {y:.1f}, {z:.1f}): choose another lateral, "
            "or lower platform.clearance_m"
        )
    return smooth_between(wanted_m, low, high, _LEAN_M)
