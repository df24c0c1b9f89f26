"""The regions on the page: the tables come first, and the method that leads stands first in the summary."""

import html
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.plans.targets import Target, Targets
from eval.report.page import write_page
from eval.report.regions.budgets import budget_areas, shown_budgets
from eval.report.regions.regions import draw_regions
from eval.report.summary import draw_summary
from eval.running.results.run_data import read_run
from eval.running.runfolder import write_json
from eval.tables.regions.table import FILES, region_tables

TARGETS = Targets(
    method="tunnelcd",
    regions=(
        Target(column="region_auroc", name="AUROC", domain="in", at_least=0.97),
        Target(column="region_recall", name="recall", domain="in", at_least=0.01),
    ),
)
METHODS = ("paper", "voxel-diff", "c2c", "tunnelcd")
# how surely each method tells a change from none, of which its scores are made
SKILL = {"paper": 0.3, "voxel-diff": 2.0, "c2c": 3.0, "tunnelcd": 2.5}


def made_up(
    skill: dict[str, float], families: dict[str, int], n_failed: int = 0
) -> tuple[pd.DataFrame, dict[str, pd.DataFrame]]:
    """Return results and items of a run whose scores are drawn: two changes and six other candidates in every pair."""
    rows, items = [], {name: [] for name in ("changes", "regions", "keyframes")}
    for family, n_pairs in families.items():
        for seed in range(n_pairs):
            draw = np.random.default_rng([seed, len(family)])
            noise, volume = draw.normal(size=48), draw.uniform(0.05, 12, 2)
            for variant, gain in skill.items():
                names = {"scenario": family, "seed": seed, "variant": variant}
                status = "merge_refused" if variant == "paper" and seed < n_failed else "ok"
                is_hit = np.arange(8) < 2
                scores = noise[:8] + gain * is_hit
                order = np.argsort(-scores)
                is_ok = status == "ok"
                if is_ok:
                    items["regions"] += [
                        {**names, "region": place, "score": scores[i], "is_reported": scores[i] > 1.5,
                         "is_withdrawn": False,
                         "outcome": "true" if is_hit[i] else "false", "found_changes": str(i + 1) if is_hit[i] else "",
                         "asked_points": 1000.0}
                        for place, i in enumerate(order)
                    ]  # fmt: skip
                    items["keyframes"] += [
                        {**names, "keyframe": i, "score": value + gain * (i < 8), "label": int(i < 8)}
                        for i, value in enumerate(noise[8:])
                    ]
                found = [bool(is_ok and score > 1.5) for score in scores[:2]]
                items["changes"] += [
                    {**names, "id": i + 1, "is_observable": True, "n_truth_cells": 20, "is_found": found[i],
                     "hull_volume_m3": volume[i], "n_returns": 500 * volume[i], "range_m": 1 + volume[i] / 3}
                    for i in range(2)
                ]  # fmt: skip
                at_k = float(is_hit[order[:2]].mean()) if is_ok else 0.0
                rows.append(
                    {**names, "family": family, "status": status, "error": "", "n_changes": 2, "n_observable": 2,
                     "score_radius_m": 10.0 if "wide" in family else 4.5, "after_path_m": 200.0,
                     "region_auroc": 0.8 if is_ok else np.nan, "region_recall_at_k": at_k,
                     "region_recall": float(np.mean(found)), "region_precision": np.nan,
                     "n_false_regions": int((scores[2:] > 1.5).sum()), "n_found_changes": sum(found),
                     "bytes_map_before": 1.2e6, "bytes_regions_before": 4e4 if variant == "tunnelcd" else 1.2e6,
                     "t_descriptor_per_keyframe_s": 0.011, "t_cd_per_region_s": 0.02, "t_cd_s": 0.1, "t_oe_s": 0.8,
                     "t_oe_per_region_s": 0.4, "n_regions": 2, "n_withdrawn": 0, "is_unchanged_pair": False,
                     "is_alarm": np.nan, "merge_error_m": 0.01, "merge_error_deg": 0.01}
                )  # fmt: skip
    return pd.DataFrame(rows), {name: pd.DataFrame(each) for name, each in items.items()}


def write_run(folder: Path, results: pd.DataFrame, items: dict[str, pd.DataFrame], plan: dict[str, object]) -> Path:
    folder.mkdir()
    results.to_csv(folder / "results.csv", index=False)
    for name, found in {**items, **region_tables(results, items, TARGETS)}.items():
        if len(found):
            found.to_csv(folder / f"{name}.csv", index=False)
    write_json(
        folder / "provenance.json",
        {
            "tool": "tunnelcd",
            "plan": {**plan, "targets": TARGETS.model_dump()},
            "machine": {},
            "command": "tunnelcd run x",
        },
    )
    return folder


def words(page: Path) -> str:
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page.read_text())))


@pytest.fixture(name="run", scope="module")
def run_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    results, items = made_up(SKILL, {"regions/narrow": 12, "regions/wide": 8, "regions/cave": 6}, n_failed=1)
    return write_run(tmp_path_factory.mktemp("page") / "run", results, items, {"name": "made-up", "report": "regions"})


