"""Training data: a tunnel's shard against what is computed again here, and the run that makes a folder of them."""

import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.geometry import invert, transform, yaw_rad
from cdpipe.core.geometry.path_frames import path_frames
from cdpipe.descriptors.range_image import range_image
from cdpipe.descriptors.sphere_image import COLUMNS, ROWS, pixels, sphere_image
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import load_config
from cdpipe.model.types import DescriptorSet, MappedSession, PointMap
from cdpipe.training.data import open_dataset, read_place_data
from cdpipe.training.shard import FIELDS, encode_shard, read_about, read_shard
from eval.core import cluster
from eval.core.cluster import Where
from eval.core.output import only_writer
from eval.oracles.merge import OracleMerge, merged_by_truth
from eval.scoring.merge_metrics import PAIR_RADIUS_M
from eval.training import dataset_run
from eval.training.dataset import Recipe, displace_poses, draw_merge_errors, make_shard, make_shards
from eval.training.dataset_card import digest_of, fields_table
from eval.training.dataset_run import make_dataset
from eval.truth.adapters import pipeline_input
from eval.truth.ground_truth import GroundTruth, load_ground_truth
from scenarios.library import load_scenario
from scenarios.schema import Scenario
from sim.session.truth import read_labels

FAMILY, SEED = "smoke/one_box", 3
RECIPE = Recipe(draws=2)
Shard = tuple[dict[str, np.ndarray], dict[str, Any], bytes]
FromFiles = tuple[Path, list[PointMap], GroundTruth]


@pytest.fixture(scope="module", name="shard")
def shard_fixture(tmp_path_factory: pytest.TempPathFactory) -> Shard:
    content = make_shard(FAMILY, SEED, RECIPE)
    path = tmp_path_factory.mktemp("shard") / "one.safetensors"
    path.write_bytes(content)
    return *read_shard(path), content


@pytest.fixture(scope="module", name="from_files")
def from_files_fixture(simulated_once: Callable[[Scenario, int], Path]) -> FromFiles:
    """The same pair by way of files, as `simulate` and the pipeline make and read them."""
    pair = simulated_once(load_scenario(FAMILY, SEED), SEED)
    maps = [build_map(pipeline_input(pair, name), load_config("tunnelcd").map) for name in ("before", "after")]
    return pair, maps, load_ground_truth(pair)


def after_in_map(maps: list[PointMap], truth: GroundTruth) -> np.ndarray:
    sessions = [
        MappedSession(each, DescriptorSet(np.zeros((len(each.keyframe_scans), 1)), None, each.keyframe_scans, "", ""))
        for each in maps
    ]
    merged = merged_by_truth(*sessions, (truth.before, truth.after), OracleMerge(), SEED)
    return merged.alignment.to_map(maps[1].points)


def test_a_shard_holds_what_the_table_says(shard: Shard) -> None:
    arrays, about, _ = shard
    sizes = {
        "K": about["counts"]["n_before"],
        "J": about["counts"]["n_after"],
        "C": len(about["changes"]),
        "D": RECIPE.draws,
        "V": ROWS,
        "U": COLUMNS,
        "R": arrays["before_ranges_m"].shape[1],
        "W": arrays["before_ranges_m"].shape[2],
    }
    image = sphere_image(np.zeros((0, 3))).shape
    assert set(arrays) == {field.name for field in FIELDS}
    for field in FIELDS:
        shape = []
        for axis in field.shape.split(","):
            shape += image if axis == "I" else [sizes[axis] if axis in sizes else int(axis)]
        assert arrays[field.name].shape == tuple(shape), field.name
        assert arrays[field.name].dtype == field.dtype, field.name
        if arrays[field.name].dtype.kind == "f":
            assert np.isfinite(arrays[field.name]).all(), field.name


def test_the_documented_table_is_the_one_of_the_code() -> None:
    assert fields_table() in (Path(__file__).parents[3] / "eval" / "training" / "DATASET.md").read_text()


@pytest.fixture(scope="module", name="other_shard")
def other_shard_fixture() -> bytes:
    return make_shard(FAMILY, SEED + 1, RECIPE)


