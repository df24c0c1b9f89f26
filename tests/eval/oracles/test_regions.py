"""Regions made of the truth: one around each change, in the frame of a map that drifts, and the plans that use them."""

from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.core.names import path_part
from cdpipe.model.config import QueryConfig
from eval.oracles.regions import regions_by_truth
from eval.plans.cells import expand_cells
from eval.plans.changes import change_plan
from eval.plans.plan import Plan, load_plan
from eval.plans.variants import name_variant
from eval.scoring.region_metrics import match_regions, transform_to_world
from eval.tables.merge_table import is_oracle
from eval.truth.ground_truth import GroundTruth, SessionTruth
from eval.truth.scoring_points import ScoringPoints
from sim.session.truth import PairTruth
from tests.eval.changes import change

N_SCANS = 40
SCANS = (np.arange(0, N_SCANS, 4), np.arange(1, N_SCANS, 3))
RADII_M = np.full(len(SCANS[0]), 4.5)


def truth_of(places: list[tuple[float, float]], n_cells: list[int], is_observable: list[bool]) -> GroundTruth:
    """Changes at some x, y; both sessions drive along x at 1 m a scan, and the before odometry bends away."""
    world = np.stack([make_pose(translation=(float(index), 0.0, 1.0)) for index in range(N_SCANS)])
    bends = np.stack([yaw_pose(0.004 * index, (5.0 + 0.01 * index, -3.0, 0.0)) for index in range(N_SCANS)])
    none = np.zeros(0, dtype=np.int16)
    scoring_points = ScoringPoints(np.zeros(0, np.int64), np.zeros((0, 3), np.float32), none, none, N_SCANS, 1)
    changes = tuple(change(number) for number in range(1, len(places) + 1))
    return GroundTruth(
        pair=PairTruth("test", 0, 4.5, changes, {}),
        sessions={
            "before": SessionTruth(bends @ world, world, scoring_points),
            "after": SessionTruth(world, world, scoring_points),
        },
        change_rows=tuple(np.arange(count) for count in n_cells),
        centroids_world=np.array([(x, y, 0.0) for x, y in places]).reshape(-1, 3),
        is_observable=np.array(is_observable, dtype=np.bool_),
        is_partial=np.zeros(len(places), dtype=np.bool_),
    )


def test_every_change_gets_a_region_that_finds_it_however_the_map_drifts() -> None:
    truth = truth_of([(3.2, 1.0), (17.9, -1.5), (33.0, 0.5)], [5, 9, 7], [True, True, True])
    regions = regions_by_truth(truth, SCANS, RADII_M, QueryConfig(radius_m=4.5))
    # the largest first; the places are exact, for the scan that carries them there carries them back
    back = transform_to_world(regions.centres_map, truth.before)
    np.testing.assert_allclose(back, truth.centroids_world[[1, 2, 0]], atol=1e-9)
    assert regions.is_reported.all()
    matches = match_regions(back, regions.is_reported, truth.centroids_world, truth.is_observable, 0.01)
    assert matches.count("true") == 3
    # far from where one transform for the whole map would put them
    start = truth.before.to_world(regions.centres_map, np.zeros(3, dtype=np.int64))
    assert np.linalg.norm(start - back, axis=1).max() > 0.3
    # keyframes 4 m and 3 m apart, before from scan 0, after from scan 1
    assert regions.pairs.tolist() == [[4, 6], [8, 11], [1, 1]]
    # the nearer a keyframe is to a change, the higher it scores: AUROC 1
    gaps_m = np.linalg.norm(truth.before.world_T_sensor[SCANS[0], None, :3, 3] - truth.centroids_world, axis=2)
    np.testing.assert_allclose(regions.keyframe_scores, -gaps_m.min(axis=1))


def test_what_nobody_could_see_gets_no_region_and_a_near_neighbour_of_a_larger_one_none_of_its_own() -> None:
    truth = truth_of([(5.0, 0.0), (8.0, 0.0), (20.0, 0.0), (30.0, 0.0)], [5, 9, 7, 3], [True, True, False, True])
    regions = regions_by_truth(truth, SCANS, RADII_M, QueryConfig(radius_m=4.5))
    back = transform_to_world(regions.centres_map, truth.before)
    np.testing.assert_allclose(back[:, 0], [8.0, 30.0], atol=1e-9)
    closer = regions_by_truth(truth, SCANS, RADII_M, QueryConfig(radius_m=4.5, suppression=0.5))
    assert len(closer.scores) == 3


@pytest.mark.parametrize("settings", [{"threshold": 1e9}, {"n_regions": 1}])
def test_no_threshold_stands_in_its_way(settings: dict[str, float]) -> None:
    truth = truth_of([(5.0, 0.0), (30.0, 0.0)], [5, 9], [True, True])
    regions = regions_by_truth(truth, SCANS, RADII_M, QueryConfig(radius_m=4.5, **settings))
    assert regions.is_reported.tolist() == [True, True]


