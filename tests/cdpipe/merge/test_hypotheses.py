"""The choice among alignments that passed the gates."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose
from cdpipe.merge.evidence import explain_refusal
from cdpipe.merge.hypotheses import Hypothesis, Start, choose_hypothesis
from cdpipe.merge.walk import Walk
from cdpipe.model.config import MergeConfig

CONFIG = MergeConfig()
GOOD = {"overlap": 1.0, "inlier_share": 1.0, "hessian_ratio": 1.0, "agreement": 1.0, "distinctness": 10.0}
MAPS: Any = (None, SimpleNamespace(positions=np.zeros((1, 3))))


def start(shift_m: float, residual_m: float) -> Start:
    return Start(0, make_pose(translation=(shift_m, 0.0, 0.0)), {"residual_m": residual_m})


@pytest.fixture(autouse=True)
def _judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every start pass the gates, and be a rival of those that are a metre away."""

    def judge(found: Start, *_: object) -> Hypothesis:
        residuals_m = np.array([found.evidence["residual_m"]])
        walk = Walk(np.array([0]), found.before_T_after[None], np.zeros((1, 6, 6)), np.ones(1), residuals_m)
        return Hypothesis(found.before_T_after, walk, GOOD)

    def is_rival(found: Start, accepted: list[Hypothesis], *_: object) -> bool:
        shift_m = found.before_T_after[0, 3]
        return all(abs(each.before_T_after[0, 3] - shift_m) > 1.0 for each in accepted)

    monkeypatch.setattr("cdpipe.merge.hypotheses.judge", judge)
    monkeypatch.setattr("cdpipe.merge.hypotheses._is_rival", is_rival)


def test_an_ambiguity_that_was_found_stays_found() -> None:
    found, judged = choose_hypothesis([start(0.0, 0.02), start(-16.0, 0.021)], MAPS, CONFIG)
    assert found is not None and "repeats itself" in explain_refusal(found.evidence, CONFIG)
    # a later search that finds one of the two alone
    for shift_m in (0.0, -16.0):
        again, more = choose_hypothesis([start(shift_m, 0.02)], MAPS, CONFIG, judged)
        assert again is not None and again.evidence["distinctness"] == pytest.approx(1.05)
        assert len(more) == 2


def test_a_later_start_that_fits_far_better_resolves_it() -> None:
    _, judged = choose_hypothesis([start(0.0, 0.02), start(-16.0, 0.021)], MAPS, CONFIG)
    found, _ = choose_hypothesis([start(8.0, 0.005)], MAPS, CONFIG, judged)
    assert found is not None and found.before_T_after[0, 3] == 8.0
    assert explain_refusal(found.evidence, CONFIG) == ""
