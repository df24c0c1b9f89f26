"""Packages of others, installed as their guides say: listed, run in a plan, and scored, with no change of ours."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]
PLAN = """
name: plugged
scenarios: [smoke/one_box]
seeds: [10]
variants:
  - {preset: higher}
  - {preset: from_folder}
  - {preset: higher, set: [options.step_m=100]}
"""


def write_guide(page: Path, folder: Path) -> None:
    """Write the files that a guide shows, each under the name above it."""
    for name, content in re.findall(r"^`([^`]+)`\n\n```\w+\n(.*?)^```", page.read_text(), re.M | re.S):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment in which both examples are installed, and a folder lies on the search path."""
    root = tmp_path_factory.mktemp("plugins")
    site = root / "site"
    for page, name in (("cdpipe/methods/HOWTO.md", "method"), ("eval/scoring/HOWTO.md", "metric")):
        write_guide(ROOT / page, root / name)
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target"]
        done = subprocess.run([*pip, site, root / name], check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    (root / "path" / "presets").mkdir(parents=True)
    (root / "path" / "presets" / "from_folder.yaml").write_text(
        "regions: {source: c2c}\nextract: {method: clusters}\nquery: {threshold: 20}\n"
    )
    (root / "path" / "plans").mkdir()
    (root / "path" / "plans" / "plugged.yaml").write_text(PLAN)
    python_path = os.pathsep.join([str(ROOT), str(site)])
    return {**os.environ, "PYTHONPATH": python_path, "TUNNELCD_PATH": str(root / "path"), "OUT": str(root / "run")}


def tunnelcd(installed: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    program = "from eval.cli.main import main; main()"
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, env=installed, capture_output=True, text=True, check=False)


def test_plugins_are_listed(installed: dict[str, str]) -> None:
    listed = tunnelcd(installed, "list").stdout.split()
    assert listed.count("higher") == 2  # the method and its preset
    assert {"from_folder", "plugged", "largest"} <= set(listed)
    for kind, name in (("methods", "higher"), ("metrics", "largest")):
        lines = tunnelcd(installed, "list", kind).stdout.splitlines()
        assert any(line.split()[0] == name and len(line.split()) > 4 for line in lines)  # the line of its docstring


def test_plugins_run_in_a_plan_and_are_scored(installed: dict[str, str]) -> None:
    out = Path(installed["OUT"])
    done = tunnelcd(installed, "run", "plugged", "--out", str(out), "--quiet")
    assert done.returncode == 0, done.stderr
    rows = pd.read_csv(out / "results.csv").set_index("variant")
    assert (rows["status"] == "ok").all()
    # the box that came, and neither walls nor roof
    assert (rows.loc["higher", "n_objects"], rows.loc["higher", "object_f1_25"]) == (1, 1)
    assert rows.loc["higher", "largest_object_returns"] > 0
    # its own setting reaches it: nothing stands 100 m higher
    assert rows.loc["higher[options.step_m=100]", "n_objects"] == 0
    assert rows["largest_change_cells"].nunique() == 1


def test_a_method_that_nobody_registered_is_refused_by_name(installed: dict[str, str], tmp_path: Path) -> None:
    preset = tmp_path / "own.yaml"
    preset.write_text("regions: {source: highr}\n")
    done = tunnelcd(installed, "detect", "a", "b", "--preset", str(preset), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "own.yaml:1: regions.source" in line
    assert "higher" in line
