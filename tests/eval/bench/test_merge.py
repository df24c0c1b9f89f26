from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import MergeFailedError
from cdpipe.core.geometry import yaw_pose
from cdpipe.merge.global_registration import is_kiss_matcher_installed
from cdpipe.model.types import MergedMaps
from eval.bench import merge as merge_bench
from eval.bench.bench import descriptor_contests, list_contests, make_row, measure, summarise
from eval.bench.merge import Goals, MergeSite, merge_contests, paper_sites
from sim.studies.bench import BenchSite

needs_kiss_matcher = pytest.mark.skipif(not is_kiss_matcher_installed(), reason="needs the extra `kiss`: KISS-Matcher")
ROWS = ["merge-tiny", "merge-tiny-raced", "merge-tiny-index", "merge-tiny-all-in", "merge-tiny-refine"]
PARTS = {"t_index_s": 2.0, "t_merge_s": 0.5, "t_refine_s": 8.0}


@pytest.fixture(scope="module")
def site(thinned: None) -> MergeSite:
    """The smallest world there is."""
    return MergeSite("tiny", "smoke/one_box", Goals(0.1, 4.0, 10.0, 3.0), kiss_voxel_m=0.5, repeats=2)


def told(monkeypatch: pytest.MonkeyPatch, before_T_after: np.ndarray, reason: str = "") -> None:
    """Let every merge come out so."""

    def merge(before: Any, after: Any, config: Any) -> MergedMaps:
        return MergedMaps(before.map, after.map, before_T_after, {}, not reason, reason, None, PARTS)

    monkeypatch.setattr(merge_bench, "merge_maps", merge)


def test_rows_of_both_paper_sites_stand_in_the_table() -> None:
    names = list(list_contests())
    for size in ("60k", "1400k"):
        assert [name for name in names if size in name and "merge" in name] == [
            name.replace("tiny", size) for name in ROWS
        ]
    goals = [each.goals for each in paper_sites()]
    assert goals == [Goals(0.051, 0.1, 10.0, 3.0), Goals(0.1, 0.3, 10.0, 5.0, 0.7)]


@needs_kiss_matcher
def test_real_rows_of_a_small_world(site: MergeSite) -> None:
    every = list_contests(BenchSite("smoke/one_box"), [site])
    rows = {row["name"]: row for row in measure({name: every[name] for name in ROWS})["rows"]}
    assert list(rows) == ROWS
    assert {row["unit"] for row in rows.values()} == {"s"}
    assert all(0 < row["value"] < 60 for row in rows.values())
    assert (rows["merge-tiny"]["rival"], rows["merge-tiny"]["rival_value"]) == ("its limit, 100 ms", 0.1)
    assert rows["merge-tiny-index"]["rival_value"] == 4.0
    raced, all_in = rows["merge-tiny-raced"], rows["merge-tiny-all-in"]
    assert raced["rival"] == "KISS-Matcher at 0.5 m and GICP"
    assert all_in["rival"].startswith(f"{raced['rival']} (ours: descriptors + index + merge to a rigid transform")
    assert raced["rival_value"] == all_in["rival_value"]
    assert (raced["n"], raced["target"], all_in["target"]) == (2, 10.0, 3.0)
    assert raced["value"] == rows["merge-tiny"]["value"]
    assert all_in["value"] > raced["value"] + rows["merge-tiny-index"]["value"]
    assert rows["merge-tiny-refine"]["met"] is None
    json.dumps(rows)


def test_rows_of_descriptors_and_query(site: MergeSite) -> None:
    rows = {row["name"]: row for row in measure(dict(descriptor_contests(site)))["rows"]}
    limits = {"3deg-tiny-per-scan": 0.1, "sphere-tiny-per-keyframe": 0.003, "query-tiny-per-region": 0.016}
    assert {name: row["rival_value"] for name, row in rows.items()} == limits
    assert all(0 < row["value"] < 1 and row["target"] == 1.0 for row in rows.values())


def test_all_in_is_descriptors_index_and_merge(site: MergeSite) -> None:
    described = [replace(each, descriptor_s=(1.0, 3.0), first_share=1.0, asked=[]) for each in site.sessions]
    fixed = replace(site)  # the same pair, none of its times
    fixed.__dict__.update(sessions=tuple(described), raced=([PARTS, PARTS], [9.0, 9.0]), rival=("told", True))
    row = make_row("all-in", dict(merge_contests(fixed))["merge-tiny-all-in"]())
    # 1 + 1 + 2 + 0.5 and 3 + 3 + 2 + 0.5
    assert (row["value"], row["rival_value"], row["spread"]) == (6.5, 9.0, 2.0)
    # half of the keyframes sufficed; then one session had to describe all
    fixed.__dict__["sessions"] = tuple(replace(each, first_share=0.5) for each in described)
    assert make_row("all-in", dict(merge_contests(fixed))["merge-tiny-all-in"]())["value"] == 4.5
    fixed.__dict__["sessions"][0].asked.append("before")
    assert make_row("all-in", dict(merge_contests(fixed))["merge-tiny-all-in"]())["value"] == 5.5


