"""From the evidence of right and wrong merges to the gates."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.merge.evidence import GATES
from eval.core.figures import picture
from eval.studies.merge_gates import (
    draw_gates,
    main,
    pass_gates,
    read_committed_thresholds,
    require_ungated,
    suggest_threshold,
    tabulate_gates,
    tabulate_merges,
)

NAN = float("nan")
ASKED = {"overlap": 0.2, "inlier_share": 0.8, "hessian_ratio": 0.01, "agreement": 0.8, "distinctness": 1.3}
GOOD = {"overlap": 0.5, "inlier_share": 0.9, "hessian_ratio": 0.1, "agreement": 0.9, "distinctness": 10.0}
# kind, error in metres, what is not as in GOOD
CASES = (
    ("clean", 0.01, {}),
    ("clean", 0.02, {"overlap": 0.1}),  # right, refused by the overlap alone
    ("drift", 0.4, {"inlier_share": 0.7, "agreement": 0.7}),  # right, refused by two gates
    ("smooth", 9.0, {"hessian_ratio": 0.001}),  # wrong, refused by the ratio alone
    ("smooth", 0.6, {"hessian_ratio": NAN}),  # wrong, the ratio could not be measured
    ("disjoint", NAN, {"agreement": 0.1, "overlap": 0.0}),  # wrong
    ("disjoint", NAN, {"agreement": 0.85}),  # wrong, and let through
)


UNGATED = "tunnelcd[merge.accept_all=true]"


def provenance(setting: str) -> dict[str, object]:
    variants = [{"preset": "tunnelcd", "set": [setting]}]
    return {"plan": {"name": "gates", "scenarios": ["smoke/one_box"], "seeds": [1], "variants": variants}}


def table_of(cases: tuple[tuple[str, float, dict[str, float]], ...] = CASES) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "scenario": f"merge/{kind}",
                "seed": seed,
                "variant": "all",
                "status": "ok",
                "pair_kind": kind,
                "merge_error_m": metres,
                "merge_error_deg": metres,
                **{f"evidence_{name}": value for name, value in (GOOD | other).items()},
            }
            for seed, (kind, metres, other) in enumerate(cases, 10_000)
        ]
    )


def test_counts_by_hand() -> None:
    cases = tabulate_merges(table_of(), "")
    assert cases["right"].tolist() == [True, True, True, False, False, False, False]
    table = tabulate_gates(cases, ASKED).set_index("gate")
    assert set(table["n_right"]) == {3}
    assert set(table["n_wrong"]) == {4}
    names = [name for name, _ in GATES]
    assert table.loc[names, "n_right_refused"].to_dict() == dict(zip(names, (1, 1, 0, 1, 0), strict=True))
    assert table.loc[names, "n_right_refused_alone"].to_dict() == dict(zip(names, (1, 0, 0, 0, 0), strict=True))
    assert table.loc[names, "n_wrong_refused"].to_dict() == dict(zip(names, (1, 0, 2, 1, 0), strict=True))
    assert table.loc[names, "n_wrong_refused_alone"].to_dict() == dict(zip(names, (0, 0, 2, 0, 0), strict=True))
    assert table.loc["all", ["n_right_refused", "n_wrong_refused", "n_wrong_let_through"]].tolist() == [2, 3, 1]
    assert table.loc["overlap", ["worst_right", "best_wrong"]].tolist() == [0.1, 0.5]
    assert pass_gates(cases, ASKED).tolist() == [True, *[False] * 5, True]


def test_gates_judge_together_as_the_sum_of_single_merges() -> None:
    draw = np.random.default_rng(1)
    rows = tuple(
        (
            str(draw.choice(["clean", "disjoint"])),
            float(draw.uniform(0, 1)),
            {name: float(draw.uniform(0, 1.6 * ASKED[name])) for name in GOOD},
        )
        for _ in range(60)
    )
    cases = tabulate_merges(table_of(rows), "all")
    passed = [all(row[name] >= ASKED[name] for name in ASKED) for row in cases.to_dict("records")]
    assert pass_gates(cases, ASKED).tolist() == passed
    every = tabulate_gates(cases, ASKED).set_index("gate").loc["all"]
    assert every["n_wrong_let_through"] == sum(p and not r for p, r in zip(passed, cases["right"], strict=True))


@pytest.mark.parametrize(
    ("right", "wrong", "logarithmic", "expected"),
    [
        ([0.9, 0.95], [0.5, 0.7], False, (0.8, True)),
        ([0.1, 0.4], [0.001], True, (0.01, True)),
        ([0.1, 0.4], [0.0], True, (0.05, True)),
        # the middle, 0.80005, would be rounded onto the wrong one
        ([0.8001], [0.8], False, (0.80005, True)),
        ([0.9, 0.95, NAN], [], False, (0.9, False)),
        ([0.9, 0.95], [0.92, NAN], False, (0.9, False)),
    ],
)
def test_suggested_threshold(
    right: list[float], wrong: list[float], logarithmic: bool, expected: tuple[float, bool]
) -> None:
    value, is_separable = suggest_threshold(np.array(right), np.array(wrong), logarithmic=logarithmic)
    assert value == pytest.approx(expected[0], abs=1e-12)
    assert is_separable == expected[1]


def test_suggestion_keeps_at_least_199_of_200() -> None:
    right = np.arange(1, 1001) / 1000
    value, is_separable = suggest_threshold(right, np.array([0.5]), logarithmic=False)
    assert not is_separable
    assert value == 0.006
    assert (right >= value).mean() == 0.995
    assert np.isnan(suggest_threshold(np.zeros(0), right, logarithmic=False)[0])


def test_committed_thresholds_are_the_presets() -> None:
    assert set(read_committed_thresholds()) == {name for name, _ in GATES}
    thresholds = read_committed_thresholds()
    assert all(0 < value < 1 for name, value in thresholds.items() if name != "distinctness")
    assert thresholds["distinctness"] > 1


def test_only_accepted_merges_of_the_named_variant_count() -> None:
    results = table_of()
    results.loc[0, "status"] = "failed"
    results = pd.concat([results, results.assign(variant="other")])
    with pytest.raises(InputError, match="all, other"):
        tabulate_merges(results, "")
    assert len(tabulate_merges(results, "all")) == len(CASES) - 1


def test_results_without_evidence_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="evidence_agreement") as caught:
        tabulate_merges(table_of().drop(columns="evidence_agreement"), "")
    assert "\n" not in str(caught.value)


def test_every_merge_is_drawn_on_the_row_of_its_kind_beside_the_gate() -> None:
    cases = tabulate_merges(table_of(), "")
    drawing = draw_gates(cases, tabulate_gates(cases, ASKED))
    panels = [panel for row in drawing.rows for panel in row]
    assert len(panels) == len(GATES)
    for panel, (name, _) in zip(panels, GATES, strict=True):
        (gate,) = (each for each in panel.series if each.name == "gate")
        assert list(gate.x) == [ASKED[name]] * 2
        for word, is_right in (("right merge", True), ("wrong merge", False)):
            own = [each for each in panel.series if each.name == word]
            assert sum(len(np.ravel(each.x)) for each in own) == (cases["right"] == is_right).sum()
        rows = {round(float(y)) for each in panel.series if not each.look.width for y in np.ravel(each.y)}
        assert rows == set(range(cases["kind"].nunique()))


def test_one_kind_of_outcome_alone_can_be_drawn() -> None:
    for chosen in (CASES[:2], CASES[3:4], (("", 0.1, {}),)):
        cases = tabulate_merges(table_of(chosen), "")
        assert len(picture(draw_gates(cases, tabulate_gates(cases, ASKED))).axes) >= len(GATES)


def test_the_command_writes_table_and_plot_and_names_what_slips_through(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table_of().assign(variant=UNGATED).to_csv(tmp_path / "results.csv", index=False)
    (tmp_path / "provenance.json").write_text(json.dumps(provenance("merge.accept_all=true")))
    main(tmp_path, tmp_path / "out", "")
    told = capsys.readouterr().out
    written = pd.read_csv(tmp_path / "out" / "gates.csv")
    assert written["gate"].tolist() == [*(name for name, _ in GATES), "all"]
    assert (tmp_path / "out" / "gates.png").read_bytes().startswith(b"\x89PNG")
    passed = pass_gates(tabulate_merges(table_of(), ""), read_committed_thresholds())
    assert f"wrong, but let through: {int(passed[3:].sum())}" in told
    with pytest.raises(InputError, match=r"results\.csv"):
        main(tmp_path / "nowhere", tmp_path / "out", "")


def test_merges_that_a_gate_has_sifted_are_refused() -> None:
    results = table_of().assign(variant=UNGATED, error="")
    require_ungated(results, UNGATED, provenance("merge.accept_all=true"))
    # nothing to register is no gate
    results.loc[1, ["status", "error"]] = ["merge_refused", "too few points"]
    require_ungated(results, UNGATED, provenance("merge.accept_all=true"))
    results.loc[2, ["status", "error"]] = ["merge_refused", "it can slide; merge.min_hessian_ratio asks for 0.01"]
    with pytest.raises(InputError, match=r"merge/drift, seed 10002: refused by merge.min_hessian_ratio"):
        require_ungated(results, UNGATED, provenance("merge.accept_all=true"))


@pytest.mark.parametrize("told", [{}, {"plan": {"name": "merge-gates"}}, "merge.accept_all=false", "merge.refine=none"])
def test_a_variant_that_is_not_told_to_accept_all_is_refused(told: str | dict[str, object]) -> None:
    document = provenance(told) if isinstance(told, str) else told
    variant = f"tunnelcd[{told}]" if isinstance(told, str) else UNGATED
    with pytest.raises(InputError, match=r"merge.accept_all=true") as caught:
        require_ungated(table_of().assign(variant=variant), variant, document)
    assert "\n" not in str(caught.value)


def test_a_wrong_folder_ends_with_code_two(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "eval.studies.merge_gates", str(tmp_path), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
