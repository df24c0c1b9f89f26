"""The objects on the page: which are drawn, why one was missed, and that every table says what the files say."""

import html
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.plans.targets import Target, Targets
from eval.report.objects.cases import N_WORST, chosen_cases, voxel_variants, why
from eval.report.objects.report import draw_objects
from eval.report.objects.tables import OBJECT_COLUMNS, OBJECT_COUNTS, WITHDRAWAL_COLUMNS
from eval.report.page import write_page
from eval.report.tables import methods_table
from eval.running.results.run_data import RunData, figures_of_plan, read_run
from eval.running.runfolder import RunFolder, write_json
from eval.tables.object_table import FILES, ORACLE_VARIANT, object_tables
from eval.tables.rows import with_domain

NAN = float("nan")
VOXEL = "tunnelcd[extract.method=voxel,extract.voxel_m=0.65]"
TARGETS = Targets(
    method="tunnelcd",
    objects=(
        Target(column="object_iou_point", name="IoU", domain="in", at_least=0.5),
        Target(column="object_f1_50", name="F1", domain="in", at_least=0.99),
    ),
)
SKILL = {"tunnelcd": 0.8, VOXEL: 0.4, "tunnelcd[extract.method=nearest]": 0.6, ORACLE_VARIANT: 0.9}


def change(number: int, iou: float, **columns: object) -> dict[str, object]:
    return {
        "scenario": "narrow", "seed": 1, "variant": "tunnelcd", "id": number, "group": "full", "iou_point": iou,
        "n_truth_cells": 20, "matched_object": 0 if iou > 0 else -1, "is_found": iou > 0, **columns,
    }  # fmt: skip


def numbers_of(rows: list[dict[str, object]]) -> list[tuple[str, int]]:
    return [(words, row["id"]) for words, row in chosen_cases(rows)]


def test_best_median_and_worst_by_hand() -> None:
    rows = [change(n, iou) for n, iou in enumerate([0.5, 0.0, 0.9, 0.7, 0.2], start=1)]
    rows += [change(6, 0.99, group="partial"), change(7, NAN)]
    assert numbers_of(rows) == [("Best", 3), ("Median", 1), ("Worst 1", 2), ("Worst 2", 5), ("Worst 3", 4)]
    assert numbers_of(rows[:1]) == [("Best", 1)]
    assert numbers_of(rows[5:]) == []
    many = [change(n, 0.01 * n) for n in range(1, 31)]
    assert numbers_of(many)[2:] == [(f"Worst {n}", n) for n in range(1, N_WORST + 1)]


def test_of_equally_bad_ones_the_larger_is_worse() -> None:
    rows = [change(1, 0.0, n_truth_cells=5), change(2, 0.0, n_truth_cells=50), change(3, 0.5), change(4, 0.9)]
    assert numbers_of(rows)[2:] == [("Worst 1", 2), ("Worst 2", 1)]


@pytest.mark.parametrize(
    ("row", "region", "status", "words"),
    [
        ({"matched_object": 3}, {}, "ok", ""),
        ({}, {}, "merge_refused", "no answer: merge refused"),
        ({"is_found": True}, {}, "ok", "its region holds no object that overlaps it"),
        ({}, {"found_changes": "2;7", "is_withdrawn": True}, "ok", "its region was withdrawn"),
        ({}, {"found_changes": 7.0, "is_withdrawn": False}, "ok", "its region was below the threshold"),
        ({}, {"found_changes": "17", "is_withdrawn": True}, "ok", "no candidate region finds it"),
        ({}, {"found_changes": NAN, "is_withdrawn": True}, "ok", "no candidate region finds it"),
    ],
)
def test_why_an_object_was_missed(
    tmp_path: Path, row: dict[str, object], region: dict[str, object], status: str, words: str
) -> None:
    names = {"scenario": "narrow", "seed": 1, "variant": "tunnelcd"}
    data = RunData(RunFolder(tmp_path), ({**names, "status": status},), (), ({**names, **region},), {}, ())
    assert why(data, change(7, 0.0, **row)) == words


