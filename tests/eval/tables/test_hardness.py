"""Where methods break, worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.core.figures import picture
from eval.plans.plan import Plan, load_plan
from eval.report.hardness import draw_hardness
from eval.report.page import write_page
from eval.running.results.run_data import read_run
from eval.running.runfolder import write_json
from eval.tables.columns import UNDEFINED
from eval.tables.hardness import breaking_points, hardness_table

PLAN = """\
name: harder
scenarios: [smoke/one_box]
seeds: "7:9"
variants: [{preset: tunnelcd}, {preset: c2c}]
axes:
  - name: height
    unit: m
    steps: [{value: 1.2, set: before.height_m=1.2}, {value: 0.8}, {value: 0.5, set: before.height_m=0.5}]
  - name: keyframes
    steps: [{value: 1}, {value: 4, method: map.keyframe_spacing_m=4}]
"""
BASE = "smoke/one_box"
TALL, LOW, SPACED = f"{BASE}[before.height_m=1.2]", f"{BASE}[before.height_m=0.5]", "[map.keyframe_spacing_m=4]"


@pytest.fixture(name="plan")
def plan_fixture(tmp_path: Path) -> Plan:
    (tmp_path / "plan.yaml").write_text(PLAN)
    return load_plan(str(tmp_path / "plan.yaml"))


def tables(found: dict[tuple[str, str], tuple[str, str]]) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Two pairs of two changes by world and variant: which changes their candidates find, "x" for a refused pair."""
    results, regions, changes = [], [], []
    for (world, variant), of_pairs in found.items():
        for seed, ids in zip((7, 8), of_pairs, strict=True):
            names = {"scenario": world, "seed": seed, "variant": variant}
            status = "merge_refused" if ids == "x" else "ok"
            results.append({**names, "family": BASE, "status": status, "n_observable": 2, "score_radius_m": 4.5,
                            "after_path_m": 100.0, "region_auroc": 0.5, "object_iou_point": 0.25, "object_f1_50": 0.5,
                            "is_unchanged_pair": False, "metrics_version": 7})  # fmt: skip
            for place, change in enumerate(ids if ids != "x" else ""):
                regions.append({**names, "score": 9.0 - place, "found_changes": change, "is_withdrawn": False})
            truth = {"is_observable": True, "n_truth_cells": 9, "is_found": False}
            changes += [{**names, "id": number, **truth} for number in (1, 2)]
    return pd.DataFrame(results), pd.DataFrame(regions), pd.DataFrame(changes)


EVERY = {
    (TALL, "tunnelcd"): ("12", "12"), (BASE, "tunnelcd"): ("12", "1"), (LOW, "tunnelcd"): ("1", "1"),
    (TALL, "c2c"): ("12", "12"), (BASE, "c2c"): ("1", "x"), (LOW, "c2c"): ("12", "12"),
    (BASE, f"tunnelcd{SPACED}"): ("x", "x"), (BASE, f"c2c{SPACED}"): ("12", "12"),
}  # fmt: skip


def test_recall_at_every_step(plan: Plan) -> None:
    table = hardness_table(*tables(EVERY), plan).set_index(["axis", "variant", "step"]).sort_index()
    assert table.loc[("height", "tunnelcd"), "recall_at_0.1"].tolist() == [1.0, 0.75, 0.5]
    # a refused pair counts as one false region, and 200 m allow none
    assert table.loc[("height", "c2c"), "recall_at_0.1"].tolist() == [1.0, 0.0, 1.0]
    assert table.loc[("height", "c2c"), "n_failed"].tolist() == [0, 1, 0]
    assert table.loc[("keyframes", "tunnelcd"), "recall_at_0.1"].tolist() == [0.75, 0.0]
    assert table.loc[("keyframes", "c2c"), "value"].tolist() == [1, 4]
    assert table["n_pairs"].tolist() == [2] * 10
    low, high = table.loc[("height", "tunnelcd", 2), ["recall_at_0.1_low", "recall_at_0.1_high"]]
    assert (low, high) == (0.5, 1.0)


