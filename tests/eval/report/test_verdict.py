"""Who wins where, by how much and at what cost: worked out by hand, simple baselines said first."""

import math
from pathlib import Path

import pandas as pd
import pytest

from eval.report.verdict import contenders, is_judged, verdict_sentences, wins
from eval.running.run_data import RunData
from eval.running.runfolder import RunFolder

N_PAIRS = 8


def row(name: str, seed: int, iou: float, **more: object) -> dict[str, object]:
    return {
        "scenario": "narrow", "family": "narrow", "seed": seed, "variant": name, "status": "ok", "n_observable": 2,
        "is_unchanged_pair": False, "object_iou_point": iou, "region_recall": 0.5, "region_auroc": 0.5,
        "false_regions_per_100m": 0.25, "t_total_s": 2.0, "bytes_regions_before": 40_000.0, "after_path_m": 500.0,
        **more,
    }  # fmt: skip


def run(methods: dict[str, list[float]], **more: object) -> RunData:
    rows = [row(name, seed, iou, **more) for name, values in methods.items() for seed, iou in enumerate(values)]
    return RunData(RunFolder(Path("nowhere")), tuple(rows), (), (), {}, ())


def told(data: RunData) -> str:
    return "\n".join(verdict_sentences(data))


def test_the_margin_is_paired_and_a_steady_one_is_beyond_noise() -> None:
    base = [0.1 * seed for seed in range(N_PAIRS)]
    # 0.2 ahead on every pair, although the pairs themselves differ by more
    data = run({"tunnelcd": [value + 0.2 for value in base], "voxel-diff": base})
    words = told(data)
    assert (
        "In distribution, object IoU: tunnelcd is best with 0.55, 0.20 ahead of voxel-diff (0.35); "
        "pair by pair +0.20 to +0.20 over 8 pairs."
    ) in words
    assert "won: tunnelcd 1 (1 beyond noise); 2 won by none alone." in words
    assert "A simple baseline is as good as the best method in region recall in distribution and AUROC" in words


def test_a_margin_that_chance_could_make_is_said_to_be_one() -> None:
    up, down = [0.9, 0.1] * 4, [0.1, 0.84] * 4
    words = told(run({"tunnelcd": up, "voxel-diff": down}))
    assert "tunnelcd is best with 0.50, 0.03 ahead of voxel-diff (0.47)" in words
    assert "no more than chance could do" in words
    few = told(run({"tunnelcd": [0.9] * 3, "voxel-diff": [0.1] * 3}))
    assert "over 3 pairs, no more than chance could do" in few


def test_a_winning_baseline_is_the_first_thing_said() -> None:
    first = verdict_sentences(run({"tunnelcd": [0.5] * N_PAIRS, "c2c": [0.7] * N_PAIRS}))[0]
    assert first == (
        "A simple baseline wins: c2c in object IoU in distribution (0.70 against 0.50 of tunnelcd)."
    )  # fmt: skip
    alone = verdict_sentences(run({"tunnelcd": [0.5] * N_PAIRS, "paper": [0.7] * N_PAIRS}))[0]
    assert alone == "No simple baseline was run, so nothing here shows that a method is worth its effort."


def test_costs_and_false_regions_stand_beside_the_wins() -> None:
    rows = [
        *(row("tunnelcd", seed, 0.9, region_recall=1.0, t_total_s=float(seed)) for seed in range(5)),
        *(row("voxel-diff", seed, 0.1, bytes_regions_before=1.2e6, false_regions_per_100m=2.0) for seed in range(5)),
    ]  # fmt: skip
    words = told(RunData(RunFolder(Path("nowhere")), tuple(rows), (), (), {}, ()))
    # the median of 0, 1, 2, 3, 4 seconds
    assert "In distribution, a pair costs: tunnelcd 2 s and 40 kB kept; voxel-diff 2 s and 1200 kB kept." in words
    assert "False regions per 100 m: tunnelcd 0.25, voxel-diff 2.00." in words


def test_who_is_told_the_truth_or_ran_fewer_pairs_does_not_win() -> None:
    data = run({"oracle-merge": [1.0] * 8, "few": [1.0] * 2, "tunnelcd": [0.6] * 8, "c2c": [0.5] * 8})
    assert "object IoU: tunnelcd is best with 0.60" in told(data)
    cases = pd.DataFrame([{**each, "domain": "in"} for each in data.results if each["variant"] != "oracle-merge"])
    assert {name for win in wins(cases) for name in (*win.winners, win.second)} == {"tunnelcd", "c2c", ""}


def test_settings_of_a_method_do_not_compete_with_plain_methods() -> None:
    names = pd.DataFrame({"variant": ["tunnelcd", "tunnelcd[query.radius_m=3]", "c2c", "oracle-regions"]})
    assert contenders(names) == ["tunnelcd", "c2c"]
    assert contenders(names.iloc[:2]) == ["tunnelcd", "tunnelcd[query.radius_m=3]"]


def test_failures_refusals_and_silence_are_counted() -> None:
    data = run({"tunnelcd": [0.5] * 6, "c2c": [0.4] * 6})
    calm = [
        {**row(name, seed, math.nan), "scenario": "null/narrow", "is_unchanged_pair": True, "is_alarm": is_alarm,
         "status": status}
        for name, seed, is_alarm, status in (("tunnelcd", 0, False, "ok"), ("tunnelcd", 1, math.nan, "merge_refused"),
                                             ("c2c", 0, True, "ok"), ("c2c", 1, False, "ok"))
    ]  # fmt: skip
    words = told(RunData(data.folder, (*data.results, *calm), (), (), {}, ()))
    assert "Silent where nothing changed (1 km): tunnelcd 1 of 2 (1 without an answer), c2c 1 of 2." in words
    assert "1 of 16 cases gave no answer" in words


@pytest.mark.parametrize(("n_pairs", "names", "expected"), [(2, "ab", True), (1, "ab", False), (2, "a", False)])
def test_one_pair_or_one_method_is_no_verdict(n_pairs: int, names: str, *, expected: bool) -> None:
    assert is_judged(run({name: [0.5] * n_pairs for name in names})) is expected


def test_a_world_that_could_not_be_made_misses_nothing() -> None:
    data = run({"tunnelcd": [0.5] * 6, "c2c": [0.4] * 6})
    lost = [row(name, 9, math.nan, status="failed", n_observable=math.nan) for name in ("tunnelcd", "c2c")]
    words = told(RunData(data.folder, (*data.results, *lost), (), (), {}, ()))
    assert "2 of 14 cases could not be judged" in words
    assert "count as found nothing" not in words


def test_another_merge_before_the_same_comparison_is_no_rival_and_the_paper_is_named() -> None:
    methods = {"tunnelcd": [0.9] * 8, "kiss-matcher": [0.8] * 8, "c2c": [0.5] * 8, "paper": [0.1] * 8}
    words = told(run(methods))
    assert "object IoU: tunnelcd is best with 0.90, 0.40 ahead of c2c (0.50)" in words
    assert "The paper's method: 0.10." in words
    del methods["tunnelcd"]
    assert "object IoU: kiss-matcher is best with 0.80" in told(run(methods))
