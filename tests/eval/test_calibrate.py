import numpy as np
import pandas as pd
import pytest

from cdpipe.errors import InputError
from eval.calibrate import alarm_threshold, thresholds


def test_five_per_cent_of_forty_pairs_alarm() -> None:
    # 40 pairs may give two alarms: the threshold lies just above the third best score, 0.38
    scores = np.arange(1, 41) / 100
    threshold = alarm_threshold(scores)
    assert threshold == pytest.approx(0.3801)
    assert (scores >= threshold).sum() == 2


def test_nineteen_pairs_allow_no_alarm() -> None:
    scores = np.linspace(100, 1234.56, 19)
    assert alarm_threshold(scores) == 1235.0
    assert alarm_threshold(np.array([1235.0])) == 1236.0


def test_pairs_without_candidates_count_as_silent() -> None:
    assert alarm_threshold(np.full(5, -np.inf)) == 0.0
    with pytest.raises(ValueError, match="at least one pair"):
        alarm_threshold(np.zeros(0))


def _results(n_changes: int = 0) -> pd.DataFrame:
    rows = [("unchanged/a", seed, "m", "ok" if seed else "merge_refused", n_changes) for seed in range(4)]
    return pd.DataFrame(rows, columns=["scenario", "seed", "variant", "status", "n_changes"])


def test_a_table_by_hand() -> None:
    # seed 0 was refused, seed 3 has no candidate; the best of the others is 5
    regions = pd.DataFrame(
        [("unchanged/a", 1, "m", 5.0), ("unchanged/a", 1, "m", 4.0), ("unchanged/a", 2, "m", 3.0)],
        columns=["scenario", "seed", "variant", "score"],
    )
    row = thresholds(_results(), regions).iloc[0]
    assert (row["variant"], row["n_pairs"], row["n_alarms"], row["n_unanswered"]) == ("m", 3, 0, 1)
    assert row["threshold"] == pytest.approx(5.001)


def test_changed_pairs_are_refused() -> None:
    with pytest.raises(InputError, match="unchanged/a: has changes"):
        thresholds(_results(n_changes=1), pd.DataFrame(columns=["scenario", "seed", "variant", "score"]))
