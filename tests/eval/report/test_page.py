import base64
import html
import json
import re
import shutil
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.io.answer import write_answer, write_failure
from cdpipe.io.session import ScanChunk, SessionWriter
from cdpipe.model.config import load_config
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport
from cdpipe.sensor.ouster import parse_metadata
from eval.report.page import write_page
from eval.report.site.site import truth_marks
from eval.report.tables import unchanged_table
from eval.running.results.run_data import read_run
from eval.running.runfolder import RunFolder
from eval.truth.ground_truth import load_ground_truth
from sim.session.truth import PairTruth, write_labels, write_pair_truth, write_true_poses
from tests.eval.changes import change

SITE, EMPTY = "paper/site1", "unchanged/site1"
WIDTH, N_SCANS = 64, 6
SENSOR = parse_metadata(
    {
        "lidar_mode": f"{WIDTH}x10",
        "beam_altitude_angles": [10.0, 0.0, -10.0, -20.0],
        "beam_azimuth_angles": [0.5, -0.5, 0.5, -0.5],
    },
    "a sensor of four beams",
)
AFTER_ODOM_T_WORLD = yaw_pose(0.5, (4.0, 1.0, 0.0))
# scans, rows and columns of an object's returns
ADDED = (slice(2, 4), slice(1, 4), slice(8, 16))
REMOVED = (slice(1, 2), slice(1, 4), slice(40, 44))

# region_recall, precision, at_k, auroc, false/100m, iou, f1, kind, merge m, deg, t_total
VALUES = {
    "paper": (0.5, 0.25, 0.5, 0.611, 3.0, 0.1, 0.0, np.nan, 0.012, 0.034, 0.5),
    "tunnelcd": (0.5, 0.75, 1.0, 0.622, 1.5, 0.456, 0.667, 1.0, 0.012, 0.031, 0.0625),
    "voxel-diff": (1.0, 0.5, 1.0, 0.933, 4.25, 0.789, 1.0, 0.5, 0.012, 0.036, 2.345),
    "random-regions": (0.0, np.nan, 0.0, np.nan, np.nan, 0.0, 0.0, np.nan, np.nan, np.nan, np.nan),
}
METRICS = (
    "region_recall", "region_precision", "region_recall_at_k", "region_auroc", "false_regions_per_100m",
    "object_iou_point", "object_f1_50", "kind_accuracy", "merge_error_m", "merge_error_deg", "t_total_s",
)  # fmt: skip
GRID = {(v, r): 0.1 * i for i, (v, r) in enumerate((v, r) for v in ("0.15", "0.3", "0.65") for r in ("3.0", "6.0"))}


SEEN: dict[str, Any] = {"hull_volume_m3": 0.5, "n_returns": 48, "n_cells": 40, "n_ghost_rays": 30}
CHANGES = (
    change(1, name="thing-1", **SEEN),
    change(2, "before", "removed", name="thing-2", **SEEN),
    change(3, name="thing-3", **SEEN, is_observable=False, why_not="too few rays"),
)


def write_session(pair: Path, name: str, odom_T_world: np.ndarray, index: int, block: tuple[slice, ...]) -> None:
    shape = (N_SCANS, SENSOR.height, WIDTH)
    range_mm = np.full(shape, 3000, dtype=np.uint32)
    # no two scans are the same to the last bit
    range_mm[:, 0, 0] += np.arange(N_SCANS, dtype=np.uint32)
    range_mm[:, 0, 0] += np.arange(len(range_mm), dtype=np.uint32)  # no two scans of a sensor are the same
    range_mm[block] = 2000
    change_ids = np.zeros(shape, dtype=np.int16)
    change_ids[block] = index
    poses = np.zeros((N_SCANS, WIDTH, 7), dtype=np.float32)
    poses[..., 6] = 1.0
    world_T_sensor = np.array([make_pose(translation=(float(step), 0.0, 0.8)) for step in range(N_SCANS)])
    stamps = np.arange(N_SCANS * WIDTH, dtype=np.int64).reshape(N_SCANS, WIDTH)
    with SessionWriter(pair / name, SENSOR, N_SCANS, {}) as writer:
        writer.add(
            ScanChunk(range_mm, np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.uint16), stamps, poses)
        )
        writer.close(odom_T_world @ world_T_sensor)
    write_labels(pair / name, 0, change_ids, change_ids)
    write_true_poses(pair / name, world_T_sensor)


