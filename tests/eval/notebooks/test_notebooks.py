"""The notebooks: notebooks without outputs whose links lead somewhere; `make soak` and `make sweep` execute them."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

nbformat = pytest.importorskip("nbformat", reason="pip install 'tunnelcd[dev]'")

ROOT = Path(__file__).parents[3]
NOTEBOOKS = sorted((ROOT / "eval" / "notebooks").glob("*.ipynb"))
SECONDS = 1200  # of one cell; on two busy cores a whole notebook takes less than half of it


def read(path: Path) -> Any:
    return nbformat.read(path, as_version=4)


def written_file(notebook: str, name: str) -> str:
    """Return the content of the cell that writes a file."""
    (source,) = [
        cell.source
        for cell in read(ROOT / "eval" / "notebooks" / f"{notebook}.ipynb").cells
        if cell.source.startswith(f"%%writefile {name}\n")
    ]
    return str(source).partition("\n")[2]


def execute(name: str, folder: Path) -> None:
    """Execute a notebook in a folder; a cell that fails raises."""
    client = pytest.importorskip("nbclient", reason="pip install 'tunnelcd[dev]'")
    pytest.importorskip("ipykernel", reason="pip install 'tunnelcd[dev]'")
    notebook = read(ROOT / "eval" / "notebooks" / f"{name}.ipynb")
    place = {"metadata": {"path": str(folder)}}
    client.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=place).execute()


def test_there_are_two_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["own_method", "own_mine"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_holds_no_outputs(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(code) > 5
    assert [cell.id for cell in code if cell.outputs or cell.execution_count is not None or cell.metadata] == []
    assert path.stat().st_size < 20_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_links_of_a_notebook_lead_somewhere(path: Path) -> None:
    text = "\n".join(cell.source for cell in read(path).cells if cell.cell_type == "markdown")
    targets = re.findall(r"\]\(([^)#\s]+)", text)
    assert len(targets) > 3
    assert [target for target in targets if not (path.parent / target).exists()] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_command_that_fails_ends_the_notebook(path: Path) -> None:
    for cell in read(path).cells:
        if cell.cell_type == "code" and re.search(r"^tunnelcd ", cell.source, re.M):
            assert cell.source.startswith("%%bash -e\n")


def test_the_method_has_fifteen_lines_and_finds_what_came() -> None:
    tree = ast.parse(written_file("own_method", "mine.py"))
    (function,) = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "find_changes"]
    assert (function.end_lineno or 0) - function.lineno < 15
    names: dict[str, Any] = {"__name__": "mine"}
    exec(compile(tree, "mine.py", "exec"), names)
    x, y = np.meshgrid(np.arange(0.0, 10.0, 0.1), np.arange(-2.0, 2.0, 0.1))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    side = np.arange(0.0, 0.7, 0.1)
    box = np.stack(np.meshgrid(side + 5.0, side, side + 0.35), axis=-1).reshape(-1, 3)
    path = np.column_stack([np.arange(10.0), np.zeros(10), np.ones(10)])
    (found,) = names["find_changes"](np.concatenate([floor, box]), floor, path)
    np.testing.assert_array_equal(np.sort(found), len(floor) + np.arange(len(box)))
    assert names["find_changes"](floor, floor, path) == []
    assert names["find_changes"](np.concatenate([floor, box]), floor, path - 20) == []


@pytest.mark.soak
def test_the_notebook_of_a_method_runs(tmp_path: Path) -> None:
    execute("own_method", tmp_path)
    results = pd.read_csv(tmp_path / "bench" / "results.csv")
    own = results[results["variant"] == "mine"]
    assert own["status"].tolist() == ["ok"] * 3
    assert own["scenario"].str.partition("[")[0].nunique() == 3
    assert own["region_recall"].max() == 1
    assert "mine" in (tmp_path / "board.html").read_text()
    assert (tmp_path / "bench" / "index.html").is_file()


@pytest.mark.soak
def test_the_notebook_of_a_mine_runs(tmp_path: Path) -> None:
    execute("own_mine", tmp_path)
    assert sorted(pd.read_csv(tmp_path / "answer" / "objects.csv")["kind"]) == ["added", "removed"]
    results = pd.read_csv(tmp_path / "grid" / "results.csv")
    grid = results[results["variant"].str.contains("extract.voxel_m=")]
    assert len(grid) == 12
    assert grid["object_iou_point"].nunique() > 1
    assert (tmp_path / "grid" / "index.html").is_file()
