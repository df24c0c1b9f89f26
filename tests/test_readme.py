"""The README: its recipes run, its figures are rows of committed tables, its length stays."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import trimesh

from eval.cli.main import main
from eval.core.tablefile import read_table, table_file

pytestmark = pytest.mark.usefixtures("usual_repeat_below_s")

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()

# What makes a recipe small enough for a test; each must stand in the README.
SMALLER = {
    "train/narrow train/wide train/network train/tight train/gallery train/low train/mine --seeds 100:110": (
        "smoke/one_box --seeds 3:4 --draws 2"
    ),
    "narrow wide network tight train/gallery train/low train/mine --seeds 10000:10004": (
        "smoke/one_box --seeds 10003:10004 --draws 2"
    ),
    "tunnelcd train data --out trained": "tunnelcd train data --out trained --steps 3 --threads 1",
    "--out grid\n": "--out grid --limit 16\n",
    "tunnelcd report bench": "tunnelcd report bench --views none",
    "tunnelcd report grid": "tunnelcd report grid --views none",
}


def block(title: str) -> str:
    """Return the code block whose first line ends in this title."""
    found = re.search(rf"^```\w+ {re.escape(title)}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
    assert found is not None, title
    return found[1]


def tunnelcd(*words: str) -> None:
    """Run a command of ours in this process."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code, words


@pytest.fixture(name="recipe")
def recipe_fixture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Run the commands of a block in an empty folder: ours in this process, others in one of their own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def run(title: str) -> None:
        text = block(title)
        for large, small in SMALLER.items():
            text = text.replace(large, small)
        for line in text.splitlines():
            program, *arguments = shlex.split(line, comments=True)
            if program == "tunnelcd":
                tunnelcd(*arguments)
            else:
                assert program == "python", line
                subprocess.run([sys.executable, *arguments], check=True)

    return run


def test_every_word_that_makes_a_recipe_small_is_in_it() -> None:
    for large in SMALLER:
        assert large in README


def test_the_lines_of_python_simulate_detect_score_and_plot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(block("api"), "README.md", "exec"), {})
    assert float(capsys.readouterr().out.split()[-1]) > 0.8
    assert Path("answer/objects.ply").is_file()
    assert Path("changes.png").stat().st_size > 1000


def test_a_method_of_ones_own_is_benchmarked(recipe: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    recipe("benchmark")
    rows = pd.read_csv("bench/results.csv").set_index(["scenario", "variant"])
    assert rows.loc[("smoke/one_box", "my-method"), "region_recall"] == 1
    assert {variant for _, variant in rows.index} > {"my-method", "tunnelcd", "paper"}
    assert "my-method" in Path("bench/index.html").read_text()
    assert "my-method" in Path("board.html").read_text()


def test_radius_and_voxel_are_ablated(recipe: Callable[[str], None]) -> None:
    recipe("ablate")
    rows = pd.read_csv("grid/results.csv")
    ours = rows[rows["variant"].str.startswith("tunnelcd[") & (rows["scenario"] == "smoke/one_box")]
    assert len(ours) == 4
    assert ours["object_iou_point"].nunique() > 1
    assert Path("grid/index.html").is_file()


def test_training_data_is_made_and_trained_on(
    recipe: Callable[[str], None], shards_once: Callable[..., list[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("eval.training.dataset_run.make_shards", shards_once)
    recipe("train")
    assert {path.name for path in Path("trained").iterdir()} >= {"sphere.safetensors", "sphere.json", "curves.csv"}


def test_recordings_are_compared(recipe: Callable[[str], None]) -> None:
    pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
    tunnelcd("simulate", "smoke/one_box", "--seed", "10600", "--out", "pair", "--quiet")
    for session, day in (("before", "monday"), ("after", "friday")):
        tunnelcd("convert", f"pair/{session}", f"{day}.osf")
    recipe("record")
    assert pd.read_csv("changes/objects.csv")["kind"].tolist() == ["added"]
    assert Path("changes/objects.ply").is_file()
    assert Path("changes/answer.html").is_file()


def test_a_mine_from_a_file_is_simulated(recipe: Callable[[str], None]) -> None:
    rock = trimesh.creation.box(extents=(40.0, 4.0, 3.0)).subdivide().subdivide()
    rock.vertices[:, 1] *= 1.2 + rock.vertices[:, 0] / 100.0  # the same from both ends, no merge could tell them apart
    rock.apply_translation((20.0, 0.0, 1.5))
    rock.invert()
    rock.export("mine.stl")
    recipe("mine")
    assert pd.read_csv("answer/objects.csv")["kind"].tolist() == ["added"]
    assert Path("mine.png").stat().st_size > 1000


def test_the_table_of_results_is_made_of_committed_rows() -> None:
    folder = ROOT / "reports" / "main"
    key = ["odometry", "domain", "variant"]
    cost = pd.read_csv(folder / "pareto.csv").query("cost == 't_total_s'").drop_duplicates(key[1:]).set_index(key[1:])
    regions = read_table(table_file(folder / "regions_table.csv")).set_index(key)
    objects = read_table(table_file(folder / "objects_table.csv")).set_index(key)
    section = README[README.index("## Results") : README.index("## Five recipes")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if "| `" in line]
    assert 0 < len(rows) <= 10
    for odometry, domain, name, *shown in rows:
        row = odometry.lower(), domain, name.strip("`")
        figures = [
            *regions.loc[row, ["region_auroc", "region_recall", "recall_at_0.1", "false_regions_per_100m"]],
            *objects.loc[row, ["object_iou_point", "object_f1_50"]],
        ]
        # what a method costs was measured on the pairs that the figures are of
        time = f"{cost.loc[row[1:], 'cost_value']:.1f}" if row[0] == "kiss-icp" else "-"
        assert shown == [*(f"{figure:.2f}" for figure in figures), time], row