def test_a_region_has_the_radius_of_its_before_keyframe() -> None:
    truth = truth_of([(5.0, 0.0), (14.0, 0.0), (30.0, 0.0)], [9, 5, 7], [True, True, True])
    radii_m = np.linspace(10.0, 4.5, len(SCANS[0]))  # keyframes 4 m apart
    regions = regions_by_truth(truth, SCANS, radii_m, QueryConfig(radius_m="width"))
    # the one at 5 m has 9.4 m, that of keyframe 1, and suppresses the one at 14 m
    np.testing.assert_array_equal(regions.radii_m, radii_m[[1, 7]])


def test_an_unchanged_pair_has_no_region() -> None:
    regions = regions_by_truth(truth_of([], [], []), SCANS, RADII_M, QueryConfig())
    assert regions.centres_map.shape == (0, 3)
    assert regions.pairs.shape == (0, 2)
    assert np.isnan(regions.keyframe_scores).all()


PLAN = """\
name: upper bounds
scenarios: [narrow]
seeds: [10000]
variants:
  - {preset: tunnelcd, oracle_regions: true}
  - {preset: tunnelcd, oracle_merge: {}, oracle_regions: true}
  - {preset: paper, oracle_merge: {noise_m: 0.1}, oracle_regions: true, set: [extract.voxel_m=0.4]}
  - preset: tunnelcd
"""


def plan_of(folder: Path, text: str = PLAN) -> Plan:
    (folder / "plan.yaml").write_text(text)
    return load_plan(str(folder / "plan.yaml"))


def test_oracles_are_named_after_what_they_know(tmp_path: Path) -> None:
    found = expand_cells(plan_of(tmp_path))
    assert [cell.variant for cell in found] == [
        "oracle-regions",
        "oracle-merge+oracle-regions",
        "oracle-merge+oracle-regions[preset=paper,noise_m=0.1,noise_deg=0,extract.voxel_m=0.4]",
        "tunnelcd",
    ]
    assert [cell.oracle_regions for cell in found] == [True, True, True, False]
    assert [is_oracle(cell.variant) for cell in found] == [False, True, True, False]
    assert path_part("oracle-merge+oracle-regions") == "oracle-merge_oracle-regions"
    assert name_variant("tunnelcd", ["a.b=1"], oracle_regions=True) == "oracle-regions[a.b=1]"


def test_a_plan_is_written_as_it_was_read(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    written = plan.model_dump(mode="json")["variants"]
    assert [variant.get("oracle_regions") for variant in written] == [True, True, True, None]
    assert expand_cells(change_plan(plan, seeds="10000:10001"))[1].oracle_regions


@pytest.mark.parametrize(
    ("variant", "rule"),
    [
        (
            "{preset: tunnelcd, oracle_regions: true, set: [query.threshold=1]}",
            "this variant's regions are the truth's",
        ),
        ("{preset: tunnelcd, oracle_regions: true, set: [regions.source=scan]}", "regions.source=scan"),
        ("{preset: tunnelcd, oracle_regions: true, per_scenario: {narrow: [query.n_regions=3]}}", "query.n_regions=3"),
        ("{preset: tunnelcd, oracle_regions: true, oracle_merge: {}, set: [merge.voxel_m=1]}", "merged by the truth"),
    ],
)
def test_settings_that_nothing_reads_are_refused(tmp_path: Path, variant: str, rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        plan_of(tmp_path, PLAN.replace("{preset: tunnelcd, oracle_regions: true}", variant))


def test_clusters_of_a_source_take_no_regions_from_the_truth(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, PLAN.replace("tunnelcd, oracle_regions", "c2c, oracle_regions"))
    with pytest.raises(InputError, match=r"c2c.*oracle_regions: extract.method = clusters"):
        expand_cells(plan)


def test_an_end_at_the_merge_has_no_regions_to_be_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="oracle_regions does nothing: the plan ends at the merge"):
        plan_of(tmp_path, f"until: merge\n{PLAN}".replace(", set: [extract.voxel_m=0.4]", ""))


def test_settings_of_the_query_pass_by_but_for_radius_and_suppression(tmp_path: Path) -> None:
    changed = expand_cells(change_plan(plan_of(tmp_path), settings=["query.threshold=7", "query.radius_m=8"]))
    assert [cell.config.query.radius_m for cell in changed] == [8.0] * 4
    assert [cell.config.query.threshold == 7 for cell in changed] == [False, False, False, True]
    gridded = expand_cells(change_plan(plan_of(tmp_path), grid=["query.threshold=7,8"]))
    assert len(gridded) == 3 + 2