def test_the_same_seed_gives_the_same_bytes_and_another_gives_others(shard: Shard, other_shard: bytes) -> None:
    assert make_shard(FAMILY, SEED, RECIPE) == shard[2] != other_shard


def test_images_are_the_pipeline_s_maps_rendered_directly(shard: Shard, from_files: FromFiles) -> None:
    arrays, (_, maps, truth) = shard[0], from_files
    np.testing.assert_array_equal(arrays["before_odom_T_keyframe"], maps[0].odom_T_keyframe)
    anchors = path_frames(maps[0].odom_T_sensor, maps[0].keyframe_scans)
    clouds = {"before": maps[0].points, "after": after_in_map(maps, truth)}
    for anchor, pose in enumerate(anchors):
        for name, cloud in clouds.items():
            # all points, not those of a crop
            direct = sphere_image(transform(invert(pose), cloud))
            image = arrays["before_images"][anchor] if name == "before" else arrays["after_images"][0, anchor]
            np.testing.assert_allclose(image, direct, atol=1e-5)


def test_a_draw_is_off_by_its_own_error(shard: Shard, from_files: FromFiles) -> None:
    arrays, (_, maps, truth) = shard[0], from_files
    shift, turn = arrays["draw_shift_m"], arrays["draw_turn_rad"]
    assert (shift[0] == 0).all() and (turn[0] == 0).all() and (shift[1] != 0).all() and (turn[1] != 0).all()
    anchors, cloud = path_frames(maps[0].odom_T_sensor, maps[0].keyframe_scans), after_in_map(maps, truth)
    poses = displace_poses(anchors, shift[1], turn[1])
    for anchor in range(0, len(anchors), 5):
        here = anchors[anchor, :3, 3]
        cross = np.array([[0, -turn[1, 2], turn[1, 1]], [turn[1, 2], 0, -turn[1, 0]], [-turn[1, 1], turn[1, 0], 0]])
        near = cloud[np.linalg.norm(cloud - here, axis=1) < 20.0]
        # to first order in a turn of a fifth of a degree: R v = v + w x v
        moved = here + (near - here) + (near - here) @ cross.T + shift[1]
        np.testing.assert_allclose(
            transform(invert(poses[anchor]), near), transform(invert(anchors[anchor]), moved), atol=20 * 2e-4
        )
        error = invert(anchors[anchor]) @ poses[anchor]
        assert Rotation.from_matrix(error[:3, :3]).magnitude() == pytest.approx(np.linalg.norm(turn[1]))
        direct = sphere_image(transform(invert(poses[anchor]), cloud))
        np.testing.assert_allclose(arrays["after_images"][1, anchor], direct, atol=1e-5)


def test_draws_have_the_spread_they_are_asked_for() -> None:
    drawn = draw_merge_errors(Recipe(draws=4001, error_m=0.05, error_deg=0.5), 0)
    assert drawn["shift_m"][1:].std() == pytest.approx(0.05, rel=0.03)
    assert np.rad2deg(drawn["turn_rad"][1:]).std() == pytest.approx(0.5, rel=0.03)
    np.testing.assert_array_equal(drawn["shift_m"][:7], draw_merge_errors(Recipe(draws=7, error_m=0.05), 0)["shift_m"])


def test_pixel_labels_are_where_changed_returns_are(shard: Shard, from_files: FromFiles) -> None:
    arrays, (pair, maps, truth) = shard[0], from_files
    (change,) = truth.pair.changes
    assert change.session == "after"
    assert not arrays["before_labels"].any() and not arrays["before_visible"].any()
    labels = np.concatenate([labels for _, labels in read_labels(pair / "after", 1)])
    changed = set()
    for scan in range(len(labels)):
        for place in range(maps[1].scan_offsets[scan], maps[1].scan_offsets[scan + 1]):
            if labels[scan].flat[maps[1].return_pixels[place]] == change.id:
                changed.add(int(maps[1].return_points[place]))
    cloud = after_in_map(maps, truth)[sorted(changed)]
    assert len(cloud) > 20
    for anchor, pose in enumerate(path_frames(maps[0].odom_T_sensor, maps[0].keyframe_scans)):
        pixel = pixels(transform(invert(pose), cloud))
        wanted = np.zeros(ROWS * COLUMNS, dtype=bool)
        wanted[pixel[pixel >= 0]] = True
        np.testing.assert_array_equal(arrays["after_labels"][0, anchor].ravel(), wanted * change.id)
        assert arrays["after_visible"][0, anchor].tolist() == [wanted.sum()]
    # whoever stands beside it sees it, whoever stands two radii off sees nothing
    seen = arrays["after_visible"][0, :, 0]
    apart = np.linalg.norm(arrays["before_odom_T_keyframe"][:, :3, 3] - arrays["change_centroid_odom"][0], axis=1)
    assert (seen[apart < 2.0] > 10).all() and (seen[apart > 9.0] == 0).all()


