import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.io import report_files
from cdpipe.io.answer import read_answer, write_answer, write_failure
from cdpipe.io.report_files import save_report
from cdpipe.model.aligned import alignment_of
from cdpipe.model.report import (
    ChangedObject,
    ChangeRegions,
    ChangeReport,
    ObjectShape,
    SurfaceField,
    SurfaceRegion,
)


def _report() -> ChangeReport:
    regions = ChangeRegions(
        centres_map=np.array([[1.0, 2, 3], [4, 5, 6]]),
        radius_m=4.5,
        scores=np.array([0.9, 0.1]),
        pairs=np.array([[0, 1], [2, 3]]),
        is_reported=np.array([True, False]),
        keyframe_scores=np.array([0.9, np.nan, 0.1]),
    )
    objects = tuple(
        ChangedObject("after", "added", 0, np.full((n, 2), n, dtype=np.int32), np.full((n, 3), float(n)), 0.5)
        for n in (3, 0, 2)
    )
    return ChangeReport(
        before_T_after=np.eye(4),
        evidence={"overlap": 0.9},
        regions=regions,
        objects=objects,
        seconds={"t_cd_s": 0.25},
        figures={"v_oe_m3": np.array([0.3, np.nan])},
        keyframe_scans=(np.array([0, 4, 8]), np.array([0, 5])),
        config={"method": "descriptor"},
        checkpoints={"3deg": "ab", "sphere": "cd"},
        extras={"kiss-matcher": "1.0.1"},
    )


def test_regions_that_are_always_looked_at_survive_the_disk(tmp_path: Path) -> None:
    plain = _report()
    for is_forced in (None, np.array([False, True])):
        report = replace(plain, regions=replace(plain.regions, is_forced=is_forced))
        write_answer(tmp_path / "a", "ours", report)
        answer = read_answer(tmp_path / "a")
        assert answer.report is not None
        np.testing.assert_array_equal(answer.report.regions.is_forced, is_forced)
        table = report.to_pandas("regions")
        assert ("is_forced" in table) == (is_forced is not None)
        with np.load(tmp_path / "a" / "answer.npz") as arrays:
            assert ("region_is_forced" in arrays) == (is_forced is not None)


def test_an_answer_survives_the_disk(tmp_path: Path) -> None:
    write_answer(tmp_path / "a", "paper", _report())
    answer = read_answer(tmp_path / "a")
    assert (answer.status, answer.method, answer.seconds) == ("ok", "paper", {"t_cd_s": 0.25})
    assert answer.report is not None
    assert answer.checkpoints == answer.report.checkpoints == {"3deg": "ab", "sphere": "cd"}
    assert answer.extras == answer.report.extras == {"kiss-matcher": "1.0.1"}
    assert [len(item.returns) for item in answer.report.objects] == [3, 0, 2]
    np.testing.assert_array_equal(answer.report.objects[2].points_map, np.full((2, 3), 2.0))
    np.testing.assert_array_equal(answer.report.regions.keyframe_scores, [0.9, np.nan, 0.1])
    np.testing.assert_array_equal(answer.report.figures["v_oe_m3"], [0.3, np.nan])


def test_a_radius_of_each_region_survives_the_disk_and_one_of_all_is_a_number_as_ever(tmp_path: Path) -> None:
    report = _report()
    own = replace(report, regions=replace(report.regions, radius_m=np.array([10.0, 4.5])))
    none = replace(report, regions=_select_none(own.regions), figures={}, objects=())
    for written in (own, none):
        write_answer(tmp_path, "mine", written)
        assert "radius_m" not in json.loads((tmp_path / "answer.json").read_text())
        read = read_answer(tmp_path).report
        assert read is not None
        np.testing.assert_array_equal(read.regions.radius_m, written.regions.radius_m)
    write_answer(tmp_path, "mine", report)
    assert json.loads((tmp_path / "answer.json").read_text())["radius_m"] == 4.5
    with np.load(tmp_path / "answer.npz") as arrays:
        assert "region_radii_m" not in arrays
    read = read_answer(tmp_path).report
    assert read is not None
    assert read.regions.radius_m == 4.5
    assert read.regions.radii_m.tolist() == [4.5, 4.5]


