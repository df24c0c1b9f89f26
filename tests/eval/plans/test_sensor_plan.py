"""Plan `sensor` holds one world under many sensors: the same tunnel, changes, drive and noise in each row of a seed."""

import hashlib
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic.fields import FieldInfo

from cdpipe.model.config import load_config
from cdpipe.sensor.ouster import load_profile, profile_names
from eval.core.statistics import ENOUGH_PAIRS
from eval.plans.files import read_plan
from eval.plans.worlds import World, find_references, list_settings_over
from scenarios.library import load_scenario
from scenarios.schema import Sensor
from sim.session.simulate import simulate_pair
from sim.session.truth import PairTruth, read_labels, read_pair_truth, read_true_poses
from tests.eval.plans.shipped import cells_of, plan_of

# as the file has them: only a test should wait for the plan to be checked
WRITTEN = [[each] if isinstance(each, str) else each for each in read_plan("sensor").value["scenarios"][0]["each"]]
OVER = sorted(",".join(each) for each in WRITTEN)
SMALL = ("sensor.mode=512x10", "sensor.sub_rays=7", "platform.scan_spacing_m=2.0", "after.end_m=9")


@cache
def first_and_others() -> tuple[World, list[World]]:
    """Return the first world of the plan, and those that are held against it."""
    first, *others = [world for world in plan_of("sensor").worlds if world.name == "narrow"]
    return first, others


@cache
def plain_sensor() -> Sensor:
    first, _ = first_and_others()
    return load_scenario(first.name, 0, first.settings).sensor


def settings_over(family: str) -> set[str]:
    """Return what the worlds of a family have set otherwise than its first."""
    first, *others = [world for world in plan_of("sensor").worlds if world.name == family]
    held = find_references((world.label, "v", 0) for world in (first, *others))
    assert held == {(world.label, "v"): first.label for world in others}
    return {list_settings_over(world.label, first.label) for world in others}


def values(name: str, field: FieldInfo) -> list[str]:
    """The values of a switch or of a choice, as settings write them, without that of the plan's first world."""
    options = ("true", "false") if field.annotation is bool else map(str, field.annotation.__args__)  # type: ignore[union-attr]
    return [value for value in options if value != str(getattr(plain_sensor(), name)).lower()]


def test_the_settings_of_the_file_are_the_worlds_of_the_plan() -> None:
    first, others = first_and_others()
    assert sorted(list_settings_over(world.label, first.label) for world in others) == OVER


def test_every_effect_of_the_sensor_has_a_row_of_its_own() -> None:
    plain = plain_sensor()
    # reflectors and glass need things that narrow lacks
    assert not {plain.retroreflectors, plain.glass} - {False}
    elsewhere = {"retroreflectors", "glass"}
    glaring = load_scenario("glare/wide", 0).sensor
    assert glaring.retroreflectors and glaring.glass
    assert {f"sensor.{name}=false" for name in elsewhere} == settings_over("glare/wide")
    # in clear air the second return changes nothing
    assert settings_over("dust/narrow") == settings_over("dust/mist") == {"sensor.returns=dual"}
    switches = [
        name for name, field in Sensor.model_fields.items() if field.annotation is bool and name not in elsewhere
    ]
    assert {"rolling_scan", "range_noise", "dropouts", "false_positives"} <= set(switches)
    for name in (*switches, "sub_rays", "returns", "range_step_mm"):
        for value in values(name, Sensor.model_fields[name]):
            assert f"sensor.{name}={value}" in OVER
    assert ",".join(f"sensor.{name}=false" for name in switches if getattr(plain, name)) in OVER
    assert {
        f"sensor.profile={name}" for name in profile_names() if name.startswith("os1-32") and name != plain.profile
    } <= {*OVER}
    assert {"sensor.mode=512x10", "sensor.mode=2048x10"} <= {*OVER}


def test_all_rows_are_held_against_the_first_and_differ_from_it_in_the_sensor_only() -> None:
    first, others = first_and_others()
    held = find_references((world.label, "v", 0) for world in (first, *others))
    assert held == {(world.label, "v"): first.label for world in others}
    for seed in plan_of("sensor").seeds[:2]:
        plain = load_scenario(first.name, seed, first.settings)
        drawn = [load_scenario(world.name, seed, world.settings) for world in others]
        assert all(each.model_copy(update={"sensor": plain.sensor}) == plain for each in drawn)
        sensors = [plain.sensor, *(each.sensor for each in drawn)]
        assert all(sensors.count(sensor) == 1 for sensor in sensors)


def test_there_are_pairs_enough_to_set_a_difference_in_bold() -> None:
    assert len(plan_of("sensor").seeds) >= ENOUGH_PAIRS


