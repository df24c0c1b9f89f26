"""A changed pair in which something moves, scored: the truth as its answer, and a region on a mover."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, invert, transform
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from eval.scoring.scoring import score
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from scenarios import load_scenario
from scenarios.schema import Mover
from sim.session.simulate import simulate_pair
from tests.eval.scoring.test_scoring import ONES, true_report

SEED = 10000


@pytest.fixture(scope="module", name="pair")
def pair_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pair of smoke/one_box in a wider drift, with a person beside the box and another at the other end."""
    plain = load_scenario("smoke/one_box", SEED, ["tunnel.section.width_m=4.5", "tunnel.section.height_m=3.2"])
    stretches = {"near": ("bend", "end"), "far": ("start", "bend")}
    movers = [
        Mover.model_validate({"name": name, "kind": "person", "path": {"between": edge, "fractions": (0.15, 0.5)}})
        for name, edge in stretches.items()
    ]
    out = tmp_path_factory.mktemp("moving") / "pair"
    simulate_pair(plain.model_copy(update={"movers": tuple(movers)}), SEED, out)
    return out


@pytest.fixture(scope="module", name="truth")
def truth_fixture(pair: Path) -> GroundTruth:
    return load_ground_truth(pair)


@pytest.fixture(scope="module", name="right")
def right_fixture(pair: Path, truth: GroundTruth) -> ChangeReport:
    world_T_odom = [each.world_T_sensor[0] @ invert(each.odom_T_sensor[0]) for each in (truth.before, truth.after)]
    scans = tuple(np.arange(len(each.odom_T_sensor)) for each in (truth.before, truth.after))
    report = true_report(pair, invert(world_T_odom[0]) @ world_T_odom[1])
    return replace(report, keyframe_scans=(scans[0], scans[1]))


def to_map(truth: GroundTruth, place_world: Float64Array) -> Float64Array:
    return transform(truth.before.odom_T_sensor[0] @ invert(truth.before.world_T_sensor[0]), place_world[None])


def add_region(report: ChangeReport, centre_map: Float64Array) -> ChangeReport:
    old = report.regions
    regions = ChangeRegions(
        centres_map=np.concatenate([old.centres_map, centre_map]),
        radius_m=old.radius_m,
        scores=np.append(old.scores, 0.1),
        pairs=np.zeros((len(old.scores) + 1, 2), dtype=np.int64),
        is_reported=np.append(old.is_reported, True),
        keyframe_scores=old.keyframe_scores,
    )
    return replace(report, regions=regions, figures={})


def test_the_truth_of_a_pair_with_movers_scores_one(pair: Path, right: ChangeReport) -> None:
    row = score(right, pair)
    assert {name: row[name] for name in ONES} == dict.fromkeys(ONES, 1.0)
    assert (row["n_changes"], row["n_false_regions_on_movers"], row["false_regions_on_movers_per_100m"]) == (1, 0, 0.0)


def test_a_region_on_a_mover_is_false_and_counted_beside_it_alone(
    pair: Path, truth: GroundTruth, right: ChangeReport
) -> None:
    far_from_box = truth.after.seen_movers_world[
        np.linalg.norm(truth.after.seen_movers_world - truth.centroids_world[0], axis=1) > 12
    ]
    place = far_from_box[len(far_from_box) // 2]
    on_it = score(add_region(right, to_map(truth, place)), pair)
    assert (on_it["n_false_regions"], on_it["n_false_regions_on_movers"]) == (1, 1)
    assert on_it["false_regions_on_movers_per_100m"] == pytest.approx(100 / on_it["after_path_m"])
    assert on_it["region_recall"] == 1 and on_it["region_precision"] == 0.5
    away = score(add_region(right, to_map(truth, place + np.array([0.0, 0.0, 40.0]))), pair)
    assert (away["n_false_regions"], away["n_false_regions_on_movers"]) == (1, 0)


def test_returns_on_a_mover_are_no_part_of_a_change(pair: Path, truth: GroundTruth, right: ChangeReport) -> None:
    points = truth.after.scoring_points
    instance = {mover.instance for mover in truth.pair.movers}
    rows = np.flatnonzero(np.isin(points.instance, list(instance)))
    assert len(rows) > 200 and (points.change[rows] == 0).all()
    returns = np.column_stack([points.scans(rows), points.pixels(rows)]).astype(np.int32)
    ghost = ChangedObject("after", "added", -1, returns, points.points_odom[rows].astype(np.float64), 0.5)
    row = score(replace(right, objects=(*right.objects, ghost)), pair)
    assert row["object_precision_50"] == 0.5
    assert row["static_accuracy"] < 1 and row["dynamic_accuracy"] == 1