@pytest.mark.parametrize("extras", [{"a;b": "1"}, {"a b": "1"}, {"": "1"}, {"a": "1;a 2"}])
def test_a_package_that_tables_would_read_as_two_is_refused(tmp_path: Path, extras: dict[str, str]) -> None:
    write_answer(tmp_path, "mine", replace(_report(), extras=extras))
    with pytest.raises(InputError, match=r"answer\.json: extras\."):
        read_answer(tmp_path)


def _surface() -> SurfaceField:
    return SurfaceField(
        points_map=np.arange(9.0).reshape(3, 3),
        normals_map=np.tile([0.0, 0.0, 1.0], (3, 1)),
        displacement_m=np.array([0.02, np.nan, -0.001]),
        level_m=np.array([0.004, np.nan, 0.006]),
        region=np.array([0, -1, -1], dtype=np.int32),
        regions=(SurfaceRegion(np.array([0.0, 1, 2]), 0.25, 0.005, 0.02, 0.021),),
    )


def test_the_displacement_of_the_rock_survives_the_disk(tmp_path: Path) -> None:
    surface = _surface()
    write_answer(tmp_path, "mine", replace(_report(), surface=surface))
    read = read_answer(tmp_path).report
    assert read is not None
    assert read.surface is not None
    for name in ("points_map", "normals_map", "displacement_m", "level_m", "region"):
        np.testing.assert_array_equal(getattr(read.surface, name), getattr(surface, name))
    (region,) = read.surface.regions
    np.testing.assert_array_equal(region.centre_map, [0.0, 1, 2])
    assert (region.area_m2, region.volume_m3, region.mean_m, region.largest_m) == (0.25, 0.005, 0.02, 0.021)
    write_answer(tmp_path, "mine", _report())
    read = read_answer(tmp_path).report
    assert read is not None
    assert read.surface is None
    assert "surface_regions" not in json.loads((tmp_path / "answer.json").read_text())


def test_a_displacement_without_its_points_or_with_a_region_too_many_is_refused(tmp_path: Path) -> None:
    write_answer(tmp_path, "mine", replace(_report(), surface=_surface()))
    with np.load(tmp_path / "answer.npz") as stored:
        arrays = dict(stored)
    np.savez(tmp_path / "answer.npz", **{**arrays, "surface_region": np.array([1, -1, -1])})
    with pytest.raises(InputError, match=r"region must be -1 or the index of one of 1 regions"):
        read_answer(tmp_path)
    del arrays["surface_level_m"]
    np.savez(tmp_path / "answer.npz", **arrays)
    with pytest.raises(InputError, match=r"array surface_level_m is missing: expected \(Q,\)"):
        read_answer(tmp_path)


def _select_none(regions: ChangeRegions) -> ChangeRegions:
    empty = np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 2), np.int64), np.zeros(0, np.bool_)
    return ChangeRegions(*empty, regions.keyframe_scores)


