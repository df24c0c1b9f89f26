"""What the page shows of the merge, of a run that ends there and of an ordinary one."""

import html
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.geometry import transform
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.merge.evidence import GATES
from cdpipe.model.config import load_config
from cdpipe.model.report import ChangeRegions, ChangeReport
from eval.plans.targets import Targets
from eval.report.merge.cases import true_alignment
from eval.report.merge.merge import draw_merge
from eval.report.merge.tables import times_table
from eval.report.page import write_page
from eval.running.results.run_data import read_run
from eval.running.runfolder import RunFolder
from eval.tables.merge_table import merge_table

NAN = float("nan")
TARGETS = Targets(method="tunnelcd", merge={"clean": 0.99, "drift": 0.95, "smooth": 1.0, "disjoint": 1.0})
SLIDES = "the sessions cannot be merged: it can slide; merge.min_hessian_ratio asks for 0.01"
UNLIKE = "the sessions cannot be merged: it does not fit; merge.min_agreement asks for <80%>"
EVIDENCE = {name: 100.0 for name, _ in GATES} | {
    "overlap": 0.61, "inlier_share": 0.92, "hessian_ratio": 0.123, "agreement": 0.87, "residual_m": 0.033,
}  # fmt: skip
CONFIG = load_config("tunnelcd").model_dump(mode="json")


def row(kind: str, seed: int, variant: str = "tunnelcd", status: str = "ok", **columns: object) -> dict[str, object]:
    metres = columns.pop("metres", NAN)
    return {
        "scenario": f"merge/{kind or 'plain'}",
        "family": "narrow",
        "seed": seed,
        "variant": variant,
        "status": status,
        "error": "",
        "pair_kind": kind,
        "overlap_true": 0.0 if kind == "disjoint" else 0.5,
        "merge_error_m": metres,
        "merge_error_deg": metres,
        "merge_error_along_m": metres,
        "merge_error_m_p95": metres,
        "t_merge_s": 0.04,
        "is_unchanged_pair": False,
        **{f"evidence_{name}": value for name, value in EVIDENCE.items()},
        **columns,
    }


ROWS = [
    *(row("clean", seed, metres=0.001 * (seed + 1)) for seed in range(12)),
    row("clean", 12, status="merge_refused", error=UNLIKE, evidence_agreement=0.12),
    row("drift", 0, metres=0.02),
    row("drift", 1, status="failed", error="broken off", evidence_overlap=NAN),
    row("smooth", 0, status="merge_refused", error=SLIDES),
    row("disjoint", 0, status="merge_refused", error=UNLIKE),
    row("disjoint", 1),
    *(row("clean", seed, "frame", metres=40.0) for seed in range(2)),
    row("clean", 0, "oracle-merge[noise_m=0.1,noise_deg=0.2]", metres=0.1),
]


def report(before_T_after: np.ndarray, local: np.ndarray | None = None) -> ChangeReport:
    none = np.zeros(0)
    regions = ChangeRegions(np.zeros((0, 3)), 4.5, none, np.zeros((0, 2), np.int64), none.astype(bool), none)
    scans = np.arange(14, dtype=np.int64)
    return ChangeReport(before_T_after, EVIDENCE, regions, (), {}, {}, (scans, scans), CONFIG, local)


def corridor() -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 20, 0.2), np.arange(-2, 2, 0.2))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def write_run(folder: Path, rows: list[dict[str, object]], until: str | None) -> RunFolder:
    folder.mkdir(exist_ok=True)
    pd.DataFrame(rows).to_csv(folder / "results.csv", index=False)
    plan = {"name": "merge", "targets": TARGETS.model_dump(), **({"until": until} if until else {})}
    (folder / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "command": "run", "plan": plan}))
    return RunFolder(folder)


def add_maps(run: RunFolder, scenario: str, seed: int) -> None:
    path = run.maps(scenario, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, before_points=corridor().astype(np.float32), after_points=corridor().astype(np.float32))


@pytest.fixture
def merge_run(tmp_path: Path) -> RunFolder:
    run = write_run(tmp_path / "run", ROWS, "merge")
    for scenario, seed in (("merge/clean", 11), ("merge/disjoint", 1)):
        add_maps(run, scenario, seed)
        write_answer(run.answer(scenario, seed, "tunnelcd"), "tunnelcd", report(np.eye(4)))
    return run


def table_rows(page: str, caption: str) -> list[list[str]]:
    part = page[page.index(f"<caption>{caption}") :]
    part = part[: part.index("</table>")]
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", part)]
    return [[html.unescape(re.sub("<[^>]*>", " ", cell)).strip() for cell in row] for row in cells]


def test_a_run_that_ends_at_the_merge_shows_it_and_no_empty_sections(merge_run: RunFolder) -> None:
    page = html.unescape(write_page(merge_run.path).read_text())
    assert re.findall(r'class="section" id="([^"]*)"', page) == [
        "merge", "methods", "definitions", "settings", "missing"
    ]  # fmt: skip
    shares = {line[0]: line[2] for line in table_rows(page, "Headline figures")[1:]}
    assert list(shares) == ["tunnelcd", "frame", "oracle-merge [noise_m=0.1, noise_deg=0.2]"]
    assert [share[:4] for share in shares.values()] == ["0.92", "0.00", "0.00"]
    links = re.findall(r'href="#([^"]*)"', page)
    assert all(f'id="{link}"' in page for link in links)
    assert "region recall" not in page
    assert not (merge_run.path / "table1.csv").exists()


