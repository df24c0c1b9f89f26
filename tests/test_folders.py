"""Folders of cdpipe and sim say what they are, export what their stubs list, and load nothing heavy when imported.

Files that `tests/conftest.py` names exist.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import LONG_S

ROOT = Path(__file__).parents[1]
HEAVY = {"cdpipe": {"torch", "scipy", "small_gicp"}, "sim": {"mujoco", "scipy", "trimesh"}}
FOLDERS = {
    package: sorted(".".join(file.relative_to(ROOT).parent.parts) for file in (ROOT / package).rglob("__init__.pyi"))
    for package in HEAVY
}


def test_every_folder_of_sim_has_a_stub() -> None:
    assert len(FOLDERS["sim"]) == len(list((ROOT / "sim").rglob("__init__.py")))


@pytest.mark.parametrize("name", [name for names in FOLDERS.values() for name in names])
def test_exported_names_exist(name: str) -> None:
    folder = importlib.import_module(name)
    assert folder.__doc__
    assert folder.__all__
    assert all(getattr(folder, exported) is not None for exported in folder.__all__)


def test_files_that_begin_first_exist() -> None:
    assert [file for file in LONG_S if not (ROOT / file).is_file()] == []


@pytest.mark.parametrize("package", HEAVY)
def test_importing_the_folders_loads_nothing_heavy(package: str) -> None:
    imports = "; ".join(f"import {name}" for name in FOLDERS[package])
    code = f"import sys; {imports}; print(*({HEAVY[package]} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []
