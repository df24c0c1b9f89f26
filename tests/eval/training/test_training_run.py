from __future__ import annotations

import csv
import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from cdpipe.descriptors.sphere_network import load_sphere_network
from cdpipe.descriptors.weights_file import digest
from cdpipe.io.answer import read_answer
from eval.core.output import only_writer
from scenarios.schema import Scenario
from tests.eval.running.runs import load_small

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module", name="pair")
def pair_fixture(simulated_once: Callable[[Scenario, int], Path]) -> Path:
    """A small pair; `describe` writes into it, on a copy."""
    return simulated_once(load_small("smoke/one_box", 20000), 20000)


def test_from_a_dataset_to_a_checkpoint_with_its_card(training_data: Path, tmp_path: Path, command: Command) -> None:
    out = tmp_path / "trained"
    arguments = ("train", training_data, "--out", out, "--steps", "3", "--threads", "1", "--quiet")
    assert command(*arguments)[0] == 0
    checkpoint = out / "sphere.safetensors"
    network = load_sphere_network(checkpoint.read_bytes())
    card = json.loads((out / "sphere.json").read_text())
    assert card["network"] == asdict(network.size)
    assert card["checkpoint"] == digest(checkpoint.read_bytes())
    assert card["data"]["seeds"] == "3:4" and card["validation"]["seeds"] == "10003:10004"
    assert card["data"]["digest"] != card["validation"]["digest"]
    assert set(card["validation"]["trained"]) == {"log_likelihood", "auroc", "auroc_pooled"}
    with (out / "curves.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["3"]
    assert (out / "curves.png").stat().st_size > 1000
    # the same command again has nothing left to do, and says the same
    content = checkpoint.read_bytes()
    assert command(*arguments)[0] == 0
    assert checkpoint.read_bytes() == content
    # weights depend on the number of threads: a run goes on with its own
    code, _, err = command("train", training_data, "--out", out, "--steps", "3", "--threads", "2", "--quiet")
    assert code == 2 and "with other settings" in err


def test_what_was_trained_is_used_at_once(training_data: Path, tmp_path: Path, command: Command, pair: Path) -> None:
    described = tmp_path / "pair"
    shutil.copytree(pair, described)
    digests, settings = {}, []
    for descriptor, group in (("3deg", "descriptor"), ("sphere", "sphere")):
        options = ("--descriptor", descriptor, "--steps", "1", "--threads", "1", "--quiet")
        assert command("train", training_data, "--out", tmp_path / descriptor, *options)[0] == 0
        digests[descriptor] = json.loads((tmp_path / descriptor / f"{descriptor}.json").read_text())["checkpoint"]
        settings += ["--set", f"{group}.weights={tmp_path / descriptor / descriptor}.safetensors"]
    sessions = described / "before", described / "after"
    code, out, _ = command("describe", sessions[0], *settings)
    assert code == 0 and digests["3deg"] in out
    assert command("detect", *sessions, *settings, "--out", tmp_path / "mine", "--quiet")[0] == 0
    assert json.loads((tmp_path / "mine" / "answer.json").read_text())["checkpoints"] == digests
    _, out, _ = command("score", described, tmp_path / "mine", "--wide")
    row = dict(line.split(None, 1) for line in out.splitlines() if len(line.split(None, 1)) == 2)
    assert row["checkpoints"].strip() == ";".join(f"{name} {digest}" for name, digest in digests.items())
    # the shipped weights do not find what was described with others
    assert command("detect", *sessions, "--out", tmp_path / "shipped", "--quiet")[0] == 0
    mine, shipped = (read_answer(tmp_path / name) for name in ("mine", "shipped"))
    assert mine.report is not None and shipped.report is not None
    assert set(shipped.checkpoints.values()).isdisjoint(digests.values())
    assert mine.report.regions.scores[0] != pytest.approx(shipped.report.regions.scores[0])
    wrong = ("--set", f"sphere.weights={tmp_path}/3deg/3deg.safetensors", "--out", tmp_path / "wrong")
    code, _, err = command("detect", *sessions, *wrong)
    assert code == 2 and "weights of another network" in err and len(err.splitlines()) == 1


def test_a_disk_that_runs_full_leaves_no_half_of_a_file(
    training_data: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("train", training_data, "--out", tmp_path, "--descriptor", "3deg", "--steps", "1", "--quiet")
    usual = Path.write_bytes
    written: list[str] = []

    def full(path: Path, content: bytes) -> int:
        if path.parent != tmp_path or path.name in written:
            return usual(path, content)
        written.append(path.name)
        usual(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    for _ in range(3):  # the state, the curves, the checkpoint
        whole = {path.name for path in tmp_path.iterdir()}
        code, _, err = command(*arguments)
        assert code == 2 and "No space left on device" in err and err.count("\n") == 1
        assert {path.name for path in tmp_path.iterdir()} - whole <= {"state.safetensors", "curves.csv", "curves.png"}
    assert not (tmp_path / "3deg.safetensors").exists()
    assert command(*arguments)[0] == 0


def test_the_place_descriptor_is_trained_by_the_same_command(
    training_data: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "trained"
    arguments = ("--descriptor", "3deg", "--steps", "2", "--threads", "1", "--quiet")
    assert command("train", training_data, "--out", out, *arguments)[0] == 0
    card = json.loads((out / "3deg.json").read_text())
    assert set(card["validation"]["trained"]) == {"recall_at_1", "yaw_error_deg", "yaw_flip_share"}


def test_a_network_for_the_rival_is_trained_by_the_same_command_and_used_at_once(
    training_data: Path, tmp_path: Path, command: Command, pair: Path
) -> None:
    options = ("--descriptor", "range-net", "--steps", "2", "--threads", "1", "--quiet")
    assert command("train", training_data, "--out", tmp_path / "trained", *options)[0] == 0
    card = json.loads((tmp_path / "trained" / "range-net.json").read_text())
    names = {"average_precision", "average_precision_change_head", "visibility_accuracy"}
    assert set(card["validation"]["trained"]) == set(card["validation"]["untrained"]) == names
    checkpoint, found = tmp_path / "trained" / "range-net", []
    usual = torch.get_num_threads()
    try:
        for threads, out in ((1, "one"), (2, "two")):
            torch.set_num_threads(threads)
            settings = ("--set", f"range_net.weights={checkpoint}.safetensors", "--set", "range_net.threshold=0.4")
            arguments = ("--preset", "range-net", *settings, "--out", tmp_path / out, "--quiet")
            assert command("detect", pair / "before", pair / "after", *arguments)[0] == 0
            answer = read_answer(tmp_path / out)
            assert answer.checkpoints["range-net"] == card["checkpoint"]
            assert answer.report is not None
            found.append(answer.report.regions)
    finally:
        torch.set_num_threads(usual)
    # a session is compared on one thread, whatever torch was told before
    assert found[0].scores.tolist() == found[1].scores.tolist()
    assert found[0].keyframe_scores.tobytes() == found[1].keyframe_scores.tobytes()
    wrong = ("--set", f"range_net.weights={tmp_path / 'none.safetensors'}", "--out", tmp_path / "wrong", "--quiet")
    code, _, err = command("detect", pair / "before", pair / "after", "--preset", "range-net", *wrong)
    assert code == 2 and "none.safetensors: missing" in err and len(err.strip().splitlines()) == 1


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
def test_a_folder_that_another_training_writes_is_refused(
    training_data: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with only_writer(out):
        code, _, err = command("train", training_data, "--out", out, "--steps", 2)
    said = f"error: {out}: another `tunnelcd train` writes there: wait until it ends, or name another\n"
    assert (code, err, list(out.iterdir())) == (2, said, [])


def test_mistakes_are_one_line(training_data: Path, tmp_path: Path, command: Command) -> None:
    def refused(*arguments: object) -> str:
        code, _, err = command("train", *arguments)
        assert code == 2 and len(err.strip().splitlines()) == 1
        return err

    assert "expected sphere or 3deg" in refused(training_data, "--out", tmp_path / "a", "--descriptor", "spere")
    assert "made by `tunnelcd dataset`" in refused(tmp_path, "--out", tmp_path / "b")
    assert not (tmp_path / "b").exists()
    assert "holds training data" in refused(training_data, "--out", training_data)
    assert "--seed" in command("train", training_data, "--out", tmp_path / "d", "--seed", 2**64)[2]
    training = tmp_path / "training"
    shutil.copytree(training_data, training)
    rows = (training / "index.csv").read_text().splitlines()
    (training / "index.csv").write_text("\n".join(row for row in rows if "10003" not in row) + "\n")
    assert "split validation" in refused(training, "--out", tmp_path / "c", "--quiet")
