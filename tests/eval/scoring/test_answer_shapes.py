"""Shapes, displacements and withdrawn regions of an answer: the tables people open, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import yaw_pose
from cdpipe.io.answer import Answer
from cdpipe.io.report_files import save_report
from cdpipe.model.report import ChangedObject, ChangeRegions, ChangeReport, ObjectShape
from eval.scoring.answer_check import check_answer
from eval.truth.ground_truth import load_ground_truth

SHAPE = ObjectShape(yaw_pose(np.deg2rad(-30.0), (1.0, 2.0, 0.4)), np.array([1.5, 0.7, 0.8]), 0.25)
WENT = np.array([3.0, -4.0, 0.1])


def report() -> ChangeReport:
    points = np.array([[0.5, 2.0, 0.0], [1.5, 2.0, 0.8]])
    start = ChangedObject("before", "moved", 0, np.array([[0, 1], [0, 2]], np.int32), points, 2.0, 1, SHAPE, WENT)
    end = replace(start, session="after", points_map=points + WENT, partner=0, shape=None)
    return ChangeReport(
        before_T_after=np.eye(4),
        evidence={},
        regions=ChangeRegions(
            centres_map=np.arange(9.0).reshape(3, 3),
            radius_m=4.5,
            scores=np.array([3.0, 2.0, 1.0]),
            pairs=np.zeros((3, 2), np.int64),
            is_reported=np.array([True, False, False]),
            keyframe_scores=np.zeros(0),
            is_withdrawn=np.array([False, True, False]),
        ),
        objects=(start, end),
        seconds={},
        figures={"s_points": np.array([7.0, 8.0, 9.0])},
        keyframe_scans=(np.zeros(0, np.int64), np.zeros(0, np.int64)),
    )


def test_the_tables_by_hand(tmp_path: Path) -> None:
    save_report(report(), tmp_path)
    regions = pd.read_csv(tmp_path / "regions.csv")
    # those the threshold let through; the withdrawn one is told apart
    assert regions[["region", "score", "is_withdrawn", "x_m", "s_points"]].to_numpy().tolist() == [
        [0, 3.0, False, 0.0, 7.0],
        [1, 2.0, True, 3.0, 8.0],
    ]
    objects = pd.read_csv(tmp_path / "objects.csv")
    start, end = (row for _, row in objects.iterrows())
    assert list(start[["session", "kind", "region", "partner", "score", "n_returns", "n_points"]]) == [
        "before", "moved", 0, 1, 2.0, 2, 2,
    ]  # fmt: skip
    corners = [f"{end}_{axis}_m" for end in ("min", "max") for axis in "xyz"]
    assert list(start[corners]) == [0.5, 2.0, 0.0, 1.5, 2.0, 0.8]
    box = ["box_x_m", "box_y_m", "box_z_m", "box_length_m", "box_width_m", "box_height_m", "box_yaw_deg", "volume_m3"]
    assert list(start[box]) == pytest.approx([1.0, 2.0, 0.4, 1.5, 0.7, 0.8, -30.0, 0.25])
    for half in (start, end):
        assert list(half[[f"displacement_{axis}_m" for axis in "xyz"]]) == [3.0, -4.0, 0.1]
    assert end[box].isna().all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda item: replace(item, shape=replace(SHAPE, volume_m3=float("nan"))),
            r"objects\[0\].shape: edges 1.5, 0.7, 0.8 m and volume nan m3",
        ),
        (lambda item: replace(item, shape=replace(SHAPE, box_m=np.array([1.0, -1.0, 1.0]))), r"objects\[0\].shape"),
        (lambda item: replace(item, displacement_map=np.array([0.0, np.inf, 0.0])), r"objects\[0\].displacement_map"),
    ],
)
def test_what_cannot_be_a_size_is_refused(
    change: Callable[[ChangedObject], ChangedObject], words: str, tiny_pair: Path
) -> None:
    truth, whole = load_ground_truth(tiny_pair), report()
    # its points are of no pair; an answer need not tell them
    whole = replace(whole, objects=tuple(replace(item, points_map=np.zeros((0, 3))) for item in whole.objects))
    check_answer(Answer("ok", "", "other", whole, {}, {}), truth, Path("answers"))
    damaged = replace(whole, objects=(change(whole.objects[0]), whole.objects[1]))
    with pytest.raises(InputError, match=f"answers: not an answer to this pair: {words}"):
        check_answer(Answer("ok", "", "other", damaged, {}, {}), truth, Path("answers"))


def test_places_are_compared_with_the_pair_unless_a_plan_made_the_answer_of_it(tiny_pair: Path) -> None:
    truth, answer = load_ground_truth(tiny_pair), Answer("ok", "", "other", report(), {}, {})
    check_answer(answer, truth, Path("answers"), is_of_pair=True)
    with pytest.raises(InputError, match="answers: not an answer to this pair: "):
        check_answer(answer, truth, Path("answers"))