def test_every_column_of_a_step(plan: Plan) -> None:
    results, *items = tables(EVERY | {(BASE, "c2c"): ("1", "x")})
    # one of the two pairs states each mean, and it differs from pair to pair
    is_first = results["seed"] == 7
    results = results.assign(region_auroc=np.where(is_first, 0.7, 0.9), object_f1_50=np.where(is_first, np.nan, 0.25))
    rows = hardness_table(results, *items, plan).to_dict("records")
    steps = [(axis.name, number, step) for axis in plan.axes for number, step in enumerate(axis.steps, start=1)]
    assert [(row["axis"], row["step"], row["value"]) for row in rows[::2]] == [
        (name, number, step.value) for name, number, step in steps
    ]
    # methods go by their own name at every step, worlds by their settings
    assert [row["variant"] for row in rows] == ["tunnelcd", "c2c"] * 5
    assert [row["scenario"] for row in rows[::2]] == [TALL, BASE, LOW, BASE, BASE]
    assert [row["unit"] for row in rows[::2]] == ["m"] * 3 + [""] * 2
    for row in rows:
        assert (row["n_planned"], row["n_pairs"], row["n_judged"], row["n_observable"]) == (2, 2, 2, 4)
        means = [row[name] for name in ("region_auroc", "object_iou_point", "object_f1_50")]
        assert means == pytest.approx([0.8, 0.25, 0.25])