def test_places_and_keyframe_labels_by_brute_force(shard: Shard, from_files: FromFiles) -> None:
    arrays, (_, maps, truth) = shard[0], from_files
    before = truth.before.world_T_sensor[maps[0].keyframe_scans]
    after = truth.after.world_T_sensor[maps[1].keyframe_scans]
    for i, here in enumerate(before):
        distances = [float(np.linalg.norm(here[:3, 3] - there[:3, 3])) for there in after]
        j = int(arrays["nearest_after"][i])
        assert distances[j] == min(distances) == pytest.approx(arrays["nearest_m"][i])
        assert arrays["is_covered"][i] == (min(distances) <= PAIR_RADIUS_M)
        turn = arrays["nearest_yaw_rad"][i] - (yaw_rad(after[j]) - yaw_rad(here))
        assert -np.pi < arrays["nearest_yaw_rad"][i] <= np.pi and np.cos(turn) == pytest.approx(1.0)
        to_changes = [float(np.linalg.norm(here[:3, 3] - centroid)) for centroid in truth.centroids_world]
        positive = any(m <= 4.5 and seen for m, seen in zip(to_changes, truth.is_observable, strict=True))
        negative = all(m > 6.75 for m in to_changes)
        assert arrays["labels"][i] == (1 if positive else 0 if negative else -1)
    assert set(arrays["labels"]) == {-1, 0, 1}


def test_scans_and_changes_are_those_of_the_files(shard: Shard, from_files: FromFiles) -> None:
    (arrays, about, _), (pair, maps, truth) = shard, from_files
    for name, point_map, session in zip(("before", "after"), maps, (truth.before, truth.after), strict=True):
        scans = arrays[f"{name}_scans"]
        np.testing.assert_array_equal(scans, point_map.keyframe_scans)
        np.testing.assert_array_equal(arrays[f"{name}_world_T_keyframe"], session.world_T_sensor[scans])
        for row in (0, len(scans) - 1):
            scan = pipeline_input(pair, name).scan(int(scans[row]))
            np.testing.assert_allclose(arrays[f"{name}_ranges_m"][row], range_image(scan.points_sensor), rtol=1e-3)
            assert arrays[f"{name}_stamps_ns"][row] == scan.stamps_ns.min()
    (change,) = truth.pair.changes
    assert about["changes"] == [{"name": "box", "prop_kind": "box"}]
    assert (arrays["change_session"][0], arrays["change_kind"][0]) == (1, 0)
    assert arrays["change_n_cells"][0] == change.n_cells or arrays["change_n_cells"][0] == len(truth.change_rows[0])
    np.testing.assert_allclose(arrays["change_centroid_world"], truth.centroids_world)
    assert arrays["change_is_observable"].tolist() == truth.is_observable.tolist()


