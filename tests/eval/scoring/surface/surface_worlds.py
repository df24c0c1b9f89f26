"""A wall of 30 x 5 m with drawn patches that moved, and answers about it, for tests of displacement fields."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cdpipe.core.geometry import invert, make_pose, stream, transform
from cdpipe.io.answer import Answer
from cdpipe.model.report import ChangeRegions, ChangeReport, SurfaceField, SurfaceRegion
from eval.scoring.scoring import CaseScore, score_answer
from eval.truth.ground_truth import GroundTruth, SessionTruth, SurfaceLabels, ground_truth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import PairTruth, SurfaceChangeTruth

CELL_M = 0.25
LENGTH_M, HEIGHT_M = 30.0, 5.0
N_SCANS = 31
CELL_M2 = CELL_M**2


def wall(margin_m: float = 0.0) -> np.ndarray:
    """(N, 3) one point in the middle of each cell of 0.25 m of the wall and a margin around it."""
    along, up = (np.arange(CELL_M / 2 - margin_m, end + margin_m, CELL_M) for end in (LENGTH_M, HEIGHT_M))
    x, z = np.meshgrid(along, up, indexing="ij")
    return np.column_stack([x.ravel(), np.full(x.size, 2.0 + CELL_M / 2), z.ravel()])


def session(points: np.ndarray, odom_T_world: np.ndarray, surface: SurfaceLabels | None = None) -> SessionTruth:
    """A drive along the wall, one scan a metre; each point belongs to the nearest scan."""
    world = np.stack([make_pose(translation=(float(k), 0.0, 1.0)) for k in range(N_SCANS)])
    scan = np.clip(np.rint(points[:, 0]).astype(np.int64), 0, N_SCANS - 1)
    order = np.argsort(scan, kind="stable")
    returns = np.sort(scan) * len(points) + np.arange(len(points))
    if surface is not None:
        surface = SurfaceLabels(surface.displacement_m[order], surface.change[order])
    labels = np.zeros(len(points), dtype=np.int16)
    odom = transform(odom_T_world, points[order]).astype(np.float32)
    seen = ScoringPoints(returns, odom, labels, labels, N_SCANS, len(points))
    return SessionTruth(odom_T_world @ world, world, seen, surface=surface)


def wall_truth(
    patches: Mapping[int, tuple[float, float, float, float, float]],
    *,
    before: np.ndarray | None = None,
    after: np.ndarray | None = None,
    family: str = "surface/test",
    unseen_from_m: float = np.inf,
    kinds: Mapping[int, str] | None = None,
) -> GroundTruth:
    """The truth of a wall.

    Args:
        patches: By id: x and z of the lower corner, width, height, and displacement, metres.
        before: odom_T_world of the before session, the identity if left out; moves by whole cells keep the places.
        after: Likewise.
        family: Family of the pair.
        unseen_from_m: From where on the after session saw nothing.
        kinds: Kind of each change, "convergence" if left out.
    """
    points = wall()
    displacement, change = np.zeros(len(points), np.float32), np.zeros(len(points), np.int16)
    changes = []
    for number, (x, z, width, height, depth) in patches.items():
        low, high = (x, z), (x + width, z + height)
        inside = ((points[:, [0, 2]] > low) & (points[:, [0, 2]] < high)).all(axis=1)
        displacement[inside], change[inside] = depth, number
        area = float(inside.sum()) * CELL_M2
        kind = (kinds or {}).get(number, "convergence")
        centre = points[inside].mean(axis=0).tolist() if inside.any() else [x, 2.0, z]
        volume = area * depth
        changes.append(SurfaceChangeTruth(number, f"patch {number}", kind, None, area, volume, depth, depth, centre))
    surface = SurfaceLabels(displacement, change) if patches else None
    # off the grid, so that no distance between the sessions lies at a bound
    after_points = wall(margin_m=0.5)
    after_points = after_points[after_points[:, 0] < unseen_from_m]
    after_points = after_points + stream(0, "after").uniform(-0.02, 0.02, after_points.shape)
    sessions = {
        "before": session(points, np.eye(4) if before is None else before, surface),
        "after": session(after_points, np.eye(4) if after is None else after),
    }
    return ground_truth(PairTruth(family, 1, 3.0, (), {}, surface_changes=tuple(changes)), sessions)


def drawn_patches(seed: int) -> dict[int, tuple[float, float, float, float, float]]:
    """One to four patches, each in a stretch of its own, of 1.5 to 5 m and 2 mm to 0.4 m, of either sign."""
    draw = stream(seed, "patches")
    return {
        number + 1: (
            7.0 * number + float(draw.uniform(0.5, 1.5)), float(draw.uniform(0, 1)), float(draw.uniform(1.5, 5.0)),
            float(draw.uniform(1.5, 4.0)), float(draw.choice([-1, 1]) * 10 ** draw.uniform(-2.7, -0.4)),
        )
        for number in range(int(draw.integers(1, 5)))
    }  # fmt: skip


def true_field(truth: GroundTruth, level_m: float = 0.01) -> SurfaceField:
    """The truth as a field, at every scoring point of the before session."""
    points = truth.before.scoring_points.points_odom.astype(np.float64)
    surface = truth.before.surface
    moved = np.zeros(len(points)) if surface is None else surface.displacement_m.astype(np.float64)
    region = np.full(len(points), -1) if surface is None else surface.change.astype(np.int64) - 1
    before = truth.before.odom_T_sensor[0] @ invert(truth.before.world_T_sensor[0])
    regions = tuple(
        SurfaceRegion(
            transform(before, np.array([each.centre_world]))[0], each.area_m2, each.volume_m3, each.mean_m,
            each.largest_m,
        )
        for each in truth.pair.surface_changes
    )  # fmt: skip
    normals = np.tile(before[:3, :3] @ (0.0, -1.0, 0.0), (len(points), 1))
    return SurfaceField(points, normals, moved, np.full(len(points), level_m), region.astype(np.int32), regions)


def rows_of_field(field: SurfaceField, rows: np.ndarray) -> SurfaceField:
    """The field at some of its points."""
    names = ("points_map", "normals_map", "displacement_m", "level_m", "region")
    return replace(field, **{name: getattr(field, name)[rows] for name in names})


def report_of(truth: GroundTruth, field: SurfaceField | None) -> ChangeReport:
    """An answer with the true merge, a field, and no region or object."""
    before, after = (each.odom_T_sensor[0] @ invert(each.world_T_sensor[0]) for each in (truth.before, truth.after))
    nothing = ChangeRegions(
        np.zeros((0, 3)), 3.0, np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, np.bool_), np.zeros(0)
    )
    none = np.zeros(0, np.int64)
    return ChangeReport(before @ invert(after), {}, nothing, (), {}, {}, (none, none), surface=field)


def score_field(truth: GroundTruth, field: SurfaceField | None) -> CaseScore:
    """Score an ok answer with a field, or without one."""
    return score_answer(Answer("ok", "", "drawn", report_of(truth, field), {}, {}), truth)


def surface_columns(score: CaseScore) -> dict[str, Any]:
    """The columns of results.csv that are about the field."""
    return {name: value for name, value in score.row.items() if "surface" in name}