def test_no_threshold_hides_an_effect() -> None:
    found = cells_of("sensor")
    as_in_tune = {value for grid in plan_of("tune").grid for value in grid.keys["query.n_regions"]}
    assert {cell.scenario for cell in found} == {world.label for world in plan_of("sensor").worlds}
    for cell in found:
        assert {cell.config.query.n_regions} == as_in_tune
        told = 10.0 if cell.scenario.startswith("glare/wide") else 4.5
        assert cell.config.query.radius_m == ("width" if cell.preset == "tunnelcd" else told)
    variants = {cell.config.regions.source: cell.config for cell in found}
    assert set(variants) == {"sphere", "voxel-diff"}
    assert variants["voxel-diff"].extract == load_config("voxel-diff").extract


@dataclass(frozen=True)
class Session:
    """One session of a pair, (S, H, W) each, its poses, and the truth of the pair."""

    range_mm: np.ndarray
    instance: np.ndarray
    poses: np.ndarray
    believed: np.ndarray
    truth: PairTruth


def simulated(folder: Path, *settings: str) -> Session:
    pair = folder / "pair" / str(len(list(folder.glob("pair/*"))))
    pair.parent.mkdir(exist_ok=True)
    simulate_pair(load_scenario("smoke/one_box", 11, [*SMALL, *settings]), 11, pair)
    after = pair / "after"
    chunks: list[Any] = [np.load(path) for path in sorted((after / "chunks").glob("*.npz"))]
    labels = list(read_labels(after, len(chunks)))
    return Session(
        np.concatenate([chunk["range_mm"] for chunk in chunks]),
        np.concatenate([instance for instance, _ in labels]),
        read_true_poses(after),
        np.load(after / "odometry.npz")["odom_T_sensor"],
        read_pair_truth(pair),
    )


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A small pair with every effect as it is by default."""
    return simulated(tmp_path_factory.mktemp("plain"))


@pytest.mark.parametrize("settings", OVER)
def test_the_world_and_the_drive_are_the_same_under_every_sensor(plain: Session, tmp_path: Path, settings: str) -> None:
    found = simulated(tmp_path, *settings.split(","))
    np.testing.assert_array_equal(found.poses, plain.poses)
    np.testing.assert_array_equal(found.believed, plain.believed)

    def stand(truth: PairTruth) -> list[tuple[Any, ...]]:
        return [(each.id, each.name, each.session, each.world_T_object, each.hull_volume_m3) for each in truth.changes]

    assert stand(found.truth) == stand(plain.truth) != []
    assert found.range_mm.shape != plain.range_mm.shape or (found.range_mm != plain.range_mm).any() or "512" in settings


def test_an_effect_takes_no_random_number_from_another(plain: Session, tmp_path: Path) -> None:
    is_real = plain.instance >= 0
    # without false returns every other pixel is as it was
    found = simulated(tmp_path, "sensor.false_positives=false")
    is_false = plain.instance == -2
    assert 0 < is_false.sum() < is_false.size / 100
    np.testing.assert_array_equal(found.range_mm[~is_false], plain.range_mm[~is_false])
    np.testing.assert_array_equal(found.instance[~is_false], plain.instance[~is_false])
    # without dropouts what was there has the same noise, and more is there
    found = simulated(tmp_path, "sensor.dropouts=false")
    np.testing.assert_array_equal(found.range_mm[is_real], plain.range_mm[is_real])
    np.testing.assert_array_equal(found.instance == -2, is_false)
    assert (found.instance >= 0).sum() > is_real.sum()
    # without noise the same pixels return, from the same things, at most a few centimetres away
    found = simulated(tmp_path, "sensor.range_noise=false")
    np.testing.assert_array_equal(found.instance, plain.instance)
    difference = np.abs(found.range_mm[is_real].astype(np.int64) - plain.range_mm[is_real])
    assert 0 < np.median(difference) < 30
    # coarser steps round what was there
    found = simulated(tmp_path, "sensor.range_step_mm=8")
    np.testing.assert_array_equal(found.instance, plain.instance)
    assert (found.range_mm % 8 == 0).all()
    assert np.abs(found.range_mm[is_real].astype(np.int64) - plain.range_mm[is_real]).max() <= 8


def test_a_pair_says_which_files_it_was_made_from(plain: Session, tmp_path: Path) -> None:
    profile = tmp_path / "own.json"
    profile.write_text(json.dumps(load_profile("os1-32-u0").to_json()))
    found = simulated(tmp_path, f"sensor.profile={profile}", "sensor.false_positives=false")
    assert found.truth.files == {str(profile): hashlib.sha256(profile.read_bytes()).hexdigest()}
    assert plain.truth.files == {}