def test_the_summary_puts_the_rival_first_where_it_leads(run: Path) -> None:
    summary = draw_summary(read_run(run), pd.DataFrame())
    table = pd.read_csv(run / "regions_table.csv")
    own = table[table["domain"] == "in"].set_index("variant")["recall_at_0.1"]
    assert own.idxmax() == "c2c"
    group, rows = summary.table.groups()[0]
    assert group.startswith("in distribution")
    assert [(cells[0].text, cells[2].text) for cells in rows[:2]] == [
        (name, f"{value:.2f}") for name, value in own.sort_values(ascending=False)[:2].items()
    ]
    assert "3 of 104 cases" in summary.sentence
    assert "1 of 2 targets" in summary.sentence
    assert summary.sentence.count(".") == 1


def test_tables_and_plots_are_on_the_page_before_anything_else(run: Path) -> None:
    page = write_page(run)
    text = page.read_text()
    assert text.index('id="regions"') < text.index('id="results"')
    part = draw_regions(read_run(run))
    assert part is not None
    assert [len(table.rows) for table in part.tables] == [3 * len(METHODS), 2, 2 * len(METHODS)]
    assert [plot.name for plot in part.plots] == ["roc", "free_response", "budgets", "recall_by_size"]
    assert not part.missing


def test_the_areas_below_the_budgets_stand_best_first(run: Path) -> None:
    table = budget_areas(pd.read_csv(run / "budgets.csv"))
    rows = [(group, cells) for group, cells in table.rows if group == "in distribution"]
    # a tenth of the map's bytes buys something of a method that keeps a thirtieth of them, and nothing of the others
    assert rows[0][1][0].text == "tunnelcd"
    assert rows[0][1][3].is_best and float(rows[0][1][3].text) > 0
    assert {cells[3].text for _, cells in rows[1:]} == {"0.00"}
    # by what is looked at, the rival with better scores leads
    assert [cells[0].text for _, cells in rows if cells[1].is_best] == ["c2c"]


def test_of_sources_crossed_with_rules_one_variant_stands_for_each(run: Path) -> None:
    budgets = pd.read_csv(run / "budgets.csv")
    names = {"c2c": "c2c[extract.method=surface]", "tunnelcd": "tunnelcd[extract.method=surface]"}
    crossed = budgets.replace({"variant": {**names, "paper": "c2c[extract.method=voxel]"}})
    shown = shown_budgets(crossed)
    assert dict(shown["variant"].value_counts()) == dict.fromkeys(names, len(shown) // 2)
    assert set(shown_budgets(budgets)["variant"]) == {*METHODS}
    unknown = budgets.assign(area=np.nan, recall=np.nan)
    assert not any(cell.is_best for _, cells in budget_areas(unknown).rows for cell in cells)


def test_what_is_missed_is_bold_and_what_is_met_is_not(run: Path) -> None:
    part = draw_regions(read_run(run))
    assert part is not None
    verdicts = {(cells[0].text, cells[1].text): cells[-1] for _, cells in part.tables[1].rows}
    cell = verdicts["AUROC (tunnelcd)", "in distribution"]
    assert (cell.text, cell.is_best) == ("missed", True)
    met = [each for each in verdicts.values() if each.text == "met"]
    assert not any(each.is_best for each in met)


def test_a_run_of_another_kind_has_no_such_part(run: Path, tmp_path: Path) -> None:
    results, items = made_up({"tunnelcd": 2.0}, {"narrow": 2})
    other = write_run(tmp_path / "other", results, items, {"name": "other"})
    assert draw_regions(read_run(other)) is None
    assert 'id="regions"' not in write_page(other).read_text()


def test_tables_that_are_not_there_are_named(run: Path, tmp_path: Path) -> None:
    results, items = made_up({"tunnelcd": 2.0}, {"narrow": 2})
    bare = write_run(tmp_path / "bare", results, items, {"name": "x", "report": "regions"})
    for name in FILES:
        (bare / f"{name}.csv").unlink()
    told = words(write_page(bare))
    assert "regions_table.csv is not in the run folder" in told


def test_silence_is_told_of_unchanged_pairs(tmp_path: Path) -> None:
    results, items = made_up({"tunnelcd": 2.0}, {"null/narrow": 4})
    results = results.assign(n_changes=0, n_observable=0, is_unchanged_pair=True, is_alarm=[0, 0, 1, 0])
    items["changes"] = pd.DataFrame()
    items["regions"] = items["regions"].assign(found_changes="")
    items["keyframes"] = items["keyframes"].assign(label=0)
    quiet = write_run(tmp_path / "quiet", results, items, {"name": "x", "report": "regions"})
    part = draw_regions(read_run(quiet))
    assert part is not None
    assert [cell.text for cell in part.tables[1].rows[0][1]] == ["tunnelcd", "0.75", "3 of 4", "0.25", "0.8"]
    assert json.loads((quiet / "provenance.json").read_text())["plan"]["report"] == "regions"
    assert "3 of 4" in words(write_page(quiet))


def test_unchanged_pairs_among_others_are_not_said_to_be_missing(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    is_quiet = results["seed"] == results["seed"].min()
    results.assign(is_unchanged_pair=is_quiet).to_csv(run / "results.csv", index=False)
    told = words(write_page(run))
    n = len(results[is_quiet].drop_duplicates(["scenario", "seed"]))
    assert f"{n} unchanged pairs" in told
    assert "No unchanged pair was run" not in told