def test_the_table_of_targets_and_the_csv_say_the_same(merge_run: RunFolder) -> None:
    page = write_page(merge_run.path).read_text()
    rows = table_rows(page, "Kinds of pair")
    assert [[row[0], *row[2:9]] for row in rows if row[0] == "tunnelcd"] == [
        ["tunnelcd", "not met", "92.3 % 66.7\u201398.6 %", "0", "13", "12", "1", "0"],
        ["tunnelcd", "not met", "50 % 9.5\u201390.5 %", "0", "2", "1", "0", "1"],
        ["tunnelcd", "met", "100 % 20.7\u2013100 %", "0", "1", "0", "1", "0"],
        ["tunnelcd", "not met", "50 % 9.5\u201390.5 %", "1", "2", "1", "1", "0"],
    ]
    # 0.001 to 0.012: median 0.0065, 95th percentile 0.01145
    assert rows[2][9] in ("0.006 0.011", "0.007 0.011")
    # an oracle is no method that could meet a target
    assert [row[2] for row in rows if row[0].startswith("oracle-merge")] == ["\u2013"]
    written = pd.read_csv(merge_run.path / "merge.csv")
    expected = merge_table(pd.read_csv(merge_run.path / "results.csv"), TARGETS)
    verdicts = [None if pd.isna(value) else value for value in written["is_met"]]
    assert verdicts == expected["is_met"].tolist()
    pd.testing.assert_frame_equal(written.drop(columns="is_met"), expected.drop(columns="is_met"))


def test_no_verdict_before_all_that_was_planned_is_there(merge_run: RunFolder) -> None:
    plan = {
        "name": "merge",
        "until": "merge",
        "scenarios": ["merge/smooth"],
        "seeds": [0, 1],
        "variants": [{"preset": "tunnelcd"}],
        "targets": TARGETS.model_dump(),
    }
    (merge_run.path / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "command": "run", "plan": plan}))
    page = html.unescape(write_page(merge_run.path).read_text())
    # smooth, 1 is not there
    assert "1 of 2 planned pairs so far" in page
    assert {row[2] for row in table_rows(page, "Kinds of pair")[1:] if len(row) > 1} == {"\u2013"}
    plan["seeds"] = [0]
    (merge_run.path / "provenance.json").write_text(json.dumps({"tool": "tunnelcd", "command": "run", "plan": plan}))
    page = html.unescape(write_page(merge_run.path).read_text())
    assert "planned pairs" not in page
    assert {row[2] for row in table_rows(page, "Kinds of pair")[1:] if row[0] == "tunnelcd"} == {"met", "not met"}


def test_times_have_median_p95_and_number(merge_run: RunFolder) -> None:
    rows = [row("clean", seed, t_merge_s=seconds) for seed, seconds in enumerate((0.1, 0.2, 0.4))]
    rows.append(row("clean", 3, status="merge_refused", error=UNLIKE, t_merge_s=NAN))
    table = times_table(pd.DataFrame([*rows, row("clean", 0, "oracle-merge", t_merge_s=0.0)]))
    assert [[cell.text for cell in cells] for _, cells in table.rows] == [
        ["tunnelcd", "\u2013", "\u2013", "0", "0.2", "0.38", "3", "\u2013", "\u2013", "0"]
    ]


def test_worst_merges_come_first_and_what_was_not_merged_is_listed_with_its_reason(merge_run: RunFolder) -> None:
    page = write_page(merge_run.path).read_text()
    headings_of_worst, *worst = table_rows(page, "The worst accepted merges of tunnelcd")
    assert len(worst) == 10
    assert worst[0][0] == "merge/disjoint, 1 disjoint"
    assert worst[0][headings_of_worst.index("error [m]")] == "\u2013"
    assert [row[0] for row in worst[1:4]] == ["merge/drift, 0 drift", "merge/clean, 11 clean", "merge/clean, 10 clean"]
    outside = table_rows(page, "Every pair of tunnelcd that is outside its target")[1:]
    assert [(row[0], row[-1]) for row in outside[:2]] == [
        ("merge/clean, 12 clean", f"refused: {UNLIKE}"),
        ("merge/drift, 1 drift", "failed: broken off"),
    ]
    # not merged first; then what was accepted and should not have been
    assert [row[0] for row in outside[2:]] == ["merge/disjoint, 1 disjoint"]
    refusals = table_rows(page, "Which gate the refusals name")
    named = dict(zip(refusals[0], refusals[2], strict=True))
    assert (named["agreement"], named["hessian ratio"], named["none of these"]) == ("1", "0", "0")


