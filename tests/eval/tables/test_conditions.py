"""Pairs under several odometries and sensors: which the figures are of, and what stands beside them."""

import numpy as np
import pandas as pd
import pytest

from eval.plans.targets import Target, Targets
from eval.tables.conditions import ANY, Condition, by_condition, odometry_of, of_condition, told_apart
from eval.tables.merge_table import ALL_FAMILIES, merge_overview, merge_table
from eval.tables.object_table import object_overview, object_tables
from tests.eval.tables.test_object_table import case, change

KISS, DRIFT = ("kiss-icp", "kiss-icp"), ("drift", "drift")
ASKED = Targets(method="tunnelcd", odometry="kiss-icp", sensor="nominal")


def row(odometry: tuple[str, str], sensor: str, seed: int = 0, **columns: object) -> dict[str, object]:
    label = f"narrow[{odometry[0]},{sensor}]"
    told = {"odometry_before": odometry[0], "odometry_after": odometry[1], "sensor_profile": sensor}
    return case("narrow", seed, **{"scenario": label, **told, **columns})


def test_the_odometry_of_a_pair_is_of_both_sessions() -> None:
    rows = [row(KISS, "a"), row(DRIFT, "a"), row(("kiss-icp", "drift"), "a"), case("narrow", 0)]
    assert odometry_of(pd.DataFrame(rows)).tolist() == ["kiss-icp", "drift", "kiss-icp, drift", ""]
    assert odometry_of(pd.DataFrame([case("narrow", 0)])).tolist() == [""]


def test_the_condition_that_is_asked_for_comes_first_and_rows_that_tell_nothing_are_of_it() -> None:
    rows = [row(DRIFT, "nominal"), row(KISS, "u0"), row(KISS, "nominal"), case("narrow", 3), row(KISS, "nominal", 1)]
    found = [(each, mask.tolist()) for each, mask in by_condition(pd.DataFrame(rows), ASKED)]
    assert found == [
        (Condition("kiss-icp", "nominal"), [False, False, True, True, True]),
        (Condition("drift", "nominal"), [True, False, False, False, False]),
        (Condition("kiss-icp", "u0"), [False, True, False, False, False]),
    ]


def test_without_the_condition_that_is_asked_for_the_first_row_says_which_it_is() -> None:
    rows = pd.DataFrame([row(DRIFT, "u0"), row(DRIFT, "nominal")])
    assert [each for each, _ in by_condition(rows, ASKED)] == [Condition("drift", "u0"), Condition("drift", "nominal")]
    # nothing asked: nothing told apart
    (only,) = by_condition(rows, Targets(method="tunnelcd"))
    assert (only[0], only[1].tolist()) == (Condition(ANY, ANY), [True, True])
    (of_odometry,) = by_condition(rows, Targets(odometry="kiss-icp"))
    assert of_odometry[0] == Condition("drift", ANY)


def test_tables_of_objects_keep_conditions_apart_and_targets_judge_the_one_that_is_asked_for() -> None:
    rows, changes = [], []
    for odometry, sensor, iou in ((DRIFT, "nominal", 0.9), (KISS, "nominal", 0.6), (KISS, "u0", 0.5)):
        for seed in range(4 if sensor == "nominal" else 2):
            # of the first two pairs, those that the other sensor saw too, the nominal one is 0.1 better
            value = iou + (0.1 if seed < 2 else -0.1) * (sensor == "nominal")
            rows.append(row(odometry, sensor, seed, object_iou_point=value))
            changes.append({**change("narrow", seed, 1), "scenario": rows[-1]["scenario"], "iou_point": value})
    asked = (
        Target(column="object_iou_point", name="in", domain="in", at_least=0.6),
        Target(column="object_iou_point", name="u0", sensor="u0", at_least=0.5),
        Target(column="object_iou_point", name="u0 less", sensor="u0", less_sensor="nominal", at_least=-0.19),
        Target(column="object_iou_point", name="g", sensor="g", at_least=0.5),
    )
    found = object_tables(pd.DataFrame(rows), pd.DataFrame(changes), ASKED.model_copy(update={"objects": asked}))
    table = found["objects_table"]
    assert table[["odometry", "sensor", "n_pairs", "n_changes"]].to_numpy().tolist() == [
        ["kiss-icp", "nominal", 4, 4], ["drift", "nominal", 4, 4], ["kiss-icp", "u0", 2, 2],
    ]  # fmt: skip
    np.testing.assert_allclose(table["object_iou_point"], [0.6, 0.9, 0.5])
    assert set(found["objects_by_group"]["odometry"]) == {"kiss-icp", "drift"}
    judged = found["objects_targets"].set_index("target")
    # 0.5 less 0.7 on the same two pairs; of no pair with profile g there is no row
    assert judged.index.tolist() == ["in", "u0", "u0 less"]
    np.testing.assert_allclose(judged["value"].astype(float), [0.6, 0.5, -0.2])
    assert judged["n"].tolist() == [4, 2, 2]
    assert judged["is_met"].tolist() == [True, True, False]
    assert judged["domain"].tolist() == ["in", "u0", "u0"]
    shown = object_overview(table)
    assert shown.columns[:3].tolist() == ["odometry", "sensor", "domain"]
    assert object_overview(of_condition(table, Condition("drift", "nominal"))).columns[0] == "domain"
    assert told_apart(of_condition(table, Condition("kiss-icp", ANY))) == {}


@pytest.mark.parametrize("has_both", [True, False])
def test_merges_are_counted_for_each_kind_and_odometry(*, has_both: bool) -> None:
    def merged(odometry: tuple[str, str], seed: int, p95_m: float) -> dict[str, object]:
        errors = {"merge_error_m": 0.01, "merge_error_deg": 0.1, "merge_error_m_p95": p95_m}
        return row(odometry, "nominal", seed, pair_kind="drift", **errors)

    rows = [merged(KISS, 0, 0.04), merged(KISS, 1, 0.06), *([merged(DRIFT, 0, 0.04)] if has_both else [])]
    targets = Targets(method="tunnelcd", merge={"drift": 0.95})
    table = merge_table(pd.DataFrame(rows), targets)
    own = table[table["family"] == ALL_FAMILIES]
    assert own[["odometry", "n_pairs", "n_within_target", "is_met"]].to_numpy().tolist() == [
        ["kiss-icp", 2, 1, False], *([["drift", 1, 1, True]] if has_both else []),
    ]  # fmt: skip
    assert ("odometry" in merge_overview(pd.DataFrame(rows), targets)) == has_both


def test_the_interval_of_a_sensor_draws_tunnels() -> None:
    rows = [
        {**row(KISS, "u0", seed, object_iou_point=value), "family": family, "scenario": family}
        for seed, value in enumerate((0.5, 0.6, 0.7))
        for family in ("narrow", "dust/narrow")
    ]
    asked = (Target(column="object_iou_point", name="u0", sensor="u0", at_least=0.5),)
    changes = pd.DataFrame([change("narrow", 1, 1)])
    found = object_tables(pd.DataFrame(rows), changes, ASKED.model_copy(update={"objects": asked}))
    judged = found["objects_targets"].iloc[0]
    # one draw of three tunnels in 27 holds the worst alone; of six pairs one in 729 would
    assert (judged["value"], judged["n"]) == (pytest.approx(0.6), 6)
    assert [judged["low"], judged["high"]] == pytest.approx([0.5, 0.7])
