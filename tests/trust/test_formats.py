"""A stored file of every format so far is read, or refused with the command that makes it anew."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import BaseModel
from safetensors.numpy import save as save_arrays
from torch import Tensor, nn

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_tensors
from cdpipe.core.geometry import make_pose
from cdpipe.core.yamlfile import Document, validate
from cdpipe.descriptors.sphere_network import load_sphere_network, make_untrained_sphere_network
from cdpipe.descriptors.weights_file import checkpoint_bytes, numbered_checkpoint_bytes
from cdpipe.io.answer import read_answer
from cdpipe.io.answer_parts import AnswerPart
from cdpipe.io.known_merge import read_alignment, read_known_merge, write_alignment
from cdpipe.io.session import ScanChunk, SessionWriter, chunk_path, read_session
from cdpipe.model.alignment import PathAlignment
from cdpipe.sensor.ouster import parse_metadata
from cdpipe.training.fit import FitConfig, fit
from cdpipe.training.shard import FIELDS, encode_shard, read_shard
from eval.leaderboard.calls import EvaluationFile
from eval.leaderboard.submission import Submission
from eval.running.runfolder import RunFolder, open_run_folder, write_json
from eval.running.scaling.keeping import Dropped
from sim.session.truth import read_pair_truth

NEWER = "it is of a newer tunnelcd: update tunnelcd"


@pytest.fixture(name="session")
def session_fixture(tmp_path: Path) -> Path:
    angles = {"beam_altitude_angles": [5.0, -5.0], "beam_azimuth_angles": [1.0, 1.0], "lidar_mode": "8x10"}
    poses = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (1, 8, 1))
    image = np.full((1, 2, 8), 5000)
    chunk = ScanChunk(
        image.astype(np.uint32), image.astype(np.uint8), image.astype(np.uint16), np.zeros((1, 8), int), poses
    )
    with SessionWriter(tmp_path / "session", parse_metadata(angles, "test"), 1, {}) as writer:
        writer.add(chunk)
        writer.close(make_pose()[None])
    return tmp_path / "session"


def _change(path: Path, **values: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_a_session_of_format_1_is_read_without_its_signal(session: Path) -> None:
    arrays = dict(np.load(chunk_path(session, 0)))
    del arrays["signal"]
    np.savez(chunk_path(session, 0), **arrays)
    with pytest.raises(InputError, match="signal is missing"):
        read_session(session).chunk(0)
    _change(session / "session.json", format_version=1)
    chunk = read_session(session).chunk(0)
    np.testing.assert_array_equal(chunk.range_mm, arrays["range_mm"])
    assert chunk.signal.shape == (1, 2, 8) and not chunk.signal.any()


@pytest.mark.parametrize(
    ("found", "told"),
    [
        ({"format_version": 0}, "make it again with `tunnelcd simulate` or `tunnelcd convert`"),
        ({"format_version": None}, "make it again with `tunnelcd simulate`"),
        ({"format": "their-session"}, "make it again with `tunnelcd simulate`"),
        ({"format_version": 3}, NEWER),
        ({"format": "a\nb"}, r"format a\\nb 2: this version reads"),
        ({"format_version": [2]}, "format tunnelcd-session list: this version reads tunnelcd-session 1 to 2"),
    ],
)
def test_a_session_of_another_format_is_named(session: Path, found: dict[str, Any], told: str) -> None:
    _change(session / "session.json", **found)
    with pytest.raises(InputError, match=told):
        read_session(session)


def test_the_first_answers_are_read(tmp_path: Path) -> None:
    empty = np.zeros(0, np.int64)
    np.savez_compressed(
        tmp_path / "answer.npz",
        region_centres_map=np.zeros((1, 3)), region_scores=np.ones(1), region_pairs=np.zeros((1, 2), int),
        region_is_reported=np.ones(1, bool), keyframe_scores=np.ones(2), before_keyframe_scans=np.arange(2),
        after_keyframe_scans=empty, object_returns=np.zeros((0, 2), np.int32), object_return_offsets=np.zeros(2, int),
        object_points_map=np.zeros((3, 3)), object_point_offsets=np.array([0, 3]), figure_v_oe_m3=np.ones(1),
    )  # fmt: skip
    item = {"session": "after", "kind": "added", "region": 0, "score": 0.5, "partner": -1}
    document = {
        "format": "tunnelcd-answer", "format_version": 1, "status": "ok", "error": "", "method": "paper",
        "before_T_after": np.eye(4).tolist(), "radius_m": 4.5, "seconds": {}, "evidence": {}, "config": {},
        "objects": [item],
    }  # fmt: skip
    (tmp_path / "answer.json").write_text(json.dumps(document))
    report = read_answer(tmp_path).report
    assert report is not None and len(report.objects[0].points_map) == 3 and report.objects[0].shape is None
    assert report.regions.proposed_centres_map is None


def test_the_first_truth_is_read(tmp_path: Path) -> None:
    change = {
        "id": 1, "name": "box", "prop_kind": "box", "kind": "added", "session": "after", "partner": None,
        "group": "full", "instance": 1, "world_T_object": np.eye(4).tolist(), "hull_volume_m3": 1.0, "n_returns": 10,
        "n_cells": 10, "n_ghost_rays": 10, "is_observable": True, "why_not": "",
    }  # fmt: skip
    document = {"family": "narrow", "seed": 1, "score_radius_m": 4.5, "changes": [change], "scenario": {}}
    path = tmp_path / "truth" / "changes.json"
    path.parent.mkdir()
    path.write_text(json.dumps(document))
    truth = read_pair_truth(tmp_path)
    assert truth.changes[0].mesh_volume_m3 is None and truth.changes[0].n_cells_other == 0 and truth.files == {}


@pytest.mark.parametrize(
    "mistake",
    [{"id": 0}, {"id": "x"}, {"kind": "melted"}, {"world_T_object": [[1.0]]}, {"more": 1}, {"n_returns": None}],
)
def test_a_damaged_truth_is_named(tmp_path: Path, mistake: dict[str, Any]) -> None:
    test_the_first_truth_is_read(tmp_path)
    path = tmp_path / "truth" / "changes.json"
    document = json.loads(path.read_text())
    document["changes"][0] |= mistake
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"changes\.json: damaged: changes\.0\.{next(iter(mistake))}"):
        read_pair_truth(tmp_path)


def test_cells_without_a_number_are_read_and_those_of_a_newer_format_are_refused(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    row = {"scenario": "world", "seed": 1, "variant": "ours"}
    cell = {"key": "a", "order": [0, 0], "row": row, "changes": [], "regions": [], "objects": [], "keyframes": []}
    write_json(tmp_path / "cells" / "world" / "1" / "ours.json", cell)
    assert run.finished_cells() == [cell]
    write_json(tmp_path / "cells" / "world" / "1" / "ours.json", {"format_version": 2, **cell})
    with pytest.raises(InputError, match=rf"ours\.json: format tunnelcd 2: this version reads tunnelcd 1: {NEWER}"):
        run.finished_cells()


def test_a_run_folder_of_a_newer_format_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "provenance.json", {"tool": "tunnelcd", "format_version": 1})
    open_run_folder(tmp_path)
    write_json(tmp_path / "provenance.json", {"tool": "tunnelcd", "format_version": 2})
    with pytest.raises(InputError, match=NEWER):
        open_run_folder(tmp_path)


def _renumbered(content: bytes, version: int) -> bytes:
    return content.replace(b'format_version\\": 1', b'format_version\\": %d' % version)


def test_weights_with_and_without_a_number_are_read() -> None:
    network = make_untrained_sphere_network(3)
    for content in (checkpoint_bytes(network), numbered_checkpoint_bytes(network)):
        for name, tensor in load_sphere_network(content).state_dict().items():
            torch.testing.assert_close(tensor, network.state_dict()[name], rtol=0, atol=0)
    content = numbered_checkpoint_bytes(network)
    for version, told in ((2, NEWER), (0, "train it again with `tunnelcd train`")):
        with pytest.raises(InputError, match=told):
            load_sphere_network(_renumbered(content, version))


@pytest.mark.parametrize(
    "shape", [(4, 48), (4, 49, 8, 1), (1 << 40, 48, 8, 1), (0, 48, 8, 1), (4, 48 << 20, 8, 1), (4, 48, 8, 2)]
)
def test_weights_of_no_network_are_named_before_a_network_is_made(shape: tuple[int, ...]) -> None:
    content = save_arrays({"kept.weight": np.zeros((1,), np.float32)})
    small = content.replace(b'"shape":[1]', json.dumps({"shape": shape}).encode()[1:-1])
    with pytest.raises(InputError, match=r"sphere\.safetensors: damaged, or weights of another network"):
        load_sphere_network((len(small) - 12).to_bytes(8, "little") + small[8:])


class _Point:
    """A task with a single weight."""

    def __init__(self) -> None:
        self.network = nn.Linear(1, 1)

    def losses(self, step: int) -> dict[str, Tensor]:
        return {"square": self.network.weight.square().sum()}

    def scores(self) -> dict[str, float]:
        return {"near": -abs(self.network.weight.item())}

    def finish(self) -> dict[str, float]:
        return {}


def _nothing(*_: object) -> None:
    pass


def test_a_training_state_of_another_format_is_named(tmp_path: Path) -> None:
    config, state = FitConfig(steps=2, validate_every=1), tmp_path / "state.safetensors"
    fit(_Point(), config, tmp_path, "a", _nothing, _nothing)
    arrays, metadata = read_tensors(state, lambda types: None)
    about = json.loads(metadata["about"])
    older = "this version reads tunnelcd-training 2: remove it to train from the start"
    for numbers, told in (
        ({}, older),
        ({"format": "tunnelcd-training", "format_version": 1}, older),
        ({"format": "tunnelcd-training", "format_version": 3}, NEWER),
    ):
        about = {name: value for name, value in about.items() if not name.startswith("format")} | numbers
        state.write_bytes(save_arrays(arrays, {"about": json.dumps(about)}))
        with pytest.raises(InputError, match=told):
            fit(_Point(), config, tmp_path, "a", _nothing, _nothing)


@pytest.mark.parametrize(
    "damage",
    [
        lambda about, arrays: about.update(history=[{"step": "x"}]),
        lambda about, arrays: about.pop("history"),
        lambda about, arrays: arrays.pop("last.weight"),
        lambda about, arrays: arrays.update({"last.weight": np.zeros((2, 1), np.float32)}),
        lambda about, arrays: arrays.update({"optimiser.0.exp_avg": np.zeros((1 << 10, 1), np.float32)}),
        lambda about, arrays: arrays.update({"optimiser.9.step": np.zeros((), np.float32)}),
    ],
)
def test_a_damaged_state_is_named(tmp_path: Path, damage: Callable[[dict[str, Any], dict[str, Any]], object]) -> None:
    config, state = FitConfig(steps=1, validate_every=1), tmp_path / "state.safetensors"
    fit(_Point(), config, tmp_path, "a", _nothing, _nothing)
    arrays, metadata = read_tensors(state, lambda types: None)
    about = json.loads(metadata["about"])
    damage(about, arrays)
    state.write_bytes(save_arrays(arrays, {"about": json.dumps(about)}))
    with pytest.raises(InputError, match=r"state\.safetensors: damaged .*: remove it to train from the start"):
        fit(_Point(), config, tmp_path, "a", _nothing, _nothing)


def test_a_shard_of_another_format_is_named(tmp_path: Path) -> None:
    lengths = {"K": 2, "J": 2, "C": 1, "D": 1, "R": 2, "W": 4, "I": 3, "V": 2, "U": 2}
    arrays = {
        field.name: np.zeros([lengths.get(axis) or int(axis) for axis in field.shape.split(",")], field.dtype)
        for field in FIELDS
    }
    content = encode_shard(arrays, {"family": "made", "seed": 1})
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    assert read_shard(path, ("labels",))[1]["format_version"] == 1
    for version, told in ((2, NEWER), (0, "remove it, and run the command that made the folder again")):
        path.write_bytes(_renumbered(content, version))
        with pytest.raises(InputError, match=told):
            read_shard(path)


@pytest.mark.parametrize("model", [AnswerPart, Submission, EvaluationFile, Dropped])
def test_documents_of_a_newer_format_say_so(model: type[BaseModel]) -> None:
    for version, told in ((2, f"; {NEWER}"), (0, "")):
        with pytest.raises(InputError) as error:
            validate(model, Document("a.json", {"format_version": version}))
        (line,) = (line for line in str(error.value).split("\n") if line.startswith("a.json: format_version ="))
        assert line.endswith(f"input should be 1{told}")


def test_a_known_merge_of_a_newer_format_is_refused(tmp_path: Path) -> None:
    path, identity = tmp_path / "merge.json", np.eye(4)
    write_alignment(path, identity, PathAlignment(np.zeros((1, 3)), identity[None]), "truth")
    np.testing.assert_array_equal(read_known_merge(path), identity)
    assert len(read_alignment(path).before_T_after) == 1
    _change(path, format_version=2)
    for read in (read_known_merge, read_alignment):
        with pytest.raises(InputError, match=NEWER):
            read(path)
