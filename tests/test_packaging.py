"""The wheel holds the four packages whole and nothing else, and works where there is no checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("cdpipe", "eval", "scenarios", "sim")
NOT_PACKED = shutil.ignore_patterns("__pycache__", "*.egg-info")


def run(*command: str | Path, cwd: Path) -> str:
    """Run a program that must succeed, without the checkout on its path, and return what it printed."""
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = subprocess.run(command, cwd=cwd, env=own, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout


@pytest.fixture(name="wheel", scope="module")
def wheel_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, because setuptools leaves its build folder beside the sources."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in (*PACKAGES, "tests"):  # tests lie beside the packages and must stay out
        shutil.copytree(ROOT / name, source / name, ignore=NOT_PACKED)
    options = ("--quiet", "--no-build-isolation", "--no-deps", "--no-index")
    run(sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", folder, source, cwd=folder)
    (wheel,) = folder.glob("tunnelcd-*.whl")
    return wheel


@pytest.fixture(name="installed", scope="module")
def installed_fixture(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel into an environment of its own that borrows the packages it needs; return its programs."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    paths = {"base": str(folder), "platbase": str(folder)}
    packages = Path(sysconfig.get_path("purelib", scheme="venv", vars=paths))
    borrowed = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "borrowed.pth").write_text("\n".join(sorted(borrowed)))
    programs = Path(sysconfig.get_path("scripts", scheme="venv", vars=paths))
    options = ("--quiet", "--no-deps", "--no-index", "--ignore-installed")
    run(sys.executable, "-m", "pip", "--python", programs / "python", "install", *options, wheel, cwd=folder)
    return programs


def test_the_wheel_holds_the_packages_whole_and_nothing_else(wheel: Path) -> None:
    expected = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert packed == expected
    assert {f"{package}/py.typed" for package in PACKAGES} <= packed


def test_the_installed_command_runs_a_plan_outside_the_checkout(installed: Path, tmp_path: Path) -> None:
    (where,) = run(installed / "python", "-c", "import cdpipe; print(cdpipe.__file__)", cwd=tmp_path).splitlines()
    assert Path(where).is_relative_to(installed.parent)
    listed = run(installed / "tunnelcd", "list", cwd=tmp_path)
    assert {"smoke", "main", "paper/site1", "regions/cave", "voxel-diff"} <= set(listed.replace(",", " ").split())
    run(installed / "tunnelcd", "run", "smoke", "--limit", "1", "--quiet", "--out", "out", cwd=tmp_path)
    assert pd.read_csv(tmp_path / "out" / "results.csv")["status"].tolist() == ["ok"]
    run(installed / "tunnelcd", "report", "out", "--views", "none", "--quiet", cwd=tmp_path)
    assert (tmp_path / "out" / "index.html").is_file()
