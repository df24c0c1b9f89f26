from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, require_poses, yaw_pose
from cdpipe.io.known_merge import read_known_merge, require_rigid

POSE = yaw_pose(0.3, (4.0, -5.0, 0.25))
ROUNDED = POSE.round(6).tolist()


def as_text(matrix: list[list[float]]) -> str:
    return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix)


@pytest.mark.parametrize(
    "text", [as_text(ROUNDED), json.dumps(ROUNDED), json.dumps({"status": "ok", "before_T_after": ROUNDED})]
)
def test_text_json_and_answers_are_read_and_rounding_is_taken_back(tmp_path: Path, text: str) -> None:
    (tmp_path / "T").write_text(text + "\n")
    found = read_known_merge(tmp_path / "T")
    np.testing.assert_allclose(found, POSE, atol=1e-6)
    assert np.abs(np.array(ROUNDED)[:3, :3] @ np.array(ROUNDED)[:3, :3].T - np.eye(3)).max() > 1e-8
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-14


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (as_text(POSE.round(3).tolist()), "is not rigid"),
        (as_text((2 * np.eye(4)).tolist()), "is not rigid"),
        (as_text(np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "is not rigid"),
        (as_text(make_pose(translation=(1.0, 0.0, 0.0)).T.tolist()), "is not rigid"),
        (as_text(np.full((4, 4), np.nan).tolist()), "is not finite"),
        (as_text(np.eye(3).tolist()), r"is \(3, 3\)"),
        ("1 0 0\n0 1", "inhomogeneous"),
        ("one two", "could not convert"),
        ("", r"is \(0,\)"),
        ("{}", "NoneType|is "),
        ("[[1, 2", "JSON|column|Expecting"),
        ("\xff", "could not convert|decode"),
    ],
)
def test_anything_else_is_one_line(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "T").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=told) as caught:
        read_known_merge(tmp_path / "T")
    assert str(caught.value).startswith(f"{tmp_path / 'T'}: ") and "\n" not in str(caught.value)
    assert "expected a 4x4 rigid transform" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"T: missing: expected a 4x4 rigid transform"):
        read_known_merge(tmp_path / "T")


def test_an_array_becomes_exactly_rigid() -> None:
    found = require_rigid(ROUNDED)
    require_poses("found", found[None])