def returns_of(block: tuple[slice, ...], columns: slice) -> np.ndarray:
    mask = np.zeros((N_SCANS, SENSOR.height, WIDTH), dtype=np.bool_)
    mask[block[0], block[1], columns] = True
    scans, rows, cols = np.nonzero(mask)
    return np.column_stack([scans, rows * WIDTH + cols]).astype(np.int32)


def report(objects: tuple[ChangedObject, ...]) -> ChangeReport:
    keyframes = np.arange(N_SCANS, dtype=np.int64)
    regions = ChangeRegions(
        centres_map=np.array([[2.0, 1.0, 0.8], [5.0, 0.0, 0.8]]),
        radius_m=4.5,
        scores=np.array([0.9, 0.2]),
        pairs=np.array([[2, 2], [5, 5]]),
        is_reported=np.array([True, True]),
        keyframe_scores=np.zeros(N_SCANS),
    )
    config = load_config("tunnelcd").model_dump(mode="json")
    seconds = {"t_merge_s": 0.1, "t_descriptor_s": 0.2, "t_cd_s": 0.3, "t_oe_s": 0.4}
    before_T_after = np.linalg.inv(AFTER_ODOM_T_WORLD)
    return ChangeReport(before_T_after, {}, regions, objects, seconds, {}, (keyframes, keyframes), config)


def result_row(scenario: str, variant: str, **columns: Any) -> dict[str, Any]:
    preset = variant.partition("[")[0]
    return {
        "scenario": scenario,
        "family": scenario,
        "seed": 7,
        "variant": variant,
        "preset": preset,
        "status": "ok",
        "error": "",
        "is_unchanged_pair": scenario == EMPTY,
        **columns,
    }


def result_rows() -> list[dict[str, Any]]:
    rows = [result_row(SITE, name, **dict(zip(METRICS, values, strict=True))) for name, values in VALUES.items()]
    rows[0] |= {"t_merge_s": 0.0987, "t_descriptor_s": 3.21, "t_cd_per_region_s": 0.0123, "t_oe_per_region_s": 0.00045}
    rows[0] |= {"t_total_with_merge_s": 0.5987, "t_total_paper_s": 0.432}
    rows[0] |= {"map_points_before": 51234.0, "map_points_after": 60321.0}
    rows[3] |= {"status": "merge_refused", "error": "a corridor without features & 50 % overlap"}
    rows += [
        result_row(SITE, f"tunnelcd[extract.voxel_m={v},query.radius_m={r}]", object_iou_point=x, region_recall=1 - x)
        for (v, r), x in GRID.items()
    ]
    rows += [
        result_row(EMPTY, "paper", is_alarm=True, n_regions=3.0, n_objects=2.0, false_regions_per_100m=1.77,
                   t_total_s=0.5),
        result_row(EMPTY, "tunnelcd", is_alarm=False, n_regions=0.0, n_objects=0.0, false_regions_per_100m=0.0,
                   t_total_s=0.0625),
        result_row(EMPTY, "voxel-diff", is_alarm=np.nan, n_regions=0.0, status="merge_refused"),
    ]  # fmt: skip
    return rows


