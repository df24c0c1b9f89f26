"""The page of an answer: what it holds, how its points are stored, and that it asks no network."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.model.report import ChangedObject, ChangeRegions, ObjectShape, SurfaceField, SurfaceRegion
from eval.core.charts import BLUE
from eval.report.answer.content import MAX_POINTS, AnswerContent
from eval.report.answer.layers import ELSEWHERE, Layer, list_layers, pack
from eval.report.answer.page import render_answer_page
from eval.report.answer.shapes import AFTER_RGB, BEFORE_RGB, WRONG_RGB
from eval.report.answer.tables import tabulate_objects, tabulate_regions
from eval.report.answer.view import view_answer
from sim.view.returns import CHANGE_RGB
from sim.view.rock import ROCK_RGB
from tests.cdpipe.model.test_sentence import EMPTY, covered
from tests.eval.report.test_page_browser import needs_browser, opened

LENGTH_M = 75.0


def box(session: Any, kind: Any, at: tuple[float, float, float], partner: int = -1) -> ChangedObject:
    rng = np.random.default_rng(len(kind))
    points = np.array(at) + rng.uniform(-0.4, 0.4, (200, 3))
    pose = np.eye(4)
    pose[:3, 3] = at
    shape = ObjectShape(pose, np.array([1.2, 0.8, 0.5]), 0.43)
    shift = np.array([0.0, 2.3, 0.0]) if kind == "moved" else None
    return ChangedObject(session, kind, 0, np.zeros((0, 2), np.int32), points, 1.0, partner, shape, shift)


def content(names: tuple[str, str] = ("monday", "friday"), n_points: int = 2000) -> AnswerContent:
    """A straight tunnel of 75 m; 20 m of it were not seen again."""
    rng = np.random.default_rng(0)
    maps = tuple(
        np.column_stack([rng.uniform(0, LENGTH_M, n_points), 2 * np.cos(angle), 2 * np.sin(angle)])
        for angle in rng.uniform(0, 2 * np.pi, (2, n_points))
    )
    path = np.column_stack([np.linspace(0, LENGTH_M, 151), np.zeros((151, 2))])
    regions = ChangeRegions(
        np.array([[30.0, 0.0, 0.0], [60.0, 0.0, 0.0]]), 4.5, np.array([2.0, 1.0]), np.zeros((2, 2), int),
        np.array([True, False]), np.zeros(0), np.array([False, True]),
    )  # fmt: skip
    objects = (
        box("after", "added", (30.0, 1.0, -1.0)),
        box("before", "moved", (31.0, -1.0, -1.0), 2), box("after", "moved", (31.0, 1.3, -1.0), 1),
    )  # fmt: skip
    coverage = replace(covered(55.0, 20.0), is_near=np.arange(151) <= 110)
    report = replace(EMPTY, regions=regions, objects=objects, coverage=coverage)
    return AnswerContent(names, "mine", report, (maps[0], maps[1]), (0.1, 0.1), (path, path[:111]))


def with_rock(shown: AnswerContent) -> AnswerContent:
    moved_m = np.array([0.0, 0.001, 0.03, -0.3, np.nan, 0.03])
    points = np.column_stack([np.arange(6.0), np.full((6, 2), 2.0)])
    region = SurfaceRegion(np.array([2.0, 2.0, 2.0]), 1.0, 0.03, 0.03, -0.3)
    normals = np.tile([0.0, 0.0, 1.0], (6, 1))
    number = np.array([-1, -1, 0, 0, 0, -1], dtype=np.int32)
    field = SurfaceField(points, normals, moved_m, np.full(6, 0.01), number, (region,))
    return replace(shown, report=replace(shown.report, surface=field))


def scene_of(page: str) -> tuple[dict[str, Any], np.ndarray]:
    """Return what the script of the page reads, and its points in metres as the script places them."""
    found = {
        name: re.search(rf'id="{name}">(.*?)</script>', page, flags=re.DOTALL)[1]  # type: ignore[index]
        for name in ("scene", "points")
    }
    scene = json.loads(found["scene"])
    steps = np.frombuffer(base64.b64decode(found["points"]), dtype="<u2").reshape(-1, 3)
    return scene, steps * scene["step"] + np.array(scene["origin"])


def test_stored_points_are_where_they_were() -> None:
    layers = [
        Layer("a", "points", np.array([[-700.0, 2.0, 3.0], [300.0, 2.0, 4.0]]), (1, 2, 3)),
        Layer("b", "line", np.array([[0.0, 0.0, 0.0]]), (255, 0, 51), name="one"),
    ]
    head, text = pack(layers)
    steps = np.frombuffer(base64.b64decode(text), dtype="<u2").reshape(-1, 3)
    expected = np.concatenate([layer.points for layer in layers])
    np.testing.assert_allclose(steps * head["step"] + np.array(head["origin"]), expected, atol=head["step"] / 2 + 1e-9)
    assert head["step"] == pytest.approx(1000.0 / 65535)
    assert [(each["start"], each["n"], each["name"]) for each in head["layers"]] == [(0, 2, "a"), (2, 1, "one")]
    assert head["layers"][1]["rgb"] == [1.0, 0.0, 0.2]
    assert pack([])[1] == ""


def test_the_page_holds_every_layer_in_the_colours_of_the_report() -> None:
    shown = with_rock(content())
    scene, points = scene_of(render_answer_page(shown))
    layers = list_layers(shown)
    np.testing.assert_allclose(points, np.concatenate([each.points for each in layers]), atol=scene["step"])
    colours = {each["name"]: tuple(round(255 * part) for part in each["rgb"]) for each in scene["layers"]}
    assert colours["map before"] == colours["roof before"] == colours["path before"] == BEFORE_RGB
    assert colours["map after"] == colours["path after"] == AFTER_RGB
    assert colours["path before, not seen"] == WRONG_RGB
    assert (colours["added"], colours["moved"]) == (CHANGE_RGB["added"], CHANGE_RGB["moved"])
    assert colours["rock +2 to +5 cm"] == ROCK_RGB[6]
    assert colours["rock -20 cm and more"] == ROCK_RGB[0]
    groups = [(each["group"], each["shown"]) for each in scene["layers"] if each["kind"] == "points"]
    assert set(groups) == {
        ("map before", True), ("roof before", False), ("map after", True), ("roof after", False), ("added", True),
        ("moved", True), ("rock that moved", True), (ELSEWHERE, False),
    }  # fmt: skip
    regions = [each for each in scene["layers"] if each["group"] == "regions"]
    assert len(regions) == 1, "the withdrawn region is not drawn"


def test_the_slider_follows_the_path_and_starts_at_the_first_object() -> None:
    scene, _ = scene_of(render_answer_page(content()))
    np.testing.assert_allclose(scene["path"], content().paths[0], atol=1e-5)
    np.testing.assert_allclose(scene["chainage"], np.linspace(0, LENGTH_M, 151), atol=1e-5)
    assert scene["near"] == [True] * 111 + [False] * 40
    assert scene["path"][scene["at"]][0] == pytest.approx(30.0, abs=0.3)
    assert [each["text"] for each in scene["names"]] == ["0 added", "1 moved", "2 moved"]


def test_the_page_says_what_a_person_asks_and_lists_the_objects() -> None:
    page = render_answer_page(content())
    assert '<p class="summary" id="sentence">1 added, 1 moved 2.3 m; 55 m compared, 20 m not seen</p>' in page
    table = page.partition('id="table-1"')[2].partition("</table>")[0]
    rows = [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(<td>.*?)</tr>", table)]
    assert [row[:2] + row[3:] for row in rows] == [
        ["0", "added", "1.20x0.80x0.50", "0.43", "-"],
        ["1", "moved", "1.20x0.80x0.50", "0.43", "2.30 to 2"],
        ["2", "moved", "1.20x0.80x0.50", "0.43", "2.30 from 1"],
    ]


def test_the_tables_hold_nothing_for_an_empty_answer() -> None:
    assert len(tabulate_objects(EMPTY)) == len(tabulate_regions(EMPTY)) == 0
    empty = replace(content(), report=replace(EMPTY, coverage=content().report.coverage))
    assert "Objects: none" in render_answer_page(empty)


def test_a_page_of_as_many_points_as_there_may_be_is_small_and_asks_no_network() -> None:
    page = render_answer_page(content(n_points=MAX_POINTS))
    assert len(page.encode()) < 5_000_000
    assert not re.search(r"""(?:src|href|url)\s*[=(]\s*["']?(?!data:|#)[a-z]*:?//""", page)
    assert "http" not in page.replace("http-equiv", "")
    assert not re.search(r"\b(fetch|XMLHttpRequest|import)\s*\(", page)


def test_paths_of_many_scans_are_thinned_and_keep_their_ends_and_what_was_not_seen() -> None:
    n = 100_000
    path = np.column_stack([np.linspace(0, LENGTH_M, n), np.zeros((n, 2))])
    is_near = np.arange(n) != 50_003  # one scan
    report = replace(EMPTY, coverage=replace(covered(75.0, 0.0), is_near=is_near))
    layers = list_layers(replace(content(), report=report, paths=(path, path)))
    groups = ("path before", "path before, not seen", "path after")
    lines = {group: [layer.points for layer in layers if layer.group == group] for group in groups}
    assert sum(map(len, lines["path before"])) <= 20_000
    assert sum(map(len, lines["path after"])) == 20_000
    for group in ("path before", "path after"):
        np.testing.assert_array_equal([lines[group][0][0], lines[group][-1][-1]], path[[0, -1]])
    (red,) = lines["path before, not seen"]
    assert red[0, 0] <= path[50_003, 0] <= red[-1, 0]
    assert np.ptp(red[:, 0]) < 3 * LENGTH_M / 20_000


def test_hostile_names_stay_text() -> None:
    page = render_answer_page(content(("</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>")))
    assert "<script>alert" not in page and "<img src=x" not in page
    scene_of(page)


def test_the_same_answer_gives_the_same_bytes() -> None:
    assert render_answer_page(content()) == render_answer_page(content())


def test_the_view_has_the_same_colours_and_moves_both_sensors() -> None:
    shown = with_rock(content())
    view = view_answer(shown)
    assert view.title == str(shown.report)
    clouds = {cloud.name: next(iter(cloud.colours.values()))[0].tolist() for cloud in view.clouds}
    assert clouds["map/before"] == list(BEFORE_RGB)
    assert clouds["changes/moved/object 2"] == list(CHANGE_RGB["moved"])
    assert clouds["displacement/rock +2 to +5 cm"] == list(ROCK_RGB[6])
    assert [line.name for line in view.lines] == [
        "regions/region", "paths/before", "paths/before, not seen", "paths/after",
    ]  # fmt: skip
    assert ((90, 90, 90), "regions") in view.legend
    assert view.play is not None
    for share, before_m, after_m in ((0.0, 0.0, 0.0), (1.0, LENGTH_M, 55.0)):
        surfaces, _ = view.play(share)
        middles = [surface.mesh.vertices.mean(axis=0)[0] for surface in surfaces]
        assert middles == pytest.approx([before_m, after_m], abs=0.02)


def test_the_style_is_that_of_the_other_pages() -> None:
    assert f"--accent: {BLUE.lower()}" in render_answer_page(content())


@needs_browser
def test_the_picture_is_drawn_offline_and_nothing_is_complained_of(tmp_path: Path) -> None:
    file = tmp_path / "answer.html"
    file.write_text(render_answer_page(with_rock(content())), encoding="utf-8")
    shown, complaints = opened(file, tmp_path, "--dump-dom", "--enable-unsafe-swiftshader")
    # a browser without a graphics card says that it draws slowly
    assert [line for line in complaints.splitlines() if "GL Driver Message" not in line] == []
    assert re.search(r'id="trouble" hidden', shown)
    assert shown.count('<input type="checkbox"') == 12
    assert "30.0 m of 75.0 m" in shown