def test_cases_without_maps_are_named_and_the_others_drawn(merge_run: RunFolder) -> None:
    part = draw_merge(read_run(merge_run.path))
    assert [picture.title for picture in part.pictures] == [
        "merge/disjoint, seed 1: tunnelcd",
        "merge/clean, seed 11: tunnelcd",
    ]
    assert "its error is undefined" in part.pictures[0].caption
    assert "median error 0.012 m and 0.012 deg" in part.pictures[1].caption
    assert any("merge/clean, seed 12" in line for line in part.missing)


def test_a_refused_pair_is_drawn_as_the_maps_truly_lie(
    merge_run: RunFolder, write_tiny_pair: Callable[..., Path]
) -> None:
    add_maps(merge_run, "merge/clean", 12)
    place = merge_run.pair("merge/clean", 12)
    place.parent.mkdir(parents=True)
    write_tiny_pair().rename(place)
    write_failure(merge_run.answer("merge/clean", 12, "tunnelcd"), "tunnelcd", "merge_refused", UNLIKE, {}, CONFIG)
    part = draw_merge(read_run(merge_run.path))
    assert part.pictures[0].title == "merge/clean, seed 12: tunnelcd"
    assert "refused, drawn as the maps truly lie" in part.pictures[0].caption


def test_true_alignment_is_the_true_merge_even_where_both_odometries_stretch(
    write_tiny_pair: Callable[..., Path], tiny_merge: np.ndarray
) -> None:
    pair = write_tiny_pair(stretch=1.02)
    alignment = true_alignment(pair)
    assert alignment is not None
    points = np.random.default_rng(0).uniform(-3, 3, (50, 3)) + alignment.anchors_odom[4]
    np.testing.assert_allclose(alignment.to_map(points), transform(tiny_merge, points), atol=1e-6)


def test_an_ordinary_run_has_one_row_for_each_merge_and_one_picture_for_each_scenario(tmp_path: Path) -> None:
    rows = [
        row("", 0, "paper", metres=0.03, evidence_agreement=0.86),
        row("", 0, "tunnelcd", metres=0.02),
        row("", 0, "tunnelcd[query.radius_m=3]", metres=0.02),
        row("", 0, "random-regions", metres=0.02),
        row("", 1, "tunnelcd", status="merge_refused", error=SLIDES, evidence_hessian_ratio=0.002),
    ]
    run = write_run(tmp_path / "run", rows, None)
    add_maps(run, "merge/plain", 0)
    for each in rows[:4]:
        write_answer(run.answer("merge/plain", 0, str(each["variant"])), "x", report(np.eye(4)))
    write_failure(run.answer("merge/plain", 1, "tunnelcd"), "tunnelcd", "merge_refused", SLIDES, {}, CONFIG)
    page = write_page(run.path).read_text()
    assert {"merge", "results"} <= set(re.findall(r'class="section" id="([^"]*)"', page))
    found = table_rows(page, "What every merge measured")[2:]
    assert [(line[0], line[-1]) for line in found] == [
        ("seed 0 paper", f"accepted: all {len(GATES)} gates are reached"),
        ("seed 0 tunnelcd (2 settings), random-regions", f"accepted: all {len(GATES)} gates are reached"),
        ("seed 1 tunnelcd", f"refused: {SLIDES}"),
    ]
    least = CONFIG["merge"]["min_hessian_ratio"]
    column = table_rows(page, "What every merge measured")[0].index("hessian ratio")
    assert found[2][column] == f"0.002 \u2265 {least:g}"
    # bold where it is below the gate
    assert re.search(r'<td class="best">0\.002<', page)
    part = draw_merge(read_run(run.path))
    assert [picture.title for picture in part.pictures] == ["merge/plain, seed 0: tunnelcd"]
    assert not (run.path / "merge.csv").exists()


def test_a_merge_that_bends_is_drawn_as_it_bends(tmp_path: Path, write_tiny_pair: Callable[..., Path]) -> None:
    run = write_run(tmp_path / "run", [row("", 7, metres=0.02)], None)
    add_maps(run, "merge/plain", 7)
    place = run.pair("merge/plain", 7)
    place.parent.mkdir(parents=True)
    write_tiny_pair().rename(place)
    addresses = []
    for lift_m in (0.0, 0.25):
        local = np.tile(np.eye(4), (14, 1, 1))
        local[:, 2, 3] = lift_m
        write_answer(run.answer("merge/plain", 7, "tunnelcd"), "tunnelcd", report(np.eye(4), local))
        (picture,) = draw_merge(read_run(run.path)).pictures
        addresses.append(picture.address)
    assert addresses[0] != addresses[1]


def test_too_many_merges_for_a_table_are_counted_and_refused_ones_kept(tmp_path: Path) -> None:
    rows = [row("", seed, metres=0.001 * seed) for seed in range(50)]
    rows.append(row("", 50, status="merge_refused", error=SLIDES))
    part = draw_merge(read_run(write_run(tmp_path / "run", rows, None).path))
    assert len(part.cases[0].rows) == 40
    assert any("11 further merges" in note for note in part.notes)
    assert "refused" in part.cases[0].rows[0][1][-1].text