def write_item_tables(run: Path) -> None:
    fields = [{k: v for k, v in asdict(item).items() if k != "world_T_object"} for item in CHANGES]
    found = {"paper": (True, False, False), "tunnelcd": (True, True, False)}
    matched = {"paper": (-1, -1, -1), "tunnelcd": (0, -1, -1)}
    changes = [
        {"scenario": SITE, "seed": 7, "variant": name, **item, "is_found": f, "matched_object": m,
         "matched_kind": "added" if m >= 0 else "", "iou_point": 0.4321 if m >= 0 else 0.0}
        for name in found
        for item, f, m in zip(fields, found[name], matched[name], strict=True)
    ]  # fmt: skip
    pd.DataFrame(changes).to_csv(run / "changes.csv", index=False)
    sizes = {
        "v_sphere_m3": (201.0, 231.5, 201.0),
        "v_oe_m3": (0.4, 0.1, np.nan),
        "s_points": (700.0, 2100.0, 1900.0),
        "oe_points": (33, 0, 33),
    }
    regions = [
        {"scenario": SITE, "seed": 7, "variant": "paper", "region": index, "is_reported": index < 3,
         "outcome": ("true", "false", "duplicate")[index], **{name: values[index] for name, values in sizes.items()}}
        for index in range(3)
    ]  # fmt: skip
    pd.DataFrame(regions).to_csv(run / "regions.csv", index=False)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("page") / "run"
    folder = RunFolder(run)
    pair = folder.pair(SITE, 7)
    pair.mkdir(parents=True)
    write_session(pair, "before", np.eye(4), 2, REMOVED)
    write_session(pair, "after", AFTER_ODOM_T_WORLD, 1, ADDED)
    write_pair_truth(pair, PairTruth(SITE, 7, 4.5, CHANGES, {}))
    # half of the added object, and as much beside it
    item = ChangedObject("after", "added", 0, returns_of(ADDED, slice(12, 20)), np.zeros((3, 3)), 1.0)
    write_answer(folder.answer(SITE, 7, "tunnelcd"), "tunnelcd", report((item,)))
    write_answer(folder.answer(SITE, 7, "paper"), "paper", report(()))
    write_answer(folder.answer(SITE, 7, "voxel-diff"), "voxel-diff", report(()))
    write_failure(folder.answer(SITE, 7, "random-regions"), "random-regions", "merge_refused", "no way", {}, {})
    points = np.random.default_rng(0).uniform((-2, -3, 0), (8, 3, 3), (500, 3)).astype(np.float32)
    for scenario in (SITE, EMPTY):
        folder.maps(scenario, 7).parent.mkdir(parents=True)
        np.savez(folder.maps(scenario, 7), before_points=points, after_points=points[:400] + 1)
    write_answer(folder.answer(EMPTY, 7, "tunnelcd"), "tunnelcd", report(()))
    pd.DataFrame(result_rows()).to_csv(run / "results.csv", index=False)
    write_item_tables(run)
    machine = {
        "cpu": "Abacus 3000",
        "cores": 2,
        "memory_gb": 8.5,
        "platform": "Linux",
        "threads": {"OMP_NUM_THREADS": "1"},
    }
    provenance = {"tool": "tunnelcd", "command": "tunnelcd run paper --out <here>", "machine": machine}
    (run / "provenance.json").write_text(
        json.dumps(
            {**provenance, "finished": "2026-01-01", "plan": {"name": "tiny", "targets": {"method": "tunnelcd"}}}
        )
    )
    return run


