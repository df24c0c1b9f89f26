import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.descriptors import anchor_frames, describe_map, describe_scans
from cdpipe.descriptors.sphere_network import make_untrained_sphere_network
from cdpipe.descriptors.weights_file import numbered_checkpoint_bytes
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import load_config
from cdpipe.model.types import MappedSession, MergedMaps
from cdpipe.query.query import find_regions
from eval.core.terminal.progress import Silent
from eval.running.stages.pair_stages import kept_bytes
from eval.scoring.region_metrics import label_keyframes
from eval.studies.descriptors import compare as command
from eval.studies.descriptors.compare import tabulate_places, tabulate_spheres
from eval.studies.descriptors.rows import describe_keyframes, measure_pair, measure_scans, measure_spheres, score_places
from eval.truth.adapters import pipeline_input
from eval.truth.ground_truth import SESSIONS, load_ground_truth
from scenarios.library import load_scenario


def mapped_pair(pair: Path) -> list[MappedSession]:
    config, found = load_config("tunnelcd"), []
    for name in SESSIONS:
        source = pipeline_input(pair, name)
        point_map = build_map(source, config.map)
        found.append(MappedSession(point_map, describe_scans(source, point_map.keyframe_scans, config.descriptor)))
    return found


def test_every_descriptor_has_its_row_and_its_price(tiny_pair: Path) -> None:
    rows = measure_pair(tiny_pair)
    # a pose of 7 numbers; q and w of each; 64 numbers of four bytes or of one
    assert [(row["descriptor"], row["precision"], row["bytes_per_keyframe"]) for row in rows] == [
        ("3deg", "float32", 28 + 4 * (64 + 64)),
        ("untrained", "float32", 28 + 4 * (64 + 64)),
        ("scan-context", "float32", 28 + 4 * (20 + 64)),
        ("solid", "float32", 28 + 4 * (40 + 64)),
        ("sphere", "float32", 28 + 4 * 64),
        ("sphere", "int8", 28 + 64),
    ]
    assert all(row["ms_per_keyframe"] > 0 for row in rows)
    before = mapped_pair(tiny_pair)[0].map
    assert rows[4]["map_bytes_per_keyframe"] == 12 * len(before.points) / len(before.keyframe_scans)


def test_a_run_counts_eight_bits_as_eight_bits(tiny_pair: Path) -> None:
    config = load_config("tunnelcd", ["descriptor.precision=int8"])
    mapped = mapped_pair(tiny_pair)[0]
    spheres = describe_map(mapped.map, mapped.map.odom_T_keyframe, config.descriptor)
    kept = kept_bytes(replace(mapped, descriptors=replace(mapped.descriptors, spheres=spheres)), config)
    assert kept["bytes_regions_before"] == (28 + 64 + 4) * len(mapped.map.keyframe_scans)


def test_places_are_those_of_describe_scans(tiny_pair: Path) -> None:
    truth, (before, after) = load_ground_truth(tiny_pair), mapped_pair(tiny_pair)
    poses = [
        session.world_T_sensor[mapped.map.keyframe_scans]
        for session, mapped in ((truth.before, before), (truth.after, after))
    ]
    expected = score_places(before.descriptors, after.descriptors, *poses)
    described = [
        describe_keyframes(pipeline_input(tiny_pair, name), mapped.map, ("3deg",))["3deg"]
        for name, mapped in zip(SESSIONS, (before, after), strict=True)
    ]
    assert [len(seconds) for _, seconds in described] == [len(before.map.keyframe_scans), len(after.map.keyframe_scans)]
    row = measure_scans("3deg", *described, truth)
    assert {name: row[name] for name in expected} == pytest.approx(
        expected, abs=1e-4
    )  # one scan at a time rounds otherwise
    assert expected["n_places"] > 0


