from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, require_poses, yaw_pose
from cdpipe.io.foreign import HowToRead
from cdpipe.io.known_merge import read_known_merge, require_rigid

POSE = yaw_pose(0.3, (4.0, -5.0, 0.25))
ROUNDED = POSE.round(6).tolist()


def as_text(matrix: list[list[float]]) -> str:
    return "\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix)


@pytest.mark.parametrize(
    "text",
    [
        as_text(ROUNDED),
        as_text(ROUNDED[:3]),
        as_text(ROUNDED[:3]).replace("\n", " "),
        json.dumps(ROUNDED),
        json.dumps({"status": "ok", "before_T_after": ROUNDED}),
    ],
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


def test_a_matrix_is_between_the_frames_before_an_origin_is_subtracted(tmp_path: Path) -> None:
    grid_T_grid = yaw_pose(np.pi / 2, (7.0, 0.0, 1.0))  # (x, y, z) -> (7 - y, x, z + 1)
    (tmp_path / "T").write_text(json.dumps(grid_T_grid.tolist()))
    before_m, after_m = (5000.0, 4000.0, 300.0), (4000.0, -5000.0, 299.0)
    found = read_known_merge(tmp_path / "T", (before_m, after_m))
    # the after session's (0, 0, 0) as read is (4000, -5000, 299) of the grid, which lands on (5007, 4000, 300)
    np.testing.assert_allclose(found, yaw_pose(np.pi / 2, (7.0, 0.0, 0.0)), atol=1e-9)
    # one origin for both, and a session that has none
    same = read_known_merge(tmp_path / "T", (before_m, before_m))
    np.testing.assert_allclose(same[:3, 3], (7.0 - 4000.0 - 5000.0, 5000.0 - 4000.0, 1.0), atol=1e-9)
    one = read_known_merge(tmp_path / "T", ((0.0, 0.0, 0.0), after_m))
    np.testing.assert_allclose(one[:3, 3], (5007.0, 4000.0, 300.0), atol=1e-9)


def test_the_merge_of_an_answer_is_between_what_was_read(tmp_path: Path) -> None:
    answer = {"format": "tunnelcd-answer", "format_version": 1, "before_T_after": POSE.tolist()}
    (tmp_path / "answer.json").write_text(json.dumps(answer))
    origin_m = (5000.0, 4000.0, 300.0)
    np.testing.assert_allclose(read_known_merge(tmp_path / "answer.json", (origin_m, origin_m)), POSE, atol=1e-12)


def test_an_origin_is_subtracted_from_positions_that_were_recorded_alone(tmp_path: Path) -> None:
    origin_m = (5000.0, 4000.0, 300.0)
    assert HowToRead(origin_m=origin_m).subtracted_m(tmp_path) == origin_m
    assert HowToRead(origin_m=origin_m, odometry="kiss-icp").subtracted_m(tmp_path) == (0.0, 0.0, 0.0)
    (tmp_path / "session.json").touch()
    assert HowToRead(origin_m=origin_m).subtracted_m(tmp_path) == (0.0, 0.0, 0.0)