@pytest.fixture(scope="module")
def page(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(Path(shutil.copytree(whole, tmp_path_factory.mktemp("page") / "written")))


@pytest.fixture
def run(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


class _Tables(HTMLParser):
    """Collects the rows of every table: (text, is bold) of each cell."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[list[list[tuple[str, bool]]]] = []
        self._in_cell = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self._in_cell = True
            self.tables[-1][-1].append(("", "best" in (dict(attrs).get("class") or "").split()))

    def handle_endtag(self, tag: str) -> None:
        self._in_cell = self._in_cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self._in_cell:
            text, is_bold = self.tables[-1][-1].pop()
            self.tables[-1][-1].append((text + data, is_bold))


def tables_of(page: Path) -> dict[str, list[list[tuple[str, bool]]]]:
    """Tables by the heading of their first column and, for equal ones, of their second."""
    parser = _Tables()
    parser.feed(page.read_text())
    return {" / ".join(text for text, _ in table[0][:2]): table for table in parser.tables}


def texts(row: list[tuple[str, bool]]) -> list[str]:
    return [text.replace("\u2009", " ").replace("\u2013", "-") for text, _ in row]


def test_every_value_of_the_results_stands_in_its_cell_and_the_best_is_bold(page: Path) -> None:
    table = tables_of(page)["preset / region recall"]
    assert [texts(row) for row in table[1:]] == [
        [SITE],
        ["paper", "0.50", "0.25", "0.50", "0.61", "3.00", "0.10", "0.00", "-", "0.012", "0.034", "0.5", "ok"],
        ["tunnelcd", "0.50", "0.75", "1.00", "0.62", "1.50", "0.46", "0.67", "1.00", "0.012", "0.031", "0.0625", "ok"],
        ["voxel-diff", "1.00", "0.50", "1.00", "0.93", "4.25", "0.79", "1.00", "0.50", "0.012", "0.036", "2.35", "ok"],
        ["random-regions", "0.00", "-", "0.00", "-", "-", "0.00", "0.00", "-", "-", "-", "-", "merge refused"],
    ]
    bold = {row[0][0]: [index for index, (_, is_bold) in enumerate(row) if is_bold] for row in table[2:]}
    # the merge error in metres is the same for all: nobody is best
    assert bold == {"paper": [], "tunnelcd": [2, 3, 5, 8, 10, 11], "voxel-diff": [1, 3, 4, 6, 7], "random-regions": []}


def test_a_method_that_was_told_the_merge_has_no_merge_error_and_the_page_says_why(run: Path) -> None:
    folder = run / "evaluations" / "tunnelcd"
    folder.mkdir(parents=True)
    (folder / "evaluation.json").write_text('{"name": "tunnelcd", "merge": "given"}')
    text = write_page(run, views="none").read_text()
    assert "merge given: tunnelcd was told the merge by the truth, so its merge errors are left out." in text
    rows = {row[0][0]: row for row in tables_of(run / "index.html")["preset / region recall"][2:5]}
    assert texts(rows["tunnelcd"])[9:11] == ["-", "-"]
    # of the others the smaller one is the best
    assert {name: row[10] for name, row in rows.items() if name != "tunnelcd"} == {
        "paper": ("0.034", True), "voxel-diff": ("0.036", False),
    }  # fmt: skip


def test_the_unchanged_pair_has_its_own_rows(page: Path) -> None:
    table = tables_of(page)["preset / alarm"]
    assert [texts(row) for row in table[2:]] == [
        ["paper", "alarm", "3", "2", "1.77", "-", "-", "0.5", "ok"],
        ["tunnelcd", "silent", "0", "0", "0.00", "-", "-", "0.0625", "ok"],
        ["voxel-diff", "refused", "0", "-", "-", "-", "-", "-", "merge refused"],
    ]


def test_objects_where_nothing_changed_are_an_alarm_on_the_page(run: Path) -> None:
    data = read_run(run)
    rows = [{**row, "n_objects": 2 if row["variant"] == "tunnelcd" else 0} for row in data.results]
    table = unchanged_table(replace(data, results=tuple(rows)))
    told = {cells[0].text: cells[1].text for _, cells in table.rows}
    assert told == {"paper": "alarm", "tunnelcd": "alarm", "voxel-diff": "refused"}


def test_tables_one_and_two_stand_beside_the_papers_values(page: Path) -> None:
    tables = tables_of(page)
    times, volumes = tables["method / t_index [s]"], tables["method / map points before"]
    assert [texts(row) for row in times[2:]] == [
        ["published", "-", "0.051", "-", "-", "0.016-0.019", "0.0004-0.0005", "-", "-", "-"],
        ["ours, paper", "-", "0.0987", "-", "3.21", "0.0123", "0.00045", "0.5", "0.599", "0.432"],
        ["ours, tunnelcd", "-", "-", "-", "-", "-", "-", "0.0625", "-", "-"],
        ["ours, voxel-diff", "-", "-", "-", "-", "-", "-", "2.35", "-", "-"],
    ]
    assert [texts(row) for row in volumes[2:4]] == [
        ["published", "53 117", "63 942", "206-223", "0.30-0.51", "648-2 470", "25-71"],
        ["ours, paper", "51 234", "60 321", "201", "0.4", "700-1 900", "33"],
    ]
    assert (page.parent / "table2.csv").read_text().splitlines()[1:3] == [
        f"{SITE},published,53117,63942,206\u2013223,0.30\u20130.51,648\u20132470,25\u201371",
        f"{SITE},ours, paper,51234,60321,201,0.4,700\u20131900,33".replace("ours, paper", '"ours, paper"'),
    ]


def without_scripts(text: str) -> str:
    """The page without its script."""
    return re.sub(r"<script\b.*?</script>", "", text, flags=re.DOTALL)


def chart(text: str, name: str) -> str:
    """The elements of a chart of the page."""
    found = re.search(rf'<figure class="chart" id="{name}">(.*?)</figure>', text, flags=re.DOTALL)
    assert found is not None
    return found[1]


def test_the_grid_is_a_heat_map_of_voxels_by_radii_for_each_figure(page: Path) -> None:
    panels = chart(page.read_text(), "grid_1").split('<svg class="panel"')[1:]
    assert [re.search(r'class="heading"[^>]*>([^<]*)<', panel)[1] for panel in panels] == [
        "region recall",
        "object IoU",
    ]
    cells = [re.findall(r'class="cell" x="[^"]*" y="[^"]*">([^<]*)<', panel) for panel in panels]
    # i-th point of the grid, row by row: IoU i / 10, recall 1 - i / 10
    assert cells == [["1.00", "0.90", "0.80", "0.70", "0.60", "0.50"], ["0.00", "0.10", "0.20", "0.30", "0.40", "0.50"]]
    for panel in panels:
        assert re.findall(r'class="tick"[^>]*>([^<]*)<', panel) == ["3.0", "6.0"]
        assert re.findall(r'class="tick end"[^>]*>([^<]*)<', panel) == ["0.15", "0.3", "0.65"]


def summary_of(text: str) -> str:
    found = re.search(r'<div class="summary".*?</nav>', html.unescape(text), flags=re.DOTALL)
    assert found is not None
    return found[0]


def test_the_summary_names_no_point_of_a_grid(run: Path, page: Path) -> None:
    assert "tunnelcd [" not in summary_of(page.read_text())
    rows = [row for row in result_rows() if "[" in row["variant"]]
    alone = result_row(SITE, "paper", object_iou_point=0.1, region_recall=0.1)
    pd.DataFrame([*rows, alone]).to_csv(run / "results.csv", index=False)
    told = summary_of(write_page(run).read_text())
    assert "paper" in told
    assert "tunnelcd [" not in told


def test_nothing_is_fetched_and_every_picture_is_inside(page: Path) -> None:
    text = page.read_text()
    assert text.count("<script>") == 1
    assert re.findall(r"<script[^>]*\ssrc", text) == []
    shown = without_scripts(text)
    assert "http" not in shown
    assert "url(" not in shown
    assert "@import" not in shown
    sources = re.findall(r'src="([^"]*)"', shown)
    # two maps, three presets' regions, two observable changes, two merges
    assert len(sources) == 9
    for source in sources:
        assert base64.b64decode(source.removeprefix("data:image/webp;base64,"), validate=True)[8:12] == b"WEBP"
    links = re.findall(r'href="([^"]*)"', shown)
    assert links
    for link in links:
        assert f'id="{link[1:]}"' in text if link.startswith("#") else (page.parent / link).is_file()


def test_quality_against_cost_is_a_chart_and_a_picture_for_papers(page: Path) -> None:
    for name in ("pareto_regions", "pareto_objects"):
        assert (page.parent / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert chart(page.read_text(), name).count('class="plot"') > 0


def test_a_sharp_page_has_the_same_tables_and_charts_and_whole_pictures(run: Path, page: Path) -> None:
    copy = write_page(run, "none", is_slim=False)
    sharp = copy.read_text()
    sources = re.findall(r'src="([^"]*)"', sharp)
    assert len(sources) == without_scripts(page.read_text()).count("src=")
    for source in sources:
        assert base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True).startswith(b"\x89PNG")
    assert tables_of(copy) == tables_of(page)
    assert sharp.count('class="chart"') == page.read_text().count('class="chart"') > 0


def test_the_first_pair_can_be_seen_in_3d_and_a_page_without_views_links_to_none(run: Path) -> None:
    page = write_page(run)
    file = run / "views" / "paper__site1" / "7.html"
    assert 'href="views/paper__site1/7.html"' in page.read_text()
    assert "viser" in file.read_text().lower()
    assert 'href="views/' not in write_page(run, "none").read_text()


def test_the_summary_puts_the_method_that_leads_first_and_what_failed_last(page: Path) -> None:
    table = tables_of(page)["method / pairs"]
    assert [row[0][0] for row in table[2:]] == ["voxel-diff", "tunnelcd", "paper", "random-regions"]
    told = summary_of(page.read_text())
    assert "2 of 13 cases" in told


def test_the_title_says_which_plan_and_the_answer_who_leads(page: Path) -> None:
    text = page.read_text()
    assert "<h1>tiny: change detection between two LiDAR sessions of a tunnel</h1>" in text
    assert summary_of(text).count("<li>") == 0
    answer = "Highest region recall, out of distribution: voxel-diff (1.00), before tunnelcd and paper (0.50)"
    answer += ", on too few pairs for a verdict."
    assert f'<p class="answer">{answer}</p>' in text
    assert "Abacus 3000" in text.partition('id="settings"')[2]


def test_methods_and_columns_lead_to_what_they_are(page: Path) -> None:
    text = html.unescape(page.read_text())
    for id_, name in re.findall(r'<td><a href="#(m\d+)">([^<]*)</a>', text):
        assert f'<dt id="{id_}" tabindex="-1">{name.partition(" [")[0]}</dt><dd>' in text
    assert "<dd>The paper (reading A): scan descriptors, nearest neighbour in descriptor space" in text
    headings = re.findall(r'<th scope="col" data-term="(c\d+)">([^<]*)</th>', text)
    assert {"region recall", "object IoU"} <= {name for _, name in headings}
    for id_, name in headings:
        assert f'<dt id="{id_}" tabindex="-1">{name}</dt><dd>' in text


def test_sections_are_folded_and_every_link_inside_leads_somewhere(page: Path) -> None:
    text = page.read_text()
    sections = re.findall(r'<details class="section" id="([^"]*)"( open)?>', text)
    assert len(sections) > 8 and not any(is_open for _, is_open in sections)
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]*)"', text)) <= set(ids)


def test_objects_carry_their_names_and_markup_in_texts_is_harmless(page: Path) -> None:
    text = page.read_text()
    assert "1. Box “thing-1”: added" in text
    assert "2. Box “thing-2”: removed" in text
    assert "thing-3" not in text.partition("Settings and provenance")[0]
    assert "tunnelcd run paper --out &lt;here&gt;" in text
    assert "a corridor without features &amp; 50 % overlap" in text


def test_a_whole_folder_lacks_nothing_but_the_refused_answer(page: Path) -> None:
    missing = page.read_text().partition('id="missing"')[2]
    lines = re.findall(r"<li>(.*)</li>", missing)
    assert lines == [f"No answer of random-regions on {SITE} (merge refused)."]


@pytest.mark.parametrize(
    ("part", "named"),
    [
        ("provenance.json", "provenance.json"),
        ("changes.csv", "changes.csv"),
        ("regions.csv", "regions.csv"),
        ("maps", "maps/paper__site1/7.npz"),
        ("pairs/paper__site1/7/truth/changes.json", "pairs/paper__site1/7"),
        ("pairs/paper__site1/7/after", "pairs/paper__site1/7"),
        ("answers/paper__site1/7/paper", "The stored answer of paper on"),
        ("answers", "No answer holds a merge"),
    ],
)
def test_a_missing_part_is_named_and_the_rest_stays(run: Path, part: str, named: str) -> None:
    path = run / part
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    text = write_page(run).read_text()
    assert named in text.partition('id="missing"')[2]
    assert "0.93" in text


def test_results_alone_make_a_page(run: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    rows = [row for row in result_rows() if row["variant"] == "voxel-diff" and row["scenario"] == SITE]
    pd.DataFrame(rows).to_csv(alone / "results.csv", index=False)
    page = write_page(alone).read_text()
    missing = page.partition('id="missing"')[2]
    for named in (
        "unchanged pair",
        "grid",
        "provenance.json",
    ):
        assert named.lower() in missing.lower()
    assert "2.35" in page


def test_only_unchanged_pairs_make_a_page(run: Path) -> None:
    pd.DataFrame([row for row in result_rows() if row["scenario"] == EMPTY]).to_csv(run / "results.csv", index=False)
    page = write_page(run).read_text()
    assert "No scenario with changes was run" in page
    assert "silent" in page


def test_cases_without_an_answer_are_told_once_with_their_reason(run: Path) -> None:
    refused = {"status": "merge_refused", "error": "too smooth", "region_recall": 0.0, "object_iou_point": 0.0}
    rows = [result_row(SITE, name, **refused) for name in ("paper", "tunnelcd", "voxel-diff")]
    pd.DataFrame(rows).to_csv(run / "results.csv", index=False)
    text = write_page(run).read_text()
    assert "3 of 3 cases" in summary_of(text)
    # once among the cases without an answer, once in the table of merges
    assert text.count("too smooth") == 2
    assert f"{SITE}, seed 7, paper, tunnelcd, voxel-diff: merge refused: too smooth" in text


def test_an_accepted_merge_that_is_wrong_is_said(run: Path) -> None:
    rows = [result_row(SITE, name, merge_error_m=error) for name, error in (("paper", 28.283), ("tunnelcd", 0.05))]
    pd.DataFrame(rows).to_csv(run / "results.csv", index=False)
    assert "1 accepted merge is wrong" in summary_of(write_page(run).read_text())


@pytest.mark.parametrize("content", [None, "", "scenario,seed,variant,status\n", "a,b\n1,2\n"])
def test_a_folder_without_results_is_refused_in_one_line(run: Path, content: str | None) -> None:
    path = run / "results.csv"
    path.unlink() if content is None else path.write_text(content)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        write_page(run)
    assert "\n" not in str(caught.value)
    assert not (run / "index.html").exists()


def test_several_pairs_show_mean_median_and_interval(run: Path) -> None:
    rows = [
        result_row(SITE, name, seed=seed, object_iou_point=iou, t_total_s=seconds)
        for name, values in {"paper": ((0.2, 1.0), (0.4, 9.0), (0.6, 2.0)), "tunnelcd": ((0.5, 1.0),) * 3}.items()
        for seed, (iou, seconds) in enumerate(values)
    ]
    pd.DataFrame(rows).to_csv(run / "results.csv", index=False)
    table = tables_of(write_page(run))["preset / region recall"]
    # mean of 0.2, 0.4, 0.6: of the 27 resamples one is all 0.2 and one all 0.6, each more than 2.5 %; median of 1, 9, 2
    assert texts(table[2])[6] == "0.400.20-0.60"
    assert texts(table[2])[11].startswith("2")
    assert texts(table[2])[12] == "3 ok"
    assert table[3][6] == ("0.500.50\u20130.50", True)


def test_latex_is_escaped_and_bold(page: Path) -> None:
    text = (page.parent / "results.tex").read_text()
    assert "paper/site1" in text
    assert r"voxel-diff & \textbf{1.00} & 0.50" in text
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 1
    volumes = (page.parent / "table2.tex").read_text()
    assert r"V\_sphere [m$^3$]" in volumes
    assert r"published & 53\,117 & 63\,942 & 206--223" in volumes
    # every row has as many cells as the header
    assert {line.count(" & ") for line in volumes.splitlines() if " & " in line} == {7}


def test_truth_is_marked_where_it_is_on_the_before_map(run: Path) -> None:
    truth = load_ground_truth(RunFolder(run).pair(SITE, 7))
    found = [{"id": 1, "is_found": True}, {"id": 2, "is_found": False}, {"id": 3, "is_found": True}]
    marks = truth_marks(truth, found)
    assert [(mark.label, mark.state) for mark in marks] == [("1", "found"), ("2", "missed"), ("3", "unobservable")]
    assert truth_marks(truth, found[:1])[1].state == "not scored"
    # the before session's odom frame is the world here, whatever the after session's is
    np.testing.assert_allclose([[m.x_m, m.y_m] for m in marks], truth.centroids_world[:, :2], atol=1e-9)
    assert np.abs(truth.centroids_world[0, :2] - (2.5, 0.0)).max() < 2.1


def test_the_same_folder_gives_the_same_page(run: Path) -> None:
    assert write_page(run).read_bytes() == write_page(run).read_bytes()


def test_answers_of_several_commits_are_told(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    for commits, told in (
        (["abc"] * len(results), False),
        (["abc+", *["def"] * (len(results) - 2), ""], True),
    ):
        results.assign(commit=commits).to_csv(run / "results.csv", index=False)
        text = write_page(run).read_text().partition("<summary>Provenance</summary>")[2]
        assert ("more than one commit" in text) == told
        assert (f"abc+ (1 row), def ({len(results) - 2} rows), unknown (1 row)" in text) == told