def test_an_answer_has_either_one_radius_or_that_of_each_region(tmp_path: Path) -> None:
    report = _report()
    write_answer(tmp_path, "mine", replace(report, regions=replace(report.regions, radius_m=np.array([10.0, 4.5]))))
    document = json.loads((tmp_path / "answer.json").read_text())
    (tmp_path / "answer.json").write_text(json.dumps({**document, "radius_m": 4.5}))
    with pytest.raises(InputError, match=r"answer\.json: radius_m: .*or array region_radii_m"):
        read_answer(tmp_path)
    write_answer(tmp_path, "mine", report)
    (tmp_path / "answer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"answer\.json: radius_m: .*or array region_radii_m"):
        read_answer(tmp_path)
    with pytest.raises(ValueError, match=r"radius_m must be \(2\)"):
        replace(report.regions, radius_m=np.array([4.5]))


def test_a_local_merge_survives_the_disk_and_need_not_be_there(tmp_path: Path) -> None:
    local = np.stack([yaw_pose(0.1 * index, (index, 2.0, 3.0)) for index in range(2)])
    write_answer(tmp_path, "paper", replace(_report(), local_before_T_after=local))
    read = read_answer(tmp_path).report
    assert read is not None
    np.testing.assert_array_equal(read.local_before_T_after, local)
    # and none is left of it by an answer that has none
    write_answer(tmp_path, "paper", _report())
    read = read_answer(tmp_path).report
    assert read is not None
    assert read.local_before_T_after is None


def test_shapes_moves_and_withdrawn_regions_survive_the_disk_and_need_not_be_there(tmp_path: Path) -> None:
    report = _report()
    shape = ObjectShape(yaw_pose(0.3, (1.0, 2.0, 3.0)), np.array([1.5, 0.7, 0.4]), 0.25)
    went = np.array([3.0, -4.0, 0.1])
    first, second, third = report.objects
    objects = (
        replace(first, kind="moved", partner=2, shape=shape, displacement_map=went),
        second,
        replace(third, session="before", kind="moved", partner=0, displacement_map=went),
    )
    direction = np.array([1, 0], np.uint8)
    proposed = report.regions.centres_map + np.array([1.0, 0.0, 0.0])
    regions = replace(
        report.regions, is_withdrawn=np.array([False, True]), direction=direction, proposed_centres_map=proposed
    )
    write_answer(tmp_path, "paper", replace(report, objects=objects, regions=regions))
    read = read_answer(tmp_path).report
    assert read is not None
    stored = read.objects[0].shape
    assert stored is not None
    np.testing.assert_array_equal(stored.map_T_box, shape.map_T_box)
    np.testing.assert_array_equal(stored.box_m, shape.box_m)
    assert stored.volume_m3 == 0.25
    assert [item.shape is None for item in read.objects] == [False, True, True]
    for item in (read.objects[0], read.objects[2]):
        np.testing.assert_array_equal(item.displacement_map, went)
    assert read.objects[1].displacement_map is None
    np.testing.assert_array_equal(read.regions.is_withdrawn, [False, True])
    np.testing.assert_array_equal(read.regions.direction, direction)
    np.testing.assert_array_equal(read.regions.proposed_centres_map, proposed)
    np.testing.assert_array_equal(read.regions.is_proposed, [True, True])
    # an answer without them, as others write it, is as good
    write_answer(tmp_path, "paper", report)
    assert "shape" not in (tmp_path / "answer.json").read_text()
    read = read_answer(tmp_path).report
    assert read is not None
    first = read.objects[0]
    assert all(value is None for value in (first.shape, first.displacement_map, read.regions.is_withdrawn))
    assert read.regions.direction is None
    assert read.regions.proposed_centres_map is None


@pytest.mark.parametrize(
    ("proposed", "words"),
    [
        (np.zeros((1, 3)), r"proposed_centres_map"),
        (np.zeros((2, 2)), r"region_proposed_centres_map must be \(R, 3\)"),
        (np.full((2, 3), "x"), r"region_proposed_centres_map: expected numbers"),
    ],
)
def test_damaged_proposed_centres_are_named(proposed: np.ndarray, words: str, tmp_path: Path) -> None:
    write_answer(tmp_path, "paper", _report())
    with np.load(tmp_path / "answer.npz") as stored:
        arrays = dict(stored)
    np.savez_compressed(tmp_path / "answer.npz", region_proposed_centres_map=proposed, **arrays)
    with pytest.raises(InputError, match=rf"answer\.npz: .*{words}"):
        read_answer(tmp_path)


@pytest.mark.parametrize("direction", [np.array([0, 2], np.uint8), np.array([0, 1]), np.array([0], np.uint8)])
def test_a_direction_that_is_none_is_refused(direction: object) -> None:
    with pytest.raises(ValueError, match="direction"):
        replace(_report().regions, direction=direction)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("shape", {"map_T_box": np.eye(3).tolist(), "box_m": [1, 1, 1], "volume_m3": 1}, "map_T_box"),
        ("shape", {"map_T_box": np.eye(4).tolist(), "box_m": [1, 1], "volume_m3": 1}, "box_m"),
        ("shape", {"map_T_box": np.eye(4).tolist(), "box_m": [1, 1, 1]}, "volume_m3"),
        ("displacement_map", [1.0, 2.0], "displacement_map"),
    ],
)
def test_a_damaged_shape_is_named(name: str, value: object, words: str, tmp_path: Path) -> None:
    write_answer(tmp_path, "other", _report())
    document = json.loads((tmp_path / "answer.json").read_text())
    document["objects"][1][name] = value
    (tmp_path / "answer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=f"answer.json: objects.1.*{words}"):
        read_answer(tmp_path)


def test_an_answer_says_where_it_ends(tmp_path: Path) -> None:
    write_answer(tmp_path, "paper", _report())
    assert "until" not in json.loads((tmp_path / "answer.json").read_text())
    assert read_answer(tmp_path).until is None
    write_answer(tmp_path, "paper", _report(), "merge")
    assert read_answer(tmp_path).until == "merge"
    write_failure(tmp_path, "paper", "failed", "", {}, {}, "merge")
    assert read_answer(tmp_path).until == "merge"
    text = (tmp_path / "answer.json").read_text()
    (tmp_path / "answer.json").write_text(text.replace('"until": "merge"', '"until": "query"'))
    with pytest.raises(InputError, match="until = 'query': "):
        read_answer(tmp_path)


def test_a_failure_replaces_an_older_answer(tmp_path: Path) -> None:
    write_answer(tmp_path, "paper", _report())
    write_failure(tmp_path, "paper", "merge_refused", "no overlap", {"inlier_share": 0.2}, {})
    answer = read_answer(tmp_path)
    assert (answer.status, answer.error, answer.report) == ("merge_refused", "no overlap", None)
    assert not (tmp_path / "answer.npz").exists()


def test_of_a_long_error_the_beginning_is_kept(tmp_path: Path) -> None:
    write_failure(tmp_path, "paper", "failed", "e" * 50_000, {}, {})
    assert read_answer(tmp_path).error == "e" * 10_000


@pytest.mark.parametrize("dtype", [np.float16, np.longdouble])
def test_numbers_of_any_width_are_read(tmp_path: Path, dtype: type) -> None:
    local = np.stack([yaw_pose(0.5 * index, (index, 2.0, 3.0)) for index in range(2)])
    write_answer(tmp_path, "paper", replace(_report(), local_before_T_after=local))
    arrays = dict(np.load(tmp_path / "answer.npz"))
    np.savez(tmp_path / "answer.npz", **{**arrays, "local_before_T_after": local.astype(dtype)})
    read = read_answer(tmp_path).report
    assert read is not None and read.local_before_T_after is not None
    np.testing.assert_allclose(read.local_before_T_after, local, atol=1e-3)


def test_a_foreign_answer_may_name_points(tmp_path: Path) -> None:
    write_answer(tmp_path, "other", _report())
    arrays = dict(np.load(tmp_path / "answer.npz"))
    del arrays["object_returns"], arrays["object_return_offsets"]
    arrays["object_points_odom"] = np.ones((4, 3))
    arrays["object_point_odom_offsets"] = np.array([0, 1, 1, 4])
    np.savez(tmp_path / "answer.npz", **arrays)
    answer = read_answer(tmp_path)
    assert answer.points_odom is not None
    assert [len(points) for points in answer.points_odom] == [1, 0, 3]


def test_damage_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"answer\.json: missing"):
        read_answer(tmp_path)
    write_answer(tmp_path, "paper", _report())
    document = json.loads((tmp_path / "answer.json").read_text())
    document["objects"].pop()
    (tmp_path / "answer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="object_return_offsets has 4 entries"):
        read_answer(tmp_path)


def test_of_many_unknown_arrays_the_first_are_named(tmp_path: Path) -> None:
    write_answer(tmp_path, "paper", _report())
    np.savez(tmp_path / "answer.npz", **{f"unknown_{number}": np.zeros(1) for number in range(300)})
    with pytest.raises(InputError, match="array unknown_0 is unknown") as caught:
        read_answer(tmp_path)
    assert len(str(caught.value).split("\n")) < 110


def _with_surface() -> ChangeReport:
    field = SurfaceField(
        np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1)), np.array([0.1, np.nan]), np.array([0.02, np.nan]),
        np.array([-1, -1], dtype=np.int32), (), np.array([0.5, 0.7]), np.array([0.0, 90.0]),
    )  # fmt: skip
    return replace(_report(), surface=field)


