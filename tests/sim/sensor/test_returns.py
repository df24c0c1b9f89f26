"""Two returns of a beam: which they are, and that they live through session, truth, map, answer and OSF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cdpipe
from cdpipe.core.geometry import Float32Array, make_pose
from cdpipe.io.ouster.osf import write_osf
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.readers import open_session
from cdpipe.io.session import fit_chunk, read_session
from cdpipe.sensor.ouster import SensorMetadata
from eval.truth.scoring_points import build_scoring_points
from scenarios import load_scenario
from scenarios.schema import Sensor
from sim.geometry.mesh import Mesh, box_mesh, move_mesh
from sim.geometry.raycast import Caster
from sim.scene import Scene
from sim.sensor.air import AIR, AirVolume
from sim.sensor.footprint import PULSE_M
from sim.sensor.lidar import FALSE_RETURN, MISS, Scan, scan
from sim.sensor.rays import Rays, revolution_rays
from sim.session.simulate import simulate_in_memory, simulate_pair
from sim.session.truth import read_labels

IDEAL = Sensor(range_noise=False, dropouts=False, false_positives=False, sub_rays=7)
MISTY = ["sensor.sub_rays=7", "after.air.mist.visibility_m=20", "sensor.mode=512x10", "platform.scan_spacing_m=1"]


def scene() -> Scene:
    """A dark room with a bright leaning post before the wall at +x, so that either of them may be the stronger."""
    behind = box_mesh((6.0, 6.0, 4.0))
    lean = Rotation.from_euler("x", 20, degrees=True).as_matrix()
    post = move_mesh(box_mesh((0.1, 0.5, 2.0)), make_pose(lean, (3.0, 0.0, 0.0)))
    meshes = (Mesh(behind.vertices, behind.faces[:, ::-1]), post)
    shares: Float32Array = np.array([0.2, 1.0], np.float32)
    return Scene(meshes, Caster(meshes), np.array([0, 1], np.int32), shares, ("wall", "post"), ("rock", "wood"))


def still(sensor: SensorMetadata) -> Rays:
    return revolution_rays(sensor, np.tile(np.eye(4), (sensor.width, 1, 1)))


def seen(sensor: SensorMetadata, returns: str, base: Sensor = IDEAL, air: AirVolume | None = None) -> Scan:
    settings = base.model_copy(update={"returns": returns})
    return scan(scene(), sensor, settings, still(sensor), 1, "after", 0, air=air)


def test_edges_give_two_returns_the_stronger_first(sensor: SensorMetadata) -> None:
    strongest, dual = seen(sensor, "strongest"), seen(sensor, "dual")
    height = sensor.height
    assert strongest.range_mm.shape == (height, sensor.width) and dual.range_mm.shape == (2 * height, sensor.width)
    for name in ("range_mm", "signal", "geom", "owner", "is_mixed", "reflectivity", "true_range_m"):
        np.testing.assert_array_equal(getattr(dual, name)[:height], getattr(strongest, name))
    is_second = dual.range_mm[height:] > 0
    assert 20 < is_second.sum() < 0.01 * is_second.size
    first, second = dual.range_mm[:height][is_second] / 1000.0, dual.range_mm[height:][is_second] / 1000.0
    assert (np.abs(first - second) >= PULSE_M - 2e-3).all()
    assert (dual.signal[:height][is_second] >= dual.signal[height:][is_second]).all()
    # one of both is the post, the other one the wall
    assert (dual.geom[:height][is_second] + dual.geom[height:][is_second] == 1).all()
    assert (dual.geom[height:][~is_second] == MISS).all() and not dual.signal[height:][~is_second].any()


def test_the_last_return_is_the_farther_one(sensor: SensorMetadata) -> None:
    dual, last = seen(sensor, "dual"), seen(sensor, "last")
    first, second = np.split(dual.range_mm, 2)
    np.testing.assert_array_equal(last.range_mm, np.maximum(first, second))
    is_second = second > first
    assert is_second.any()
    np.testing.assert_array_equal(last.geom[is_second], dual.geom[sensor.height :][is_second])
    np.testing.assert_array_equal(last.signal[~is_second], dual.signal[: sensor.height][~is_second])


def test_one_ray_without_air_has_no_second_return(sensor: SensorMetadata) -> None:
    dual = seen(sensor, "dual", IDEAL.model_copy(update={"sub_rays": 1}))
    assert not dual.range_mm[sensor.height :].any()


def test_noise_and_dropouts_of_both_returns_are_drawn_apart_and_false_returns_are_first_ones(
    sensor: SensorMetadata,
) -> None:
    noisy = Sensor(sub_rays=7)
    strongest, dual = seen(sensor, "strongest", noisy), seen(sensor, "dual", noisy)
    first, second = np.split(dual.geom, 2)
    # a second return whose first one was lost takes its place
    is_promoted = first != strongest.geom
    assert (strongest.geom[is_promoted] == MISS).all()
    np.testing.assert_array_equal(dual.range_mm[: sensor.height][~is_promoted], strongest.range_mm[~is_promoted])
    assert (first[second != MISS] != MISS).all()
    assert (first == FALSE_RETURN).any() and not (second == FALSE_RETURN).any()
    clean = seen(sensor, "dual").range_mm[sensor.height :]
    both = (clean > 0) & (second != MISS) & ~is_promoted & (first == seen(sensor, "dual").geom[: sensor.height])
    errors = [
        dual.range_mm[rows][both].astype(np.int64) - seen(sensor, "dual").range_mm[rows][both]
        for rows in (slice(0, sensor.height), slice(sensor.height, None))
    ]
    assert both.sum() > 10 and np.abs(np.corrcoef(*errors)[0, 1]) < 0.9


def test_mist_and_the_wall_behind_it_are_both_reported(sensor: SensorMetadata) -> None:
    mist = AirVolume(np.log(20) / 15.0)
    strongest, dual, last = (seen(sensor, name, air=mist) for name in ("strongest", "dual", "last"))
    first, second = np.split(dual.geom, 2)
    is_air = first == AIR
    assert is_air.mean() > 0.02
    assert (second[is_air] >= 0).mean() > 0.9
    # with one return the groups of a beam are ranked before the air dims them: an edge in a hundred is another
    is_other = (strongest.geom != MISS) & (first != strongest.geom)
    assert is_other.mean() < 0.01
    assert (dual.signal[: sensor.height][is_other] >= strongest.signal[is_other]).all()
    assert (last.geom == AIR).sum() < 0.2 * is_air.sum()
    # what was the stronger one is dimmed more than what is nearer: they are ranked as they arrive
    for visibility_m in (10.0, 15.0, 20.0, 60.0):
        signals = np.split(seen(sensor, "dual", air=AirVolume(np.log(20) / visibility_m)).signal, 2)
        assert (signals[1] <= signals[0]).all()
    # the wall is as dim as without a second return, and the mist before it weaker
    is_wall = (first >= 0) & (second == AIR)
    assert (
        is_wall.any()
        and (dual.range_mm[sensor.height :][is_wall] < dual.range_mm[: sensor.height][is_wall]).mean() > 0.9
    )


@pytest.fixture(scope="module")
def misty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pair = tmp_path_factory.mktemp("dual") / "pair"
    simulate_pair(load_scenario("smoke/one_box", 3, [*MISTY, "sensor.returns=dual"]), 3, pair)
    return pair


def test_a_session_with_two_returns_is_read_scored_and_compared(misty: Path, tmp_path: Path) -> None:
    session = read_session(misty / "after")
    height, width = session.sensor.height, session.sensor.width
    assert (session.n_returns, session.rows) == (2, 2 * height)
    chunk = session.chunk(0)
    (instance, change), *_ = read_labels(misty / "after", session.n_chunks)
    assert instance.shape == change.shape == chunk.range_mm.shape
    assert ((instance != MISS) == (chunk.range_mm > 0)).all()
    posed = open_session(misty / "after").scan(0)
    assert posed.second_from == height * width
    # both returns of a beam lie on one line from the sensor
    second = posed.pixels >= height * width
    rows = {int(pixel): at for at, pixel in enumerate(posed.pixels.tolist())}
    pairs = [(rows[pixel - height * width], at) for pixel, at in rows.items() if pixel >= height * width]
    assert len(pairs) == second.sum() > 100
    one, two = (posed.points_sensor[list(each)] for each in zip(*pairs, strict=True))
    cosines = (one * two).sum(axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
    is_far = np.minimum(np.linalg.norm(one, axis=1), np.linalg.norm(two, axis=1)) > 2.0  # beams start beside the axis
    assert is_far.sum() > 100 and cosines[is_far].min() > 0.9999
    points = build_scoring_points(session)
    assert points.n_pixels == 2 * height * width
    assert (points.returns % points.n_pixels >= height * width).any()
    report = cdpipe.detect(misty / "before", misty / "after")
    assert [each.kind for each in report.objects] == ["added"]


def test_the_same_seed_gives_the_same_bytes_on_disk_and_in_memory(misty: Path) -> None:
    held = simulate_in_memory(load_scenario("smoke/one_box", 3, [*MISTY, "sensor.returns=dual"]), 3)
    session = read_session(misty / "after")
    for number, chunk in enumerate(session.chunks()):
        np.testing.assert_array_equal(chunk.range_mm, held.sessions["after"].session.chunk(number).range_mm)
    assert held.sessions["after"].session.n_returns == 2
    plain = load_scenario("smoke/one_box", 3, MISTY)
    assert "returns" not in plain.model_dump(mode="json")["sensor"]


def test_more_light_comes_through_the_mist(misty: Path, tmp_path: Path) -> None:
    simulate_pair(load_scenario("smoke/one_box", 3, MISTY), 3, tmp_path / "one")
    n_surface = {}
    for name, pair in (("one", tmp_path / "one"), ("two", misty)):
        session = read_session(pair / "after")
        assert ("returns" in (pair / "after" / "session.json").read_text()) == (name == "two")
        n_surface[name] = sum((instance >= 0).sum() for instance, _ in read_labels(pair / "after", session.n_chunks))
    assert n_surface["two"] > 1.01 * n_surface["one"]


def test_an_osf_keeps_both_returns(misty: Path, tmp_path: Path) -> None:
    pytest.importorskip("ouster.sdk")
    session = read_session(misty / "after")
    fields = ({"LABEL": change.astype(np.uint16)} for _, change in read_labels(session.path, session.n_chunks))
    write_osf(session, tmp_path / "out.osf", fields)
    import_recording(tmp_path / "out.osf", tmp_path / "again")
    again = read_session(tmp_path / "again")
    assert again.n_returns == 2
    for one, other in zip(session.chunks(), again.chunks(), strict=True):
        for name in ("range_mm", "signal", "reflectivity"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_chunk_of_many_pixels_holds_fewer_revolutions() -> None:
    assert fit_chunk(32, 1024) == fit_chunk(64, 1024) == fit_chunk(128, 2048) == 64
    assert fit_chunk(256, 2048) == 33
    assert fit_chunk(256, 4096) * (256 * 4096 * 7 + 4096 * 36) < 128 << 20
    assert fit_chunk(10_000, 10_000) == 1