@needs_kiss_matcher
def test_how_far_a_merge_missed(site: MergeSite) -> None:
    true = site.rival_pose()
    assert true is not None
    assert site.missed_m(true) < 0.1
    assert site.missed_m(yaw_pose(0.0, (3.0, 4.0, 0.0)) @ true) == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(
    ("pose", "reason", "message"),
    [(np.eye(4), "too smooth", "too smooth"), (yaw_pose(0.0, (700.0, 0.0, 0.0)), "", "m off")],
    ids=["refused", "wrong"],
)
def test_the_time_of_a_merge_that_failed_is_no_figure(
    site: MergeSite, monkeypatch: pytest.MonkeyPatch, pose: np.ndarray, reason: str, message: str
) -> None:
    told(monkeypatch, pose, reason)
    with pytest.raises(MergeFailedError, match=f"smoke/one_box seed 0 cannot be merged: .*{message}"):
        site.merge("none")
    monkeypatch.setattr(merge_bench, "is_kiss_matcher_installed", lambda: False)
    failing = replace(site)
    failing.__dict__["sessions"] = site.sessions
    rows = measure(dict(merge_contests(failing)))["rows"]
    assert [row["name"] for row in rows] == ROWS
    assert {(row["value"], row["met"]) for row in rows} == {(None, False)}
    assert [row["target"] for row in rows] == [1.0, 10.0, 1.0, 3.0, None]
    assert all(message in row["reason"] for row in rows)
    assert summarise(rows) == f"0 of 5 targets met; missed: {', '.join(ROWS)}"


def test_turns_are_taken_and_the_first_does_not_count(site: MergeSite, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def merge(self: MergeSite, refine: str) -> Mapping[str, float]:
        calls.append("ours")
        return {"number": float(len(calls))}

    monkeypatch.setattr(merge_bench, "is_kiss_matcher_installed", lambda: True)
    monkeypatch.setattr(MergeSite, "merge", merge)
    monkeypatch.setattr(MergeSite, "rival_pose", lambda self: calls.append("rival"))
    ours, rival = replace(site).raced
    assert calls == ["rival", "ours", "ours", "rival", "rival", "ours"]
    assert [each["number"] for each in ours] == [3.0, 6.0]
    assert len(rival) == 2


def test_a_rival_that_is_wrong_or_missing_is_told(site: MergeSite, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong, nothing = replace(site), replace(site)
    wrong.__dict__["sessions"] = nothing.__dict__["sessions"] = site.sessions
    monkeypatch.setattr(merge_bench, "is_kiss_matcher_installed", lambda: True)
    monkeypatch.setattr(merge_bench, "kiss_and_gicp", lambda *clouds: yaw_pose(0.0, (700.0, 0.0, 0.0)))
    name, is_comparable = wrong.rival
    assert name.startswith("KISS-Matcher at 0.5 m and GICP: not judged, ")
    assert name.endswith(" m off")
    assert not is_comparable
    # a thousand times slower, and wrong: no target is met by that
    wrong.__dict__["raced"] = ([PARTS, PARTS], [500.0, 500.0])
    row = make_row("raced", dict(merge_contests(wrong))["merge-tiny-raced"]())
    assert (row["rival"], row["ratio"], row["target"], row["met"]) == (name, None, 10.0, None)
    monkeypatch.setattr(merge_bench, "kiss_and_gicp", lambda *clouds: None)
    assert nothing.rival == ("KISS-Matcher at 0.5 m and GICP: not judged, it found nothing", False)
    missing = replace(site)
    missing.__dict__["sessions"] = site.sessions
    monkeypatch.setattr(merge_bench, "is_kiss_matcher_installed", lambda: False)
    told(monkeypatch, np.eye(4))
    monkeypatch.setattr(MergeSite, "missed_m", lambda self, pose: 0.0)
    row = make_row("raced", dict(merge_contests(missing))["merge-tiny-raced"]())
    assert row["rival"] == "KISS-Matcher: not installed (extra `kiss`)"
    assert (row["value"], row["ratio"], row["met"], row["n"]) == (0.5, None, None, 2)