def test_the_auroc_of_spheres_against_every_pair_of_keyframes(tiny_pair: Path, tiny_merge: np.ndarray) -> None:
    truth, (before, after) = load_ground_truth(tiny_pair), mapped_pair(tiny_pair)
    truth = replace(truth, pair=replace(truth.pair, score_radius_m=1.6))
    merged = MergedMaps(before.map, after.map, tiny_merge, {}, is_accepted=True)
    config = load_config("tunnelcd", ["query.radius_m=1.6"])
    rows = measure_spheres(merged, before.descriptors, after.descriptors, truth, config)
    places = truth.before.world_T_sensor[before.map.keyframe_scans, :3, 3]
    labels = label_keyframes(places, truth.centroids_world, truth.is_observable, 1.6)
    assert (labels == 1).any()
    assert (labels == 0).any()
    for row in rows:
        kept = config.descriptor.model_copy(update={"precision": row["precision"]})
        anchors = anchor_frames(before.map, before.map.keyframe_scans, config.sphere)
        spheres = replace(before.descriptors, spheres=describe_map(before.map, anchors, kept))
        scores = np.nan_to_num(find_regions(merged, spheres, after.descriptors, config).keyframe_scores, nan=-np.inf)
        against = scores[labels == 1][:, None] - scores[labels == 0][None]
        assert row["region_auroc"] == pytest.approx(np.mean(np.where(against == 0, 0.5, against > 0)))
        assert (row["n_positive"], row["n_negative"]) == ((labels == 1).sum(), (labels == 0).sum())
    refused = measure_spheres(replace(merged, is_accepted=False), before.descriptors, after.descriptors, truth, config)
    assert [row["status"] for row in refused] == ["merge_refused"] * 2
    assert np.isnan([row["region_auroc"] for row in refused]).all()


def scan_rows(family: str, recalls: list[float], yaws_deg: list[float]) -> list[dict[str, object]]:
    return [
        {"family": family, "seed": seed, "descriptor": "solid", "precision": "float32", "status": "ok",
         "bytes_per_keyframe": 444, "ms_per_keyframe": 1.0 + seed, "place_recall_at_1": recall, "yaw_error_deg": yaw,
         "yaw_flip_share": 0.5, "n_places": 10.0}
        for seed, (recall, yaw) in enumerate(zip(recalls, yaws_deg, strict=True))
    ]  # fmt: skip


def sphere_row(family: str, seed: int, precision: str, auroc: float, kept: int) -> dict[str, object]:
    return {"family": family, "seed": seed, "descriptor": "sphere", "precision": precision,
            "status": "merge_refused" if np.isnan(auroc) else "ok", "bytes_per_keyframe": kept, "ms_per_keyframe": 2.0,
            "map_bytes_per_keyframe": 920.0 * (1 + seed), "region_auroc": auroc}  # fmt: skip


def test_places_by_hand() -> None:
    rows = pd.DataFrame(
        [
            *scan_rows("narrow", [0.5, 1.0], [2.0, 4.0]),
            *scan_rows("wide", [0.9], [np.nan]),
            *scan_rows("cave", [0.1], [9]),
        ]
    )
    table = tabulate_places(rows).set_index("group")
    # each pair counts once; cave is out of distribution, alone, and no group
    assert table.index.tolist() == ["narrow", "wide", "cave", "all in distribution"]
    every = table.loc["all in distribution"]
    assert every["place_recall_at_1"] == pytest.approx(0.8)
    assert every["place_recall_at_1_low"] < 0.8 < every["place_recall_at_1_high"]
    assert (every["yaw_error_deg"], every["n_pairs"], every["n_places"]) == (3.0, 3, 30)
    assert (every["bytes_per_keyframe"], every["ms_per_keyframe"]) == (444, 1.0)
    assert np.isnan(table.loc["wide", ["yaw_error_deg", "place_recall_at_1_low"]].astype(float)).all()