def made_up(n_pairs: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return results and changes of a run whose IoU are drawn about each method's skill: three objects a pair."""
    rows, changes = [], []
    for family in ("regions/narrow", "regions/cave"):
        for seed in range(n_pairs):
            noise = np.random.default_rng([seed, len(family)]).normal(size=3)
            for variant, skill in SKILL.items():
                names = {"scenario": family, "seed": seed, "variant": variant}
                iou = np.clip(skill + 0.1 * noise - 0.2 * (family == "regions/cave"), 0, 1)
                rows.append(
                    {**names, "family": family, "status": "ok", "error": "", "n_changes": 3, "n_observable": 3,
                     "is_unchanged_pair": False, "is_alarm": NAN, "after_path_m": 200.0, "object_iou_point": iou.mean(),
                     "object_iou_voxel": iou.mean() - 0.1, "object_f1_25": 1.0, "object_f1_50": 0.9,
                     "object_precision_50": 1.0, "object_iou_point_partial": NAN, "n_partial": 0,
                     "kind_accuracy": 1.0, "region_auroc": 1.0,
                     "region_recall": 0.5, "region_recall_proposed": 1.0, "n_withdrawn": 1, "t_oe_s": 0.006,
                     "false_regions_per_100m": 0.0, "false_regions_per_100m_proposed": 0.5, "t_returns_s": 0.002,
                     "t_oe_per_region_s": 0.003, "score_radius_m": 4.5, "merge_error_m": 0.01, "merge_error_deg": 0.1}
                )  # fmt: skip
                changes += [
                    {**names, "id": index + 1, "group": "full", "prop_kind": ("box", "muck_pile", "chair")[index],
                     "hull_volume_m3": (0.2, 4.0, 0.6)[index], "iou_point": iou[index], "matched_object": index,
                     "is_found": True, "is_kind_right": 1.0, "n_truth_cells": 50, "is_observable": True,
                     "displacement_error_m": 0.02 if index == 0 else NAN,
                     "volume_error_share": -0.1 if variant != VOXEL else NAN}
                    for index in range(3)
                ]  # fmt: skip
    return pd.DataFrame(rows), pd.DataFrame(changes)


@pytest.fixture(name="run", scope="module")
def run_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page") / "run"
    folder.mkdir()
    results, changes = made_up(6)
    results.to_csv(folder / "results.csv", index=False)
    for name, table in {"changes": changes, **object_tables(results, changes, TARGETS)}.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    plan = {"name": "made-up", "report": "objects", "targets": TARGETS.model_dump()}
    write_json(
        folder / "provenance.json", {"tool": "tunnelcd", "plan": plan, "machine": {}, "command": "tunnelcd run x"}
    )
    return folder


def test_the_section_says_what_the_tables_say(run: Path) -> None:
    part = draw_objects(read_run(run))
    assert part is not None
    table = pd.read_csv(run / "objects_table.csv")
    own = table[(table["domain"] == "in") & (table["variant"] == "tunnelcd")].iloc[0]
    first = part.tables[0].rows[0][1]
    assert (first[0].text, first[2].text) == ("tunnelcd", f"{own['object_iou_point']:.2f}")
    assert [cells[-1].text for _, cells in part.tables[2].rows] == ["met", "missed"]
    # methods, withdrawal, targets, and kinds and sizes of either domain
    assert [len(each.rows) for each in part.tables] == [12, 12, 2, 6, 6]
    assert len(part.plots) == 1


def test_the_figures_are_those_of_one_odometry_and_the_other_stands_beside_them(run: Path, tmp_path: Path) -> None:
    results, changes = made_up(6)
    own = results.assign(odometry_before="drift", odometry_after="drift")
    kiss = results.assign(odometry_before="kiss-icp", odometry_after="kiss-icp")
    kiss = kiss.assign(object_iou_point=kiss["object_iou_point"] - 0.3)
    of_kiss = {"scenario": results["scenario"] + "[odometry=kiss-icp]"}
    every = pd.concat([own, kiss.assign(**of_kiss)], ignore_index=True)
    both = pd.concat([changes, changes.assign(scenario=changes["scenario"] + "[odometry=kiss-icp]")], ignore_index=True)
    targets = TARGETS.model_copy(update={"odometry": "kiss-icp"})
    folder = tmp_path / "run"
    folder.mkdir()
    for name, table in {"results": every, "changes": both, **object_tables(every, both, targets)}.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    plan = {"name": "made-up", "report": "objects", "targets": targets.model_dump()}
    write_json(folder / "provenance.json", {"tool": "tunnelcd", "plan": plan, "machine": {}, "command": "tunnelcd run"})
    data = figures_of_plan(read_run(folder))
    assert (len(data.results), len(data.others)) == (len(kiss), len(own))
    assert all(row["odometry_before"] == "kiss-icp" for row in data.results)
    part, plain = draw_objects(data), draw_objects(figures_of_plan(read_run(run)))
    assert part is not None and plain is not None
    mean = kiss[(kiss["variant"] == "tunnelcd") & (kiss["family"] == "regions/narrow")]["object_iou_point"].mean()
    assert part.tables[0].rows[0][1][2].text == f"{mean:.2f}"
    beside = part.tables[2]
    assert beside.headings[0] == "odometry, sensor"
    rows = dict(beside.groups())["tunnelcd, in distribution"]
    assert [(cells[0].text, cells[2].text) for cells in rows] == [
        ("kiss-icp", f"{mean:.2f}"), ("drift", f"{mean + 0.3:.2f}"),
    ]  # fmt: skip
    # a run that tells nothing apart has no such table, and all of its tables are as before
    assert [table.headings[0] for table in plain.tables[:3]] == ["method", "method", "target"]
    page = write_page(folder, "none").read_text()
    assert "figures are of the pairs with kiss-icp, those of 12 other pairs stand in tables beside them" in page


def test_the_best_is_among_those_that_ask_no_truth(run: Path) -> None:
    table = pd.read_csv(run / "objects_table.csv")
    rows = with_domain(read_run(run).results)
    bold = [
        cells[0].text
        for _, cells in methods_table(table, OBJECT_COLUMNS, rows, "", counts=OBJECT_COUNTS).rows
        if cells[2].is_best
    ]
    assert bold == ["tunnelcd"] * 3
    first = methods_table(table, WITHDRAWAL_COLUMNS, rows, "").rows[0][1]
    # the time of an answer whose returns are a third of it: 3 ms a region, 1 ms of them
    assert [cell.text for cell in first] == ["tunnelcd", "6", "6", "1.00", "0.50", "0.50", "0.00", "3", "1"]


def test_no_answer_is_the_best_for_the_few_that_it_matched(run: Path) -> None:
    own = pd.read_csv(run / "objects_table.csv").query("domain == 'in' and variant == 'tunnelcd'")
    answers = ({"variant": "good", "kind_accuracy": 0.9, "n_matched": 9}, {"kind_accuracy": 0.5, "n_matched": 9},
               {"variant": "surest-alone", "kind_accuracy": 1.0, "n_matched": 1})  # fmt: skip
    rows = pd.concat([own.assign(**each) for each in answers])
    shown = methods_table(rows, OBJECT_COLUMNS, with_domain(read_run(run).results), "", counts=OBJECT_COUNTS)
    place = shown.headings.index("kind right")
    assert [cells[place].is_best for _, cells in shown.rows] == [True, False, False]
    assert shown.rows[2][1][place].interval.endswith("n 1")


def test_associated_accuracy_leads_no_table(run: Path) -> None:
    own = pd.read_csv(run / "objects_table.csv").query("domain == 'in' and variant == 'tunnelcd'")
    answers = ({"associated_accuracy": 0.97}, {"variant": "padded", "associated_accuracy": 0.99})
    rows = pd.concat([own.assign(**each) for each in answers])
    shown = methods_table(rows, OBJECT_COLUMNS, with_domain(read_run(run).results), "", counts=OBJECT_COUNTS)
    cells = [cells[shown.headings.index("AA")] for _, cells in shown.rows]
    assert [(cell.text, cell.is_best) for cell in cells] == [("0.97", False), ("0.99", False)]


def test_a_table_from_before_a_column_makes_a_page(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    own = pd.read_csv(run / "objects_table.csv")
    own[[name for name in own if "associated" not in name]].to_csv(tmp_path / "run" / "objects_table.csv", index=False)
    part = draw_objects(read_run(tmp_path / "run"))
    assert part is not None and "AA" not in part.tables[0].headings and "F1 at 0.5" in part.tables[0].headings
    assert all(len(cells) == len(part.tables[0].headings) for _, cells in part.tables[0].rows)


def test_the_rivals_iou_stands_beside_in_every_group(run: Path) -> None:
    data = read_run(run)
    assert voxel_variants(data, "tunnelcd") == [VOXEL]
    part = draw_objects(data)
    assert part is not None
    groups = pd.read_csv(run / "objects_by_group.csv")
    boxes = groups[(groups["domain"] == "in") & (groups["value"] == "box")].set_index("variant")["iou_point"]
    row = next(cells for _, cells in part.tables[3].rows if cells[0].text == "box")
    assert part.tables[3].headings[-2:] == ("IoU, voxel rule", "IoU, oracles")
    shown = [row[2].text, row[-2].text, row[-1].text]
    assert shown == [f"{boxes[name]:.2f}" for name in ("tunnelcd", VOXEL, ORACLE_VARIANT)]


def test_pairs_that_are_gone_are_named_and_nothing_else_breaks(run: Path) -> None:
    page = write_page(run).read_text()
    words = re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", page)))
    assert "The simulated pair regions/cave, seed" in words
    assert page.index('id="objects"') < page.index('id="results"')
    assert not re.search(r'(?:src|href)="https?:', re.sub(r"<script\b.*?</script>", "", page, flags=re.DOTALL))


def test_without_its_tables_the_section_says_how_to_get_them(run: Path, tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    for name in ("results.csv", "provenance.json"):
        (tmp_path / "bare" / name).write_bytes((run / name).read_bytes())
    part = draw_objects(read_run(tmp_path / "bare"))
    assert part is not None
    assert part.missing == ("objects_table.csv is not in the run folder: `tunnelcd score` makes it.",)
    assert FILES[0] == "objects_table"
    write_page(tmp_path / "bare")