@pytest.mark.soak
def test_a_dask_cluster_makes_the_same_bytes(tmp_path: Path, shard: Shard, other_shard: bytes) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    file = tmp_path / "scheduler.json"
    module = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    commands = [
        [*module, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        [module[0], "-m", "distributed.cli.dask_worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard"],
    ]
    processes = []
    try:
        for argv in commands:
            both = [*argv, "--scheduler-file", str(file)]
            processes.append(subprocess.Popen(both, env=environment, stderr=subprocess.DEVNULL))
            while not file.is_file():
                time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        with distributed.Client(address) as client:
            client.wait_for_workers(2, timeout=60)
        outcome = make_dataset([FAMILY], "3:5", RECIPE, tmp_path / "d", Where(scheduler=address))
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(20)
    assert outcome.n_made == 2
    assert (tmp_path / "d" / "smoke__one_box-3.safetensors").read_bytes() == shard[2]
    assert (tmp_path / "d" / "smoke__one_box-4.safetensors").read_bytes() == other_shard


def test_workers_of_this_machine_make_the_same_bytes(tmp_path: Path, shard: Shard) -> None:
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    make_dataset([FAMILY], "3", RECIPE, tmp_path / "d", Where(workers=2))
    assert (tmp_path / "d" / "smoke__one_box-3.safetensors").read_bytes() == shard[2]


def fake_shards(monkeypatch: pytest.MonkeyPatch, shard: Shard, *, refused: int = -1) -> list[int]:
    """Let tunnels come at once, and count them."""
    made = []

    def fake(family: str, seed: int, recipe: Recipe) -> list[bytes]:
        made.append(seed)
        if seed == refused:
            raise ScenarioError("the rock fell in")
        text = dataset_run.shard_digest(load_scenario(family, seed, recipe.settings), seed, recipe)
        return [encode_shard(shard[0], {**shard[1], "seed": seed, "digest": text})] * recipe.afters

    monkeypatch.setattr(dataset_run, "make_shards", fake)
    return made


def test_finished_tunnels_are_kept_and_the_rest_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    made = fake_shards(monkeypatch, shard)
    first = make_dataset([FAMILY], "0:4", RECIPE, tmp_path / "d", limit=1)
    assert (first.n_made, first.n_kept, first.n_left, made) == (1, 0, 3, [0])
    shard_file = tmp_path / "d" / "smoke__one_box-0.safetensors"
    stamp = shard_file.stat().st_mtime_ns
    second = make_dataset([FAMILY], "0:4", RECIPE, tmp_path / "d")
    assert (second.n_made, second.n_kept, made) == (3, 1, [0, 1, 2, 3])
    assert shard_file.stat().st_mtime_ns == stamp
    # one that was cut short is made again
    shard_file.write_bytes(shard_file.read_bytes()[:1000])
    assert make_dataset([FAMILY], "0:4", RECIPE, tmp_path / "d").n_made == 1
    assert made[-1] == 0


def test_a_tunnel_that_cannot_be_built_is_listed_and_not_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    made = fake_shards(monkeypatch, shard, refused=1)
    for _ in range(2):
        outcome = make_dataset([FAMILY], "0:3", RECIPE, tmp_path / "d")
        assert outcome.n_refused == 1
    assert made == [0, 1, 2]
    rows = list(csv.DictReader((tmp_path / "d" / "index.csv").read_text().splitlines()))
    assert [(row["seed"], row["status"], row["reason"]) for row in rows if row["status"] != "ok"] == [
        ("1", "refused", "the rock fell in")
    ]
    assert f"- {FAMILY} 1: the rock fell in" in (tmp_path / "d" / "README.md").read_text()


def test_the_card_counts_what_the_index_lists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard) -> None:
    fake_shards(monkeypatch, shard)
    make_dataset([FAMILY], "0:2", RECIPE, tmp_path / "d", command="tunnelcd dataset one")
    make_dataset([FAMILY], "10000", RECIPE, tmp_path / "d", command="tunnelcd dataset two")
    rows = list(csv.DictReader((tmp_path / "d" / "index.csv").read_text().splitlines()))
    assert [row["split"] for row in rows] == ["train", "train", "validation"]
    for row in rows:
        assert hashlib.sha256((tmp_path / "d" / row["shard"]).read_bytes()).hexdigest() == row["sha256"]
        about = read_about(tmp_path / "d" / row["shard"])
        assert {name: int(row[name]) for name in about["counts"]} == about["counts"]
    text = (tmp_path / "d" / "README.md").read_text()
    n, positive = (2 * shard[1]["counts"][name] for name in ("n_before", "n_positive"))
    assert f"| {FAMILY} | train | 0 to 1 | 2 | {n} | {n} | {positive} |" in text
    assert f"`{digest_of(rows)}`" in text
    assert "tunnelcd dataset one\ntunnelcd dataset two" in text


