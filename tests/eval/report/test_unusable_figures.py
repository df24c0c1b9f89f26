"""Figures that nothing can draw, in the tables of an older run."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from eval.report.comparing.page import compare_sides, write_comparison
from eval.report.page import write_page
from eval.running.results.run_data import plan_name, read_run, stored_table
from eval.running.results.sides import read_side
from eval.running.runfolder import RunFolder, reported, write_json
from eval.tables.columns import UNDEFINED
from tests.eval.report.test_hostile_names import PLAIN, write_run

INF = float("inf")
UNUSABLE = {
    "bytes_regions_before": INF, "t_total_s": 1.5e308, "t_total_with_merge_s": INF, "merge_error_m": 1e300,
    "n_observable": INF, "region_recall": -INF, "object_iou_point": INF, "false_regions_per_100m": 1e300,
    "after_path_m": INF, "overlap_true": INF, "map_points_before": INF,
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_run(tmp_path_factory.mktemp("unusable") / "run", PLAIN[:6])
    results = pd.read_csv(folder / "results.csv").astype(dict.fromkeys(["n_observable"], "float64"))
    for name, value in UNUSABLE.items():
        results[name] = results.get(name, 1.0)
        results.loc[results["variant"] == PLAIN[1], name] = value
    results.to_csv(folder / "results.csv", index=False)
    items = results[["scenario", "seed", "variant"]]
    items.assign(region=0, score=INF, outcome="true", v_sphere_m3=INF, s_points=INF, is_reported=True).to_csv(
        folder / "regions.csv", index=False
    )
    return folder


def test_the_page_shows_them_as_undefined_and_says_so(run: Path) -> None:
    text = html.unescape(write_page(run).read_text())
    (told,) = [line for line in text.splitlines() if "results.csv: infinite or larger than 1e+15" in line]
    assert all(f"{name} (4)" in told for name in UNUSABLE) and f"`tunnelcd score {run}`" in told
    assert "regions.csv: infinite" in text
    table = text.partition('id="results"')[2]
    assert f">{PLAIN[1]}</a></td><td>{UNDEFINED}</td>" in table and "inf<" not in table
    assert f'>{PLAIN[0]}</a></td><td class="best">0.90' in table


def test_a_comparison_says_so_too(run: Path, tmp_path: Path) -> None:
    sides = (read_side(f"{run}:{PLAIN[place]}") for place in (0, 1))
    assert "infinite or larger than 1e+15" in write_comparison(compare_sides(*sides), tmp_path / "out").read_text()


def test_a_comparison_replaces_only_its_own_files(run: Path, tmp_path: Path) -> None:
    found = compare_sides(*(read_side(f"{run}:{PLAIN[place]}") for place in (0, 1)))
    for _ in range(2):
        page = write_comparison(found, tmp_path)
    for mine in (page, tmp_path / "comparison.csv"):
        written = mine.read_bytes()
        mine.write_text("<html><title>mine</title>")
        with pytest.raises(InputError, match=f"{mine.name}: exists, and is no .*name a new file, or remove it"):
            write_comparison(found, tmp_path)
        assert mine.read_text() == "<html><title>mine</title>"
        mine.write_bytes(written)


def test_the_page_of_a_run_that_ends_at_the_merge(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "results.csv").write_bytes((run / "results.csv").read_bytes())
    write_json(folder / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "x", "until": "merge"}})
    assert "results.csv: infinite or larger" in write_page(folder).read_text()


def test_a_seed_that_is_none_is_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", PLAIN[:6])
    results = pd.read_csv(folder / "results.csv").astype({"seed": "float64"})
    results.loc[0, "seed"] = INF
    results.to_csv(folder / "results.csv", index=False)
    with pytest.raises(InputError, match="seed = nan: expected a whole number"):
        read_run(folder)


def test_a_provenance_and_an_answer_that_hold_anything_kill_no_page(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", PLAIN[:6])
    plan = {"name": ["\ud800"], "report": 1, "targets": 1, "until": "merge"}
    document = {"tool": "tunnelcd", "plan": plan, "machine": [], "command": {}}
    (folder / "provenance.json").write_text(json.dumps(document))  # `write_json` refuses the name
    answer = RunFolder(folder).answer(f"{PLAIN[0]}/one", 1, PLAIN[0])
    write_json(answer / "answer.json", {"config": {"merge": {"min_overlap": "x"}}, "evidence": {"overlap": "x"}})
    write_json(answer.with_name("method_1") / "answer.json", {"config": ["x"], "evidence": 1})
    assert write_page(folder).is_file()
    assert reported({"plan": plan}) == ("1",)
    for plan in ([], "x", None):
        assert plan_name(replace(read_run(folder), provenance={"plan": plan})) == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "domain,variant,false_positive_rate\nin,a,0.5\nin,a,true-ish\n",
            "roc.csv:3: false_positive_rate = 'true-ish'",
        ),
        ("domain,variant,n_pairs\nin,a,3\nin,b,\n", "roc.csv: column n_pairs lacks a count: `tunnelcd score"),
    ],
)
def test_a_derived_table_with_text_among_its_numbers_is_one_line(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "roc.csv").write_text(content)
    run = replace(read_run(write_run(tmp_path / "run", PLAIN[:6])), folder=RunFolder(tmp_path))
    with pytest.raises(InputError) as caught:
        stored_table(run, "roc")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_derived_table_without_a_column_is_one_line(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", PLAIN[:6])
    write_json(folder / "provenance.json", {"tool": "tunnelcd", "plan": {"name": "x", "report": "objects"}})
    (folder / "objects_table.csv").write_text("domain,variant,n_pairs\nin,a,3\n")
    with pytest.raises(InputError, match="run: a table lacks column 'object_iou_point': `tunnelcd score") as caught:
        write_page(folder)
    assert "\n" not in str(caught.value)
