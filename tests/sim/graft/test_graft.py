"""Grafting into a simulated session taken for a recording, where everything is known."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import Float64Array, make_pose
from cdpipe.io.session import Session, read_session
from sim.geometry.mesh import box_mesh, move_mesh, point_triangle_distance
from sim.geometry.raycast import Caster
from sim.graft import Recorded, graft_in_memory, graft_pair
from sim.graft.casting import Props, graft_revolution
from sim.graft.noise import EDGES_M, RangeNoise, find_bins
from sim.graft.part import Part, RecordedRevolution
from sim.graft.plan import plan_graft
from sim.graft.rebuild import rebuild_props
from sim.graft.surroundings import Surroundings
from sim.placement.contact import standing_surface
from sim.session.truth import SESSIONS, read_chunk_labels, read_pair_truth, read_true_poses
from sim.view.view import view_pair
from tests.sim.graft.conftest import PROPS, SEED, make_graft

BINS = len(EDGES_M) + 1
EXACT = RangeNoise(
    np.zeros((BINS, 100)),
    np.zeros(BINS, np.int64),
    np.zeros(BINS),
    np.zeros(BINS, np.int64),
    np.ones((BINS, 512, 2), np.int64),
    1,
)


def quiet(stage: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def pair(recording: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("grafted")
    graft_pair(make_graft(*PROPS), SEED, Recorded((recording,)), {}, out)
    return out


def channels(session: Session) -> dict[str, np.ndarray]:
    chunks = list(session.chunks())
    return {
        name: np.concatenate([getattr(each, name) for each in chunks]) for name in type(chunks[0]).__dataclass_fields__
    }


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def labels(folder: Path, session: Session) -> tuple[np.ndarray, np.ndarray]:
    found = [read_chunk_labels(folder, index) for index in range(session.n_chunks)]
    instance, change = (np.concatenate(each) for each in zip(*found, strict=True))
    return instance, change


def meet(origins: Float64Array, ways: Float64Array, triangles: Float64Array) -> Float64Array:
    """Distance of rays (N, 3) to the first of triangles (T, 3, 3) by Moeller and Trumbore, infinite for a miss."""
    nearest = np.full(len(origins), np.inf)
    for a, b, c in triangles:
        first, second = b - a, c - a
        across = np.cross(ways, second)
        size = across @ first
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = origins - a
            u = (offset * across).sum(axis=1) / size
            turned = np.cross(offset, first)
            v = (ways * turned).sum(axis=1) / size
            distance = turned @ second / size
        is_hit = (np.abs(size) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-6)
        nearest = np.where(is_hit & (distance < nearest), distance, nearest)
    return nearest


def test_returns_lie_on_the_mesh_shadows_are_complete_and_all_else_keeps_its_bytes(recording: Session) -> None:
    graft = plan_graft(make_graft(*PROPS), SEED, Recorded((recording,)), quiet)
    n_behind = 0
    for part, props in zip(graft.parts, graft.props, strict=True):
        here = [standing_surface(item) for item in graft.standing if part.name in item.sessions]
        triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in here])
        for revolution in part.revolutions(np.array([3])):
            made = graft_revolution(part, revolution, props, EXACT, SEED)
            # every fourth column, and all that meet something
            chosen = np.flatnonzero((np.arange(recording.sensor.width) % 4 == 0) | (made.instance > 0).any(axis=0))
            origins = np.repeat(made.rays.origins[chosen], recording.sensor.height, axis=0)
            ways = made.rays.directions[chosen].reshape(-1, 3).astype(np.float64)
            met_m = meet(origins, ways, triangles).reshape(len(chosen), -1).T
            was, now = revolution.range_mm[:, chosen], made.range_mm[:, chosen]
            is_first = np.isfinite(met_m) & ((was == 0) | (met_m < was / 1000.0 - recording.sensor.beam_origin_m))
            differs = (made.instance[:, chosen] > 0) != is_first  # an edge may be met by one caster alone
            assert differs.sum() <= 2
            is_first &= ~differs
            assert np.abs(now / 1000.0 - recording.sensor.beam_origin_m - met_m)[is_first].max(initial=0) < 6e-4
            untouched = ~is_first & ~differs
            for name in ("range_mm", "reflectivity", "signal"):
                values, recorded = (getattr(each, name)[:, chosen][untouched] for each in (made, revolution))
                np.testing.assert_array_equal(values, recorded)
            assert set(np.unique(made.instance[:, chosen][untouched])) <= {-1, 0}
            n_behind += int((is_first & (was > 0)).sum())
    assert n_behind > 200


def test_a_null_graft_is_the_recording_split(recording: Session, tmp_path: Path) -> None:
    truth = graft_pair(make_graft(), SEED, Recorded((recording,)), {}, tmp_path)
    assert truth.changes == ()
    whole = channels(recording)
    for name, first in zip(SESSIONS, (0, 1), strict=True):
        session = read_session(tmp_path / name)
        for key, values in channels(session).items():
            np.testing.assert_array_equal(values, whole[key][first::2])
        np.testing.assert_array_equal(session.odom_T_sensor, recording.odom_T_sensor[first::2])
        np.testing.assert_array_equal(read_true_poses(tmp_path / name), recording.odom_T_sensor[first::2])
        instance, change = labels(tmp_path / name, session)
        np.testing.assert_array_equal(instance, np.where(whole["range_mm"][first::2] > 0, 0, -1))
        assert not change.any()


def test_the_truth_tells_every_change(pair: Path) -> None:
    truth = read_pair_truth(pair)
    assert [(each.name, each.kind, each.session) for each in truth.changes] == [
        ("box", "added", "after"),
        ("barrel", "removed", "before"),
        ("crate", "moved", "before"),
        ("crate", "moved", "after"),
    ]
    assert [each.instance for each in truth.changes] == [1, 2, 3, 3]
    assert sum(each.is_observable for each in truth.changes) >= 3
    for name in SESSIONS:
        instance, change = labels(pair / name, read_session(pair / name))
        for each in truth.changes:
            assert (change == each.id).sum() == (each.n_returns if each.session == name else 0)
        is_changed = np.isin(instance, [1, 2, 3])
        np.testing.assert_array_equal(change > 0, is_changed)
        assert (instance == 4).any()  # the box that stays
    assert truth.graft is not None
    assert truth.graft["split"] == "alternate"
    assert truth.graft["merge_from"] == "one recording"
    grafted = sum((labels(pair / name, read_session(pair / name))[0] > 0).sum() for name in SESSIONS)
    assert grafted == sum(each["grafted"] for each in truth.graft["returns"])


def test_props_stand_on_the_floor_clear_of_the_path(pair: Path, recording: Session) -> None:
    standing = rebuild_props(read_pair_truth(pair))
    assert len(standing) == 5
    for item in standing:
        vertices = standing_surface(item).vertices
        assert abs(vertices[:, 2].min() + 0.8) < 0.2  # odom starts at the sensor, 0.8 m above a rough floor
        path = recording.odom_T_sensor[:, :2, 3]
        nearest = np.linalg.norm(vertices[:, None, :2] - path, axis=2).min()
        assert nearest > 0.45


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(
    pair: Path, recording: Session, tmp_path: Path
) -> None:
    for name, seed in (("same", SEED), ("other", SEED + 1)):
        (tmp_path / name).mkdir()
        graft_pair(make_graft(*PROPS), seed, Recorded((recording,)), {}, tmp_path / name)
    view_pair(pair)  # writes nothing
    assert digests(pair) == digests(tmp_path / "same")
    assert digests(pair)["truth/changes.json"] != digests(tmp_path / "other")["truth/changes.json"]


def test_in_memory_it_is_the_same(pair: Path, recording: Session) -> None:
    held = graft_in_memory(make_graft(*PROPS), SEED, Recorded((recording,)), {})
    assert asdict(held.truth) == asdict(read_pair_truth(pair))
    for name in SESSIONS:
        session, own = read_session(pair / name), held.sessions[name]
        for key, values in channels(session).items():
            np.testing.assert_array_equal(values, np.concatenate([getattr(own.session.chunk(0), key)]))
        instance, change = labels(pair / name, session)
        np.testing.assert_array_equal(own.instance, instance)
        np.testing.assert_array_equal(own.change, change)


def test_another_prop_changes_only_what_meets_it(pair: Path, recording: Session) -> None:
    more = {"name": "late", "kind": "box", "size_m": (0.4, 0.4, 0.5)}
    held = graft_in_memory(make_graft(*PROPS, more), SEED, Recorded((recording,)), {})
    for name in SESSIONS:
        before, after = channels(read_session(pair / name))["range_mm"], held.sessions[name].session.chunk(0).range_mm
        is_other = held.sessions[name].instance == 5
        differs = before != after
        assert is_other.any()
        lost = differs & ~is_other
        assert (after[lost] == 0).all()  # beams that the new box swallowed


def test_a_view_shows_props_and_returns(pair: Path) -> None:
    view = view_pair(pair)
    assert {surface.name.split("/")[1] for surface in view.surfaces if surface.name.startswith("changes/")} == {
        "added",
        "removed",
        "moved",
    }
    assert len(view.clouds) == 2
    assert not view.bands
    assert view.play is not None
    assert view.play(0.5)[1]


def test_the_distance_to_the_mesh_is_within_the_noise_of_the_recording(pair: Path, recording: Session) -> None:
    truth = read_pair_truth(pair)
    items = {(item.prop.name, session): item for item in rebuild_props(truth) for session in item.sessions}
    noise = plan_graft(make_graft(*PROPS), SEED, Recorded((recording,)), quiet).noises[0]
    item = items["box", "after"]
    mesh = standing_surface(item)
    triangles = mesh.vertices[mesh.faces]
    session = read_session(pair / "after")
    instance, _ = labels(pair / "after", session)
    part = Part("after", session, np.arange(session.n_scans), np.eye(4))
    offs = []
    for revolution in part.revolutions():
        row, column = np.nonzero(instance[revolution.number] == 1)
        poses = part.world_T_sensor[revolution.number] @ revolution.sensor_T_column[column]
        reach = revolution.range_mm[row, column, None] / 1000.0 - session.sensor.beam_origin_m
        local = session.sensor.origins[row, column] + reach * session.sensor.directions[row, column]
        points = np.einsum("nij,nj->ni", poses[:, :3, :3], local) + poses[:, :3, 3]
        each = [point_triangle_distance(np.tile(point, (len(triangles), 1)), triangles).min() for point in points[::7]]
        offs.append(np.array(each))
    off_m = np.concatenate(offs)
    assert len(off_m) > 20
    assert off_m.max() <= np.abs(noise.residual_m[: find_bins(np.array([20.0]))[0]]).max() + 1e-3
    assert off_m.max() > 1e-3  # there is noise


def two_returns(first_mm: int, second_mm: int, part: Part) -> RecordedRevolution:
    """A revolution of a sensor with two returns whose beams all see the same."""
    height, width = part.source.sensor.height, part.source.sensor.width
    range_mm = np.zeros((2 * height, width), np.uint32)
    range_mm[:height], range_mm[height:] = first_mm, second_mm
    poses = np.tile(np.float32([0, 0, 0, 0, 0, 0, 1]), (width, 1))
    return RecordedRevolution(
        0, range_mm, np.uint8(range_mm > 0), np.uint16(range_mm > 0), np.zeros(width, np.int64), poses
    )


@pytest.mark.parametrize(
    ("recorded", "expected"),
    [
        ((9000, 0), ("prop", 0)),
        ((0, 0), (0, 0)),  # a whole column without a return did not arrive
        ((9000, 12000), ("prop", 0)),
        ((1000, 9000), (1000, "prop")),  # through the edge of something nearer
        ((9000, 1000), ("prop", 1000)),
        ((1000, 0), (1000, 0)),
        ((1000, 1500), (1000, 1500)),
    ],
)
def test_two_returns_by_hand(recording: Session, recorded: tuple[int, int], expected: tuple[object, object]) -> None:
    source = replace(recording, odom_T_sensor=make_pose()[None])
    part = Part("after", source, np.array([0]), np.eye(4))
    wall = move_mesh(box_mesh((0.1, 3, 3)), make_pose(translation=(5.1, 0, 0)))  # its face is at x = 5
    made = graft_revolution(
        part, two_returns(*recorded, part), Props(Caster([wall]), np.array([7], np.int32)), EXACT, SEED
    )
    row, column = (
        16,
        int(np.abs(recording.sensor.directions[16, :, 0] - recording.sensor.directions[16, :, 0].max()).argmin()),
    )
    for place, value in zip((row, recording.sensor.height + row), expected, strict=True):
        if value == "prop":
            assert 5000 <= made.range_mm[place, column] < 5100
            assert made.instance[place, column] == 7
        else:
            assert made.range_mm[place, column] == value
            assert made.instance[place, column] == (0 if value else -1)


def test_lost_beams_leave_nothing(recording: Session) -> None:
    graft = plan_graft(make_graft(*PROPS), SEED, Recorded((recording,)), quiet)
    all_lost = replace(EXACT, lost=np.ones(BINS))
    revolution = next(graft.parts[1].revolutions(np.array([3])))
    kept, gone = (
        graft_revolution(graft.parts[1], revolution, graft.props[1], each, SEED) for each in (EXACT, all_lost)
    )
    is_prop = kept.instance > 0
    assert is_prop.any()
    assert (gone.range_mm[is_prop] == 0).all()
    assert (gone.instance[is_prop] == -1).all()
    np.testing.assert_array_equal(gone.range_mm[~is_prop], kept.range_mm[~is_prop])


def test_two_recordings_stand_in_the_frame_of_the_first(recording: Session, tmp_path: Path) -> None:
    before_T_after = make_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), (3.0, -2.0, 0.5))
    other = replace(recording, odom_T_sensor=np.linalg.inv(before_T_after) @ recording.odom_T_sensor)
    scenario = make_graft(PROPS[3], sessions=("one", "two"), split="auto", before_T_after="merge.txt")
    truth = graft_pair(scenario, SEED, Recorded((recording, other), before_T_after, "given"), {}, tmp_path)
    assert truth.graft is not None
    np.testing.assert_allclose(truth.graft["before_T_after"], before_T_after)
    np.testing.assert_allclose(read_true_poses(tmp_path / "after"), recording.odom_T_sensor, atol=1e-12)
    stays = [labels(tmp_path / name, read_session(tmp_path / name))[0] == 1 for name in SESSIONS]
    assert stays[0].sum() > 300
    assert (stays[0] != stays[1]).sum() < 0.05 * stays[0].sum()  # both look from the same places


def test_what_cannot_stand_is_told(recording: Session) -> None:
    huge = {"name": "huge", "kind": "box", "size_m": (2.5, 2.4, 2.0)}
    with pytest.raises(ScenarioError, match=r"prop 'huge' finds no place in 900 tries .*place\.at"):
        plan_graft(make_graft(huge), SEED, Recorded((recording,)), quiet)


def test_a_given_place_is_taken(recording: Session) -> None:
    x_m, y_m = recording.odom_T_sensor[7, :2, 3] + (0.0, 1.0)
    box = {"name": "box", "kind": "box", "size_m": (0.5, 0.4, 0.3), "place": {"at": (x_m, y_m, 0), "yaw_deg": 30}}
    (item,) = plan_graft(make_graft(box), SEED, Recorded((recording,)), quiet).standing
    np.testing.assert_allclose(item.world_T_object[:2, 3], (x_m, y_m), atol=1e-6)
    assert np.rad2deg(np.arctan2(item.world_T_object[1, 0], item.world_T_object[0, 0])) == pytest.approx(30, abs=2)
    with pytest.raises(ScenarioError, match="no even floor"):
        plan_graft(make_graft({**box, "place": {"at": (x_m, y_m + 30, 0)}}), SEED, Recorded((recording,)), quiet)


@pytest.mark.parametrize("key", ["place", "to"])
def test_a_given_place_is_not_taken_by_a_drawn_prop_before_it_in_the_file(recording: Session, key: str) -> None:
    (drawn,) = plan_graft(make_graft(PROPS[3]), SEED, Recorded((recording,)), quiet).standing
    taken = {"at": tuple(drawn.world_T_object[:3, 3])}
    given = {**PROPS[2], "name": "given"} | {key: taken}
    scenario = make_graft(PROPS[3], given)
    standing = plan_graft(scenario, SEED, Recorded((recording,)), quiet).standing
    assert [item.prop.name for item in standing] == ["stays", "given", "given"]
    at = 1 if key == "place" else 2
    np.testing.assert_allclose(standing[at].world_T_object[:2, 3], taken["at"][:2], atol=1e-5)
    assert not np.allclose(standing[0].world_T_object, drawn.world_T_object)
    second = {**PROPS[3], "name": "second", "place": taken}
    with pytest.raises(ScenarioError, match=r"prop '.*' cannot stand at .*: prop '.*' stands there: give one"):
        plan_graft(make_graft(given, second), SEED, Recorded((recording,)), quiet)


def test_a_pair_of_one_revolution_is_refused(recording: Session) -> None:
    alone = replace(recording, odom_T_sensor=recording.odom_T_sensor[:1])
    with pytest.raises(InputError, match="one revolution makes no pair"):
        plan_graft(make_graft(), SEED, Recorded((alone,)), quiet)


def test_a_recording_in_map_coordinates_is_refused(recording: Session) -> None:
    poses = recording.odom_T_sensor.copy()
    poses[:, 0, 3] += 5e6
    far = Part("before", replace(recording, odom_T_sensor=poses), np.arange(4), np.eye(4))
    with pytest.raises(InputError, match="subtract a common offset from the trajectory"):
        Surroundings([far], 10.0)