def test_a_saved_answer_leaves_nothing_of_an_older_one(tmp_path: Path) -> None:
    save_report(_with_surface(), tmp_path)
    assert (tmp_path / "surface.csv").is_file() and (tmp_path / "surface.ply").is_file()
    (tmp_path / "notes.txt").touch()
    save_report(_report(), tmp_path)
    names = {"answer.json", "answer.npz", "regions.csv", "objects.csv", "objects.ply", "notes.txt"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_a_text_beside_surface_csv_explains_every_column(tmp_path: Path) -> None:
    save_report(_with_surface(), tmp_path)
    columns = [*pd.read_csv(tmp_path / "surface.csv")]
    heads = [line.partition(":")[0] for line in (tmp_path / "surface.columns.txt").read_text().splitlines()[2:]]
    assert ", ".join(heads).split(", ") == columns
    guide = (Path(report_files.__file__).parents[1] / "surface" / "SURFACE.md").read_text()
    assert all(f"| `{head.replace(', ', '`, `')}` |" in guide for head in heads)


@pytest.mark.parametrize("broken", ["savez_compressed", "to_csv", "write_ply_points", "dumps"])
def test_a_folder_holds_a_whole_answer_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    save_report(_with_surface(), tmp_path)

    def fill_the_disk(path: object, *_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    owner = {"savez_compressed": np, "to_csv": pd.DataFrame, "write_ply_points": report_files, "dumps": json}[broken]
    with monkeypatch.context() as patched:
        patched.setattr(owner, broken, fill_the_disk)
        with pytest.raises(InputError, match="cannot be written: No space left"):
            save_report(_report(), tmp_path)
    assert not (tmp_path / "answer.json").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".partial")]
    with pytest.raises(InputError, match=r"answer\.json: missing"):
        read_answer(tmp_path)