def test_fewer_seeds_of_the_first_world_are_fewer_planned_pairs(tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").write_text(PLAN.replace("[smoke/one_box]", "[{name: smoke/one_box, n_seeds: 1}]"))
    fewer = load_plan(str(tmp_path / "plan.yaml"))
    assert set(hardness_table(*tables(EVERY), fewer)["n_planned"]) == {1}


def test_a_step_that_was_not_run_counts_nothing(plan: Plan) -> None:
    some = {case: found for case, found in EVERY.items() if case != (LOW, "c2c")}
    table = hardness_table(*tables(some), plan).set_index(["axis", "variant", "step"])
    row = table.loc[("height", "c2c", 3)]
    counts = ["n_pairs", "n_judged", "n_failed", "n_observable"]
    assert row[counts].tolist() == [0, 0, 0, 0] and row["n_planned"] == 2
    assert row[["recall_at_0.1", "region_auroc", "object_iou_point", "object_f1_50"]].isna().all()


def test_a_plan_of_which_nothing_was_run(plan: Plan) -> None:
    table = hardness_table(*tables(EVERY), plan)
    nothing = hardness_table(pd.DataFrame(), pd.DataFrame(), pd.DataFrame(), plan)
    assert nothing["variant"].tolist() == table["variant"].tolist()
    # numbers all the same
    assert nothing["recall_at_0.1"].dtype == table["recall_at_0.1"].dtype == np.float64
    points = breaking_points(nothing)
    # the first step finds nothing, so it says nothing either
    assert points["step"].tolist() == [1] * 4 and not points["is_measured"].any()
    assert points[["recall", "recall_low", "recall_high"]].isna().all(axis=None)
    assert points[["n_judged", "n_failed"]].to_numpy().tolist() == [[0, 0]] * 4
    assert len(breaking_points(pd.DataFrame())) == 0


def test_an_interval_needs_two_tunnels_with_a_change(plan: Plan) -> None:
    results, regions, changes = tables(EVERY)
    one = results["seed"] == 7
    table = hardness_table(
        results.assign(n_observable=np.where(one, 2, 0)), regions, changes[changes["seed"] == 7], plan
    )
    assert table[["recall_at_0.1_low", "recall_at_0.1_high"]].isna().all(axis=None)


def test_no_candidate_and_no_change_at_all_break_no_table(plan: Plan) -> None:
    results, _, changes = tables(dict.fromkeys(EVERY, ("x", "x")))
    empty = pd.DataFrame(columns=["scenario", "seed", "variant"])  # as a run writes a table without rows
    assert hardness_table(results, empty, changes, plan)["recall_at_0.1"].tolist() == [0.0] * 10
    unchanged = results.assign(status="ok", n_observable=0)
    assert hardness_table(unchanged, empty, empty, plan)["recall_at_0.1"].isna().all()


def test_a_false_region_is_paid_for(plan: Plan) -> None:
    # what finds nothing comes first, and 200 m allow none
    found = hardness_table(*tables(EVERY | {(TALL, "c2c"): ("", "12")}), plan)
    results, regions, changes = tables(EVERY)
    worse = regions.copy()
    worse.loc[
        (worse["scenario"] == TALL) & (worse["variant"] == "c2c") & (worse["found_changes"] == "1"), "found_changes"
    ] = ""
    false_first = hardness_table(results, worse, changes, plan)
    assert found.loc[found["variant"].eq("c2c") & found["scenario"].eq(TALL), "recall_at_0.1"].tolist() == [0.5]
    assert false_first.loc[
        false_first["variant"].eq("c2c") & false_first["scenario"].eq(TALL), "recall_at_0.1"
    ].tolist() == [0.0]


def test_breaking_points(plan: Plan) -> None:
    points = breaking_points(hardness_table(*tables(EVERY), plan)).set_index(["axis", "variant"])
    # one half is not below one half
    assert points.loc[("height", "tunnelcd"), ["step", "value", "recall"]].tolist() == [0, "", 0.5]
    # broken at the second step, whatever comes after
    assert points.loc[("height", "c2c"), ["step", "value", "recall"]].tolist() == [2, 0.8, 0.0]
    assert points.loc[("keyframes", "tunnelcd"), ["step", "value", "recall"]].tolist() == [2, 4, 0.0]
    # draws of the answered pair alone find one half: two pairs, of which one failed
    spread = ["recall_low", "recall_high", "n_judged", "n_failed"]
    assert points.loc[("height", "c2c"), spread].tolist() == [0.0, 0.5, 2, 1]
    assert points["is_measured"].all()


def test_the_columns_of_a_breaking_point(plan: Plan) -> None:
    points = breaking_points(hardness_table(*tables(EVERY), plan))
    names = [
        ("height", "m", "tunnelcd"),
        ("height", "m", "c2c"),
        ("keyframes", "", "tunnelcd"),
        ("keyframes", "", "c2c"),
    ]
    assert list(map(tuple, points[["axis", "unit", "variant"]].to_numpy())) == names
    assert list(points.columns) == [
        "axis", "unit", "variant", "step", "value", "recall", "recall_low", "recall_high", "n_judged", "n_failed",
        "is_measured",
    ]  # fmt: skip
    # where it holds, the figures are of the last step
    assert points.iloc[0, 3:].tolist() == [0, "", 0.5, 0.5, 0.5, 2, 0, True]


def test_a_later_step_that_was_not_run_takes_no_verdict_back(plan: Plan) -> None:
    some = {case: found for case, found in EVERY.items() if case != (LOW, "c2c")}
    points = breaking_points(hardness_table(*tables(some), plan)).set_index(["axis", "variant"])
    assert points.loc[("height", "c2c"), "is_measured"] and points.loc[("height", "c2c"), "step"] == 2
    # more pairs than planned are enough, fewer are not
    more = plan.model_copy(update={"seeds": plan.seeds[:1]})
    assert breaking_points(hardness_table(*tables(EVERY), more))["is_measured"].all()


def test_a_step_that_was_not_run_gives_no_verdict(plan: Plan) -> None:
    some = {case: found for case, found in EVERY.items() if case != (BASE, "c2c")}
    points = breaking_points(hardness_table(*tables(some), plan)).set_index(["axis", "variant"])
    assert not points.loc[("height", "c2c"), "is_measured"]
    assert points.loc[("height", "tunnelcd"), "is_measured"]


TOLD = "Holds on most axes: tunnelcd (1), then c2c (0); tunnelcd breaks at keyframes (4)."


def write_run(folder: Path, plan: Plan, found: dict[tuple[str, str], tuple[str, str]]) -> Path:
    folder.mkdir()
    every = tables(found)
    steps = hardness_table(*every, plan)
    points = breaking_points(steps)
    names = ("results", "regions", "changes", "hard", "breaking_points")
    for name, table in zip(names, (*every, steps, points), strict=True):
        if len(table):
            table.to_csv(folder / f"{name}.csv", index=False)
    write_json(folder / "provenance.json", {"tool": "tunnelcd", "plan": plan.model_dump(mode="json"), "machine": {}})
    return folder


def test_the_page_says_first_what_breaks_whom(tmp_path: Path, plan: Plan) -> None:
    run = write_run(tmp_path / "run", plan, EVERY)
    section = draw_hardness(read_run(run))
    assert section is not None
    # what breaks in the scenario as it is breaks on every axis that passes it
    cells = [[(cell.text, cell.interval) for cell in cells] for _, cells in section.table.rows]
    assert cells[0] == [("tunnelcd", ""), ("holds", "0.50"), ("4", "0.00")]
    assert cells[1] == [("c2c", ""), ("0.8 m", "0.00"), ("1", "0.00")]
    assert picture(section.plots[0].drawing)
    page = write_page(run).read_text()
    assert page.index('id="hardness"') < page.index('id="results"')
    assert TOLD in page
    latex = (run / "breaking_points.tex").read_text()
    assert (run / "hard.png").stat().st_size > 1000 and r"\textbf" in latex
    assert r"\begin{tabular}{lrr}" in latex and "scenario" not in latex  # nothing is grouped


def test_the_page_needs_no_lists_of_regions_and_changes(tmp_path: Path, plan: Plan) -> None:
    run = write_run(tmp_path / "run", plan, EVERY)
    for name in ("regions", "changes"):
        (run / f"{name}.csv").unlink()
    assert TOLD in write_page(run).read_text()


def test_pairs_that_are_missing_give_no_verdict(tmp_path: Path, plan: Plan) -> None:
    every = tables(EVERY)
    is_left_out = [(each["scenario"] == BASE) & (each["variant"] == "c2c") & (each["seed"] == 8) for each in every]
    some = [each[~mask] for each, mask in zip(every, is_left_out, strict=True)]
    points = breaking_points(hardness_table(some[0], some[1], some[2], plan)).set_index(["axis", "variant"])
    assert points["is_measured"].to_dict() == {
        ("height", "tunnelcd"): True, ("height", "c2c"): False,
        ("keyframes", "tunnelcd"): True, ("keyframes", "c2c"): False,
    }  # fmt: skip
    run = write_run(tmp_path / "run", plan, {case: found for case, found in EVERY.items() if case[1] != "c2c"})
    section = draw_hardness(read_run(run))
    assert section is not None
    (_, own), (_, missing) = section.table.rows
    assert [cell.text for cell in own] == ["tunnelcd", "holds", "4"]
    assert [cell.text for cell in missing] == ["c2c", UNDEFINED, UNDEFINED]
    points.assign(is_measured=False).reset_index().to_csv(run / "breaking_points.csv", index=False)
    assert "Holds on most axes" not in write_page(run).read_text()


def test_a_step_without_a_change_to_find_gives_no_verdict(plan: Plan) -> None:
    results, regions, changes = tables(EVERY)
    is_low = (results["scenario"] == LOW) & (results["variant"] == "c2c")
    results.loc[is_low, "n_observable"] = 0
    changes = changes[~((changes["scenario"] == LOW) & (changes["variant"] == "c2c"))]
    results.loc[(results["scenario"] == BASE) & (results["seed"] == 8), "n_observable"] = float("nan")  # no world
    changes = changes[~((changes["scenario"] == BASE) & (changes["seed"] == 8))]
    regions = regions[~((regions["scenario"] == BASE) & (regions["seed"] == 8))]
    table = hardness_table(results, regions, changes, plan)
    of_c2c = table[(table["axis"] == "height") & (table["variant"] == "c2c")]
    assert of_c2c["n_observable"].tolist() == [4, 2, 0]
    assert of_c2c[["n_pairs", "n_judged"]].to_numpy().tolist() == [[2, 2], [2, 1], [2, 2]]
    points = breaking_points(table).set_index(["axis", "variant"])
    # a pair whose world could not be built is no pair, and at the third step nobody could see a change
    assert points["is_measured"].to_dict() == dict.fromkeys(points.index, False)
    assert points.loc[("height", "tunnelcd"), "n_judged"] == 2  # at the last step; the second one lacks a pair


def test_a_plan_without_axes_has_no_such_section(tmp_path: Path, plan: Plan) -> None:
    run = write_run(tmp_path / "run", plan.model_copy(update={"axes": ()}), EVERY)
    assert draw_hardness(read_run(run)) is None
    assert '<h2 id="hardness">' not in write_page(run).read_text()