def test_several_after_sessions_are_shards_of_one_tunnel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    made = fake_shards(monkeypatch, shard)
    recipe = replace(RECIPE, afters=3)
    outcome = make_dataset([FAMILY], "0:2", recipe, tmp_path / "d")
    n_pairs = shard[1]["counts"]["n_before"]
    assert (outcome.n_made, outcome.n_pairs) == (2, 6 * n_pairs)
    rows = list(csv.DictReader((tmp_path / "d" / "index.csv").read_text().splitlines()))
    names = [f"smoke__one_box-0{end}.safetensors" for end in ("", "-after-2", "-after-3")]
    assert [row["shard"] for row in rows[:3]] == names
    text = (tmp_path / "d" / "README.md").read_text()
    assert f"| {FAMILY} | train | 0 to 1 | 2 | {6 * n_pairs} |" in text
    assert f"{2 * n_pairs} of the {6 * n_pairs} pairs are of a first after session" in text
    (tmp_path / "d" / names[2]).unlink()
    assert make_dataset([FAMILY], "0:2", recipe, tmp_path / "d").n_made == 1
    assert made == [0, 1, 0]
    with pytest.raises(InputError, match="--afters 3, not with"):
        make_dataset([FAMILY], "0", RECIPE, tmp_path / "d")
    tunnels = open_dataset(tmp_path / "d", "train")
    assert len(tunnels) == 6
    assert np.unique(read_place_data(tunnels).tunnels).tolist() == [0, 1]