def test_a_failure_beside_which_an_answer_stays_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_answer(tmp_path, "paper", _report())

    def fill_the_disk(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(json, "dumps", fill_the_disk)
    with pytest.raises(OSError, match="No space"):
        write_failure(tmp_path, "paper", "failed", "", {}, {})
    assert list(tmp_path.iterdir()) == []


def _with_scans(folder: Path, scans: object) -> None:
    write_answer(folder, "other", _report())
    arrays = dict(np.load(folder / "answer.npz"))
    np.savez(folder / "answer.npz", **{**arrays, "after_keyframe_scans": np.asarray(scans)})


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16, np.uint8])
def test_scans_of_keyframes_may_be_whole_numbers_of_any_type(tmp_path: Path, dtype: type) -> None:
    _with_scans(tmp_path, np.array([0, 5], dtype=dtype))
    read = read_answer(tmp_path).report
    assert read is not None
    local = np.stack([np.eye(4), yaw_pose(0.1, (1.0, 0.0, 0.0))])
    path = make_pose(translation=np.arange(18.0).reshape(6, 3))
    alignment = alignment_of(replace(read, local_before_T_after=local), path)
    np.testing.assert_array_equal(alignment.anchors_odom, [[0.0, 1.0, 2.0], [15.0, 16.0, 17.0]])


@pytest.mark.parametrize("scans", [[0.0, 5.5], [0.0, np.nan], [0.0, np.inf], [0.0, 1e300], [False, True]])
def test_scans_of_keyframes_that_are_no_whole_numbers_are_one_line(tmp_path: Path, scans: list[float]) -> None:
    _with_scans(tmp_path, scans)
    with pytest.raises(InputError, match=r"answer\.npz: array after_keyframe_scans: expected the whole [^\n]*$"):
        read_answer(tmp_path)
