"""The rows of the scoring points that each object of an answer holds."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import cKDTree

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.io.answer import Answer
from eval.truth.ground_truth import SESSIONS, GroundTruth
from eval.truth.scoring_points import ScoringPoints

POINT_RADIUS_M = 0.1


def find_answer_rows(answer: Answer, truth: GroundTruth) -> tuple[Int64Array, ...]:
    """Return, for each object of an answer, its rows of its session's scoring points.

    An answer with returns holds the rows among them. An answer with points (of another program) holds the rows within
    0.1 m of them; a row near two objects belongs to the nearer one.
    """
    if answer.report is None:
        return ()
    objects = answer.report.objects
    if answer.points_odom is None:
        return tuple(truth.sessions[item.session].scoring_points.rows_of_returns(item.returns) for item in objects)
    rows: dict[int, Int64Array] = {}
    for session in SESSIONS:
        of_session = [index for index, item in enumerate(objects) if item.session == session]
        points = [answer.points_odom[index] for index in of_session]
        near = find_rows_near_points(truth.sessions[session].scoring_points, points)
        rows.update(zip(of_session, near, strict=True))
    return tuple(rows[index] for index in range(len(objects)))


def find_rows_near_points(
    scoring_points: ScoringPoints, objects_odom: list[Float64Array], radius_m: float = POINT_RADIUS_M
) -> list[Int64Array]:
    """Return, for each object, the rows whose nearest predicted point is its own and within a radius.

    Args:
        scoring_points: Scoring points of the session.
        objects_odom: Per object, (P, 3) points in the session's odom frame, metres.
        radius_m: Radius that a point stands for.
    """
    if not any(len(points) for points in objects_odom):
        return [np.zeros(0, dtype=np.int64) for _ in objects_odom]
    tree = cKDTree(np.concatenate(objects_odom))
    owners = np.repeat(np.arange(len(objects_odom)), [len(points) for points in objects_odom])
    points_odom = scoring_points.points_odom.astype(np.float64)
    # the bound is exclusive; without a neighbour the index is the number of points
    _, nearest = tree.query(points_odom, distance_upper_bound=np.nextafter(radius_m, np.inf))
    owner = np.append(owners, -1)[nearest]
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(objects_odom) + 1))
    return [order[start:end] for start, end in itertools.pairwise(starts)]
