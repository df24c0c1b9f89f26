"""An answer from above: objects that a foreign answer states as points are drawn as ours are."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from eval import plot
from sim.view.returns import CHANGE_RGB


def write_answer(folder: Path, **change: object) -> Path:
    """Write a foreign answer: one object of 5 points, 2 m on in the after odom frame."""
    folder.mkdir()
    document = {"format": "tunnelcd-answer", "format_version": 1, "status": "ok", "method": "theirs", "radius_m": 4.5}
    document |= {"before_T_after": make_pose(translation=(0, 3, 0)).tolist(), "seconds": {}}
    document |= {"objects": [{"session": "after", "kind": "added"}]}
    (folder / "answer.json").write_text(json.dumps(document | change))
    np.savez(
        folder / "answer.npz", region_centres_map=np.zeros((1, 3)), region_scores=np.ones(1),
        object_points_odom=np.array([[2.0, float(y), 0.0] for y in range(5)]), object_point_odom_offsets=[0, 5],
    )  # fmt: skip
    return folder


def test_objects_of_a_foreign_answer_are_drawn_in_the_map_frame(tmp_path: Path) -> None:
    (axes,) = plot(write_answer(tmp_path / "answer")).axes
    (drawn,) = [line for line in axes.lines if line.get_label() == "added"]
    np.testing.assert_allclose(drawn.get_xydata(), [[2.0, y + 3.0] for y in range(5)])
    assert to_rgb(drawn.get_color()) == pytest.approx(np.array(CHANGE_RGB["added"]) / 255)


def test_a_failed_answer_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "answer"
    folder.mkdir()
    document = {"format": "tunnelcd-answer", "format_version": 1, "status": "failed", "method": "theirs"}
    (folder / "answer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="status is failed"):
        plot(folder)
