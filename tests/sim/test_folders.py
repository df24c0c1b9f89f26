"""Every folder of sim says what it is, exports what its stub lists, and loads nothing heavy when imported."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import sim

ROOT = Path(str(sim.__file__)).parent
FOLDERS = sorted(".".join(file.relative_to(ROOT.parent).parent.parts) for file in ROOT.rglob("__init__.pyi"))


def test_every_folder_has_a_stub() -> None:
    assert len(FOLDERS) == len(list(ROOT.rglob("__init__.py")))


@pytest.mark.parametrize("name", FOLDERS)
def test_exported_names_exist(name: str) -> None:
    folder = importlib.import_module(name)
    assert folder.__doc__
    assert folder.__all__
    assert all(getattr(folder, exported) is not None for exported in folder.__all__)


def test_importing_the_folders_loads_neither_mujoco_nor_scipy() -> None:
    imports = "; ".join(f"import {name}" for name in FOLDERS)
    code = f"import sys; {imports}; print(*({{'mujoco', 'scipy', 'trimesh'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
