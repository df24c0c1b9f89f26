"""What a setting of the world does, by hand."""

import math

import numpy as np
import pandas as pd
import pytest

from eval.core.statistics import ENOUGH_PAIRS, bootstrap_interval
from eval.report.settings.effects import signed
from eval.tables.columns import RESULT_COLUMNS
from eval.tables.effects import COLUMNS, effects

NAN = float("nan")
QUIET = "n[sensor.range_noise=false]"


def results() -> pd.DataFrame:
    # not in the order of the seeds, one seed in one world only, one number undefined in one world only
    rows = [
        ("n", 2, "ours", 0.50, NAN),
        ("n", 0, "ours", 0.25, 1.0),
        ("n", 1, "ours", 1.00, 2.0),
        ("n", 0, "theirs", 0.0, 1.0),
        (QUIET, 0, "ours", 0.50, 5.0),
        (QUIET, 1, "ours", 0.75, NAN),
        (QUIET, 2, "ours", 1.00, 7.0),
        (QUIET, 3, "ours", 0.00, 9.0),
        (QUIET, 0, "foreign", 1.0, 9.0),
        ("alone[a=1]", 0, "ours", 0.3, 1.0),
    ]
    frame = pd.DataFrame(rows, columns=["scenario", "seed", "variant", "region_recall", "merge_error_m"])
    return frame.assign(family="n", preset="p", status="ok", error="", commit="c", t_total_s=1.0)


def test_paired_differences_by_hand() -> None:
    found = effects(results()).set_index("metric")
    assert tuple(found.columns) == tuple(name for name in COLUMNS if name != "metric")
    # neither times nor names; neither the variant without a partner nor the world without one
    assert found.index.tolist() == ["region_recall", "merge_error_m"]
    recall = found.loc["region_recall"]
    assert recall[["reference", "settings", "variant"]].tolist() == ["n", "sensor.range_noise=false", "ours"]
    # seed 0: 0.25 -> 0.5, seed 1: 1.0 -> 0.75, seed 2: 0.5 -> 1.0; seed 3 has no partner
    assert recall["n"] == 3
    assert recall["difference"] == pytest.approx((0.25 - 0.25 + 0.5) / 3)
    assert (recall["without"], recall["with"]) == (pytest.approx(1.75 / 3), pytest.approx(2.25 / 3))
    assert tuple(recall[["low", "high"]]) == bootstrap_interval(np.array([0.25, -0.25, 0.5]))
    # only seed 0 has both: 1 -> 5, and the means are over it alone
    error = found.loc["merge_error_m"]
    assert tuple(error[["without", "with", "difference", "n"]]) == (1.0, 5.0, 4.0, 1)
    assert math.isnan(error["low"])


def test_a_pair_is_its_own_control() -> None:
    """Where a setting adds 0.1 to each pair, the interval is a point, however much the pairs differ."""
    draws = np.linspace(0.0, 0.8, 9)
    frames = [
        pd.DataFrame({"scenario": name, "seed": range(9), "variant": "v", "m": draws + shift})
        for name, shift in (("n", 0.0), ("n[a=1]", 0.125))
    ]
    (row,) = effects(pd.concat(frames, ignore_index=True)).to_dict("records")
    assert (row["difference"], row["low"], row["high"]) == pytest.approx((0.125, 0.125, 0.125))


def test_without_partners_there_is_no_row() -> None:
    alone = results().query("scenario == 'n'")
    assert effects(alone).empty
    assert tuple(effects(alone).columns) == COLUMNS
    nothing = effects(results().assign(merge_error_m=NAN)).set_index("metric").loc["merge_error_m"]
    assert nothing["n"] == 0
    assert nothing[["without", "with", "difference", "low", "high"]].isna().all()


def test_truth_values_count_as_one_and_nothing() -> None:
    frame = results().assign(is_alarm=[True, None, False, None, True, False, None, None, None, None])
    # seed 1: False -> False; seeds 0 and 2 have one number each
    row = effects(frame).set_index("metric").loc["is_alarm"]
    assert (row["n"], row["difference"]) == (1, 0.0)


@pytest.mark.parametrize(
    ("value", "text"), [(0.126, "+0.13"), (-0.126, "\u22120.13"), (0.004, "0.00"), (-0.0, "0.00"), (NAN, "\u2013")]
)
def test_differences_carry_a_sign(value: float, text: str) -> None:
    column = next(column for column in RESULT_COLUMNS if column.key == "region_recall")
    assert signed(column, value) == text


def test_enough_pairs_are_those_that_seldom_agree_by_chance() -> None:
    def chance(n: int) -> float:
        return 2 * 0.5**n

    assert chance(ENOUGH_PAIRS) < 0.05 < chance(ENOUGH_PAIRS - 1)
