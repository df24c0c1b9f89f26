"""Guides and command lines of the pages: guides do what they say, and the command line takes every line shown."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer
import typer.main

from cdpipe.descriptors import handmade
from cdpipe.sensor.ouster import load_profile
from eval.cli.commands.tools import check_file
from eval.cli.main import app
from eval.plans.cells import expand_cells
from eval.plans.files import plan_names
from eval.plans.plan import load_plan
from eval.release.content import load_release
from scenarios.library import load_scenario

ROOT = Path(__file__).parents[1]
COMMANDS = typer.main.get_command(app).commands
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *sorted(page for folder in ("cdpipe", "eval", "scenarios", "sim") for page in (ROOT / folder).rglob("*.md")),
]
NOTEBOOKS = sorted((ROOT / "eval" / "notebooks").glob("*.ipynb"))
# what stands for a number of the reader's
NUMBERS = {"N": "1", "S": "1"}


def blocks(page: Path) -> dict[str, str]:
    """Return the blocks of a guide that are files, by the name above each."""
    return dict(re.findall(r"^`([^`]+)`\n\n```\w+\n(.*?)^```", page.read_text(), re.M | re.S))


def write_blocks(page: str, folder: Path) -> Path:
    for name, content in blocks(ROOT / page).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def code_blocks(page: Path) -> list[str]:
    """Return the blocks of a page, or the cells of a notebook, of whose text only commands with arguments."""
    if page.suffix == ".ipynb":
        cells = [("".join(cell["source"]), cell["cell_type"]) for cell in json.loads(page.read_text())["cells"]]
        code, told = ("\n".join(text for text, kind in cells if kind == each) for each in ("code", "markdown"))
        return [code, *re.findall(r"`(tunnelcd [a-z]+ [^`]+)`", told)]
    return re.findall(r"^```[^\n]*\n(.*?)^```", page.read_text(), re.M | re.S)


def command_lines() -> list[tuple[str, str]]:
    """Return (page, line) of every command of ours in a block of a page or notebook; lines that go on are one."""
    found = []
    for page in (*PAGES, *NOTEBOOKS):
        for block in code_blocks(page):
            lines = [line.removeprefix("!") for line in block.replace("\\\n", " ").splitlines()]
            found += [(page.relative_to(ROOT).as_posix(), line) for line in lines if line.startswith("tunnelcd ")]
    return found


def parse(line: str) -> None:
    """Let the command line read the arguments of a line, without running the command."""
    words = shlex.split(re.split(r" [|>] ", line)[0], comments=True)[1:]
    if words[0].startswith("-"):
        return
    command = COMMANDS[words[0]]
    with command.make_context(words[0], [NUMBERS.get(word, word) for word in words[1:]]):
        pass


def test_the_command_line_takes_every_line_of_the_pages() -> None:
    lines = command_lines()
    assert {page for page, _ in lines} >= {"README.md", "eval/release/RELEASE.md", "eval/plans/HOWTO.md"}
    assert sum(page.endswith(".ipynb") for page, _ in lines) > 10
    wrong = []
    for page, line in lines:
        try:
            parse(line)
        except Exception as error:
            wrong.append((page, line, str(error)))
    assert wrong == []


@pytest.mark.parametrize(
    "line", ["tunnelcd simulat x", "tunnelcd simulate smooth --sed 1 --out x", "tunnelcd detect a --out b"]
)
def test_a_mistaken_line_is_found(line: str) -> None:
    with pytest.raises((KeyError, typer.TyperException)):
        parse(line)


def test_every_guide_is_linked_from_the_contributor_page() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    guides = {page.relative_to(ROOT).as_posix() for page in PAGES if page.name == "HOWTO.md"}
    assert len(guides) >= 8
    assert [guide for guide in sorted(guides) if f"]({guide})" not in text] == []


def test_a_plan_in_a_folder_is_a_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUNNELCD_PATH", str(write_blocks("eval/plans/HOWTO.md", tmp_path)))
    assert "thick-voxels" in plan_names()
    variants = {cell.variant for cell in expand_cells(load_plan("thick-voxels"))}
    grid = {f"voxel-diff[extract.method=voxel,extract.voxel_m={voxel_m}]" for voxel_m in (0.2, 0.5)}
    assert {"tunnelcd", *grid} <= variants
    assert check_file("thick-voxels").startswith("a plan of ")


def test_a_table_of_beams_is_a_sensor(tmp_path: Path) -> None:
    folder = write_blocks("cdpipe/sensor/HOWTO.md", tmp_path)
    assert check_file(str(folder / "eight.yaml")) == "a scenario"
    drawn = load_scenario(str(folder / "eight.yaml"), 3)
    sensor = load_profile(drawn.sensor.profile, drawn.sensor.mode)
    assert (sensor.height, sensor.width) == (8, 512)
    assert sensor.altitude_deg[0] == 14


def test_a_function_is_a_scan_descriptor() -> None:
    ((_, code),) = blocks(ROOT / "cdpipe/descriptors/HOWTO.md").items()
    names = dict(vars(handmade))
    exec(compile(code, "HOWTO.md", "exec", dont_inherit=True), names)
    describe = names["range_rings"]
    angle = np.linspace(-np.pi, np.pi, 6400, endpoint=False)
    room = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)]) * (4 + np.cos(2 * angle))[:, None]
    (q, w), turn = describe(room), 2 * np.pi / 64 * 5
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    turned_q, turned_w = describe(room @ rotation.T)
    np.testing.assert_allclose(turned_q, q, atol=1e-3)
    np.testing.assert_allclose(np.roll(w, 5), turned_w, atol=2e-2)
    assert not any(vector.any() for vector in describe(np.zeros((0, 3))))
    np.testing.assert_allclose([np.linalg.norm(q), np.linalg.norm(w), w.mean()], [1, 1, 0], atol=1e-6)


def test_the_release_of_the_guide_is_a_release(tmp_path: Path) -> None:
    folder = write_blocks("eval/release/RELEASE.md", tmp_path)
    assert len(load_release(str(folder / "tiny.yaml")).pairs) == 2