def test_a_recorded_world_has_no_further_after_sessions(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "friday.yaml").write_text("recording: {sessions: [run]}\nprops: []\n")
    with pytest.raises(InputError, match=r"--afters 2: the sessions of .* are recorded: leave it out"):
        make_dataset([str(tmp_path / "friday.yaml")], "0:2", replace(RECIPE, afters=2), tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_second_after_session_has_the_same_before_session_and_changes(tmp_path: Path, shard: Shard) -> None:
    read = []
    for number, content in enumerate(make_shards(FAMILY, SEED, replace(RECIPE, afters=2))):
        (tmp_path / f"{number}.safetensors").write_bytes(content)
        read.append(read_shard(tmp_path / f"{number}.safetensors")[0])
    first, second = read
    shared = ("before_images", "before_ranges_m", "before_world_T_keyframe", "change_kind")
    for name, array in shard[0].items():
        np.testing.assert_array_equal(first[name], array)
    for name in shared:
        np.testing.assert_array_equal(first[name], second[name])
    assert not np.array_equal(first["after_images"][0], second["after_images"][0])
    assert second["change_is_observable"].all()
    assert (second["after_visible"].sum(axis=(0, 1)) > 0).any()


def test_another_recipe_or_somebody_s_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    fake_shards(monkeypatch, shard)
    make_dataset([FAMILY], "0", RECIPE, tmp_path / "d")
    with pytest.raises(InputError, match=r"--draws 2 .*--draws 5 "):
        make_dataset([FAMILY], "1", Recipe(draws=5), tmp_path / "d")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").touch()
    with pytest.raises(InputError, match="not empty and not a dataset"):
        make_dataset([FAMILY], "0", RECIPE, tmp_path / "other")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        (("nowhere", "--seeds", "0:2"), 'error: scenario "nowhere": unknown'),
        ((FAMILY, "--seeds", "5:5"), "error: --seeds 5:5: expected"),
        ((FAMILY, "--seeds", "x"), "error: --seeds x: expected"),
        ((FAMILY, FAMILY, "--seeds", "0"), "one is named twice"),
        ((FAMILY, "--seeds", "0", "--world", "tunel=1"), "tunel"),
        ((FAMILY, "--seeds", "0", "--workers", "2", "--scheduler", "tcp://a:1"), "leave one of the two out"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_folder(command: Callable, tmp_path: Path, argv: tuple, told: str) -> None:
    code, out, err = command("dataset", *argv, "--out", tmp_path / "d")
    assert (code, out) == (2, "")
    assert told in err and err.count("\n") == 1 and err.startswith("error: ")
    assert not (tmp_path / "d").exists()


def test_an_unreachable_scheduler_is_named_and_leaves_no_folder(
    command: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(todo: object, recipe: object, where: object) -> Iterator[object]:
        raise InputError("--scheduler tcp://a:1: cannot be reached")
        yield

    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: object())  # as if the extra were there
    monkeypatch.setattr(dataset_run, "_computed", unreachable)
    with pytest.raises(InputError, match="cannot be reached"):
        make_dataset([FAMILY], "0", RECIPE, tmp_path / "d", Where(scheduler="tcp://a:1"))
    assert not (tmp_path / "d").exists()
    argv = ("dataset", FAMILY, "--seeds", "0", "--scheduler", "tcp://127.0.0.1:9", "--out", tmp_path / "d", "-q")
    code, _, err = command(*argv)
    assert code == 2 and err.startswith("error: --scheduler tcp://127.0.0.1:9: cannot") and err.count("\n") == 1
    assert not (tmp_path / "d").exists()


def test_without_the_extra_one_line_says_what_to_install(
    command: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None)
    code, _, err = command("dataset", FAMILY, "--seeds", "0", "--workers", "2", "--out", tmp_path / "d")
    assert code == 2
    assert err == "error: --workers: Dask is not installed: pip install 'tunnelcd[cluster]'\n"


def test_a_run_that_is_interrupted_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    argv = [
        sys.executable,
        "-c",
        "from eval.cli.main import main; main()",
        "dataset",
        FAMILY,
        "--seeds",
        "3:6",
        "--draws",
        "2",
    ]
    argv += ["--out", str(tmp_path / "d")]
    root = Path(__file__).parents[3]
    # a shell's background jobs ignore Ctrl-C, and so would their children
    heeding = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    process = subprocess.Popen(argv, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **heeding)
    first = tmp_path / "d" / "smoke__one_box-3.safetensors"
    while not first.is_file():
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.endswith("interrupted; finished tunnels are kept, the same command goes on from there\n")
    assert "Traceback" not in err
    n_left = 3 - len(list((tmp_path / "d").glob("*.safetensors")))
    assert first.read_bytes() == shard[2] and n_left >= 1
    fake_shards(monkeypatch, shard)
    assert make_dataset([FAMILY], "3:6", RECIPE, tmp_path / "d").n_made == n_left
    assert not list((tmp_path / "d").glob(".*"))


def test_a_limit_is_of_tunnels_that_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard) -> None:
    made = fake_shards(monkeypatch, shard)
    monkeypatch.setattr(dataset_run, "_tunnel", refuse_even)
    first = make_dataset([FAMILY], "0:6", RECIPE, tmp_path / "d", limit=1)
    assert (first.n_made, first.n_refused, first.n_left, made) == (1, 3, 2, [1])
    assert make_dataset([FAMILY], "0:6", RECIPE, tmp_path / "d", limit=1).n_left == 1
    assert made == [1, 3]


def refuse_even(family: str, seed: int, recipe: Recipe) -> dataset_run.Tunnel:
    if seed % 2 == 0:
        return dataset_run.Tunnel(family, seed, refused="no such sensor")
    return dataset_run.Tunnel(
        family, seed, dataset_run.shard_digest(load_scenario(family, seed, recipe.settings), seed, recipe)
    )


def test_a_second_command_in_the_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: Shard
) -> None:
    fake_shards(monkeypatch, shard)
    (tmp_path / "d").mkdir()
    with (
        only_writer(tmp_path / "d", "tunnelcd dataset"),
        pytest.raises(InputError, match="another `tunnelcd dataset`"),
    ):
        make_dataset([FAMILY], "0:1", RECIPE, tmp_path / "d")
    assert list((tmp_path / "d").iterdir()) == []
    assert make_dataset([FAMILY], "0:1", RECIPE, tmp_path / "d").n_made == 1