def test_spheres_by_hand() -> None:
    rows = [sphere_row("wide", 0, "float32", 0.9, 284), sphere_row("wide", 0, "int8", 0.8, 92)]
    rows += [sphere_row("wide", 1, "float32", 0.7, 284), sphere_row("wide", 1, "int8", 0.72, 92)]
    rows += [sphere_row("wide", 2, "float32", np.nan, 284), sphere_row("wide", 2, "int8", np.nan, 92)]
    table = tabulate_spheres(pd.DataFrame(rows)).set_index("precision")
    assert table["region_auroc"].tolist() == pytest.approx([0.8, 0.76])
    # losses 0.1 and -0.02
    assert table["auroc_loss"].tolist() == pytest.approx([0.0, 0.04])
    assert table["auroc_loss_most"].tolist() == pytest.approx([0.0, 0.1])
    assert table[["n_pairs", "n_used", "n_refused"]].to_numpy().tolist() == [[3, 2, 1], [3, 2, 1]]
    # 920, 1840 and 2760 bytes of map a keyframe
    assert table["map_over_kept"].tolist() == pytest.approx([1840 / 284, 20.0])
    assert table["map_over_kept_least"].tolist() == pytest.approx([920 / 284, 10.0])


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Measure without simulating, and say which pairs were."""
    made: list[str] = []

    def simulated(scenario: object, seed: int, pair: Path, on_progress: object) -> None:
        pair.mkdir()
        made.append(pair.name)

    monkeypatch.setattr(command, "simulate_pair", simulated)
    monkeypatch.setattr(command, "measure_pair", lambda pair, _: [{"descriptor": "solid", "of": pair.name}])
    return made


def test_what_was_measured_is_kept_and_what_was_simulated_is_not(tmp_path: Path, fast: list[str]) -> None:
    rows = command.measure(["smoke/one_box"], [3, 4], tmp_path, Silent())
    assert rows[["family", "seed", "of"]].to_numpy().tolist() == [
        ["smoke/one_box", 3, "smoke__one_box-3"],
        ["smoke/one_box", 4, "smoke__one_box-4"],
    ]
    assert not list((tmp_path / "pairs").iterdir())
    again = command.measure(["smoke/one_box"], [3, 4], tmp_path, Silent())
    pd.testing.assert_frame_equal(again, rows)
    assert fast == ["smoke__one_box-3", "smoke__one_box-4"]
    # damaged, or of something else: made again
    path = tmp_path / "rows" / "smoke__one_box-3.json"
    for content in ("{", json.dumps({**json.loads(path.read_text()), "key": "another"})):
        path.write_text(content)
        pd.testing.assert_frame_equal(command.measure(["smoke/one_box"], [3, 4], tmp_path, Silent()), rows)
    assert fast[2:] == ["smoke__one_box-3"] * 2
    command.measure(["smoke/one_box"], [5], tmp_path, Silent(), keep=True)
    assert [path.name for path in (tmp_path / "pairs").iterdir()] == ["smoke__one_box-5"]
    # with other weights every pair is measured again
    (tmp_path / "mine").write_bytes(numbered_checkpoint_bytes(make_untrained_sphere_network()))
    command.measure(["smoke/one_box"], [3], tmp_path, Silent(), [f"sphere.weights={tmp_path / 'mine'}"])
    assert fast[-1] == "smoke__one_box-3"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["smoke/one_bax", "--out", "OUT"], 'scenario "smoke/one_bax": unknown; did you mean "smoke/one_box"'),
        (["smoke/one_box", "--seeds", "4:3", "--out", "OUT"], "--seeds 4:3: "),
        (
            ["smoke/one_box", "--seeds", "4", "--out", "OUT", "--set", "regions.source=scan"],
            "--set: regions.source = scan: expected sphere",
        ),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    command_line = [
        sys.executable,
        "-m",
        "eval.studies.descriptors.compare",
        *(each.replace("OUT", str(tmp_path)) for each in arguments),
    ]
    root = Path(command.__file__).parents[1]
    done = subprocess.run(
        command_line, cwd=root, env=os.environ, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("setting", "is_other"),
    [("sphere.frames=sensor", True), ("query.radius_m=4.5", True), ("query.threshold=1", False)],
)
def test_rows_are_of_the_settings_that_scores_depend_on(setting: str, is_other: bool) -> None:
    scenario = load_scenario("smoke/one_box", 10000)
    assert (command._key(scenario, 10000, [setting]) != command._key(scenario, 10000, [])) == is_other
