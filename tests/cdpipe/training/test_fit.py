from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import stream
from cdpipe.training.fit import FitConfig, Progress, fit, learning_rate


class _Line:
    """Learns y = 2 x + 1; the score falls again from `worse_after` validations on."""

    def __init__(self, worse_after: int = 1000) -> None:
        self.network = nn.Linear(1, 1)
        nn.init.zeros_(self.network.weight)
        nn.init.zeros_(self.network.bias)
        self._worse_after, self._n_scored = worse_after, 0
        self.steps: list[int] = []

    def losses(self, step: int) -> dict[str, Tensor]:
        self.steps.append(step)
        x = torch.from_numpy(stream(0, "line", str(step)).normal(size=(16, 1))).float()
        return {"square": (self.network(x) - 2 * x - 1).square().mean()}

    def scores(self) -> dict[str, float]:
        self._n_scored += 1
        error = abs(self.network.weight.item() - 2) + abs(self.network.bias.item() - 1)
        return {"near": -error if self._n_scored <= self._worse_after else -100.0 - self._n_scored}

    def finish(self) -> dict[str, float]:
        return {}


def _nothing(*_: object) -> None:
    pass


def _run(task: _Line, folder: Path, config: FitConfig, identity: str = "a") -> list[Progress]:
    return fit(task, config, folder, identity, _nothing, _nothing)


CONFIG = FitConfig(steps=40, learning_rate=0.1, validate_every=10)


def test_a_line_is_learned_and_the_loss_falls(tmp_path: Path) -> None:
    task = _Line()
    history = _run(task, tmp_path, FitConfig(steps=200, learning_rate=0.1, validate_every=50))
    assert [done.step for done in history] == [50, 100, 150, 200]
    assert history[-1].losses["square"] < 0.01 * history[0].losses["square"]
    assert task.network.weight.item() == pytest.approx(2.0, abs=0.05)


def test_a_run_cut_off_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    whole, cut, resumed = _Line(), _Line(), _Line()
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
    at_once = _run(whole, tmp_path / "whole", CONFIG)

    def stop(step: int, losses: Mapping[str, float]) -> None:
        if step == 25:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(cut, CONFIG, tmp_path / "cut", "a", stop, _nothing)
    told: list[int] = []
    history = fit(resumed, CONFIG, tmp_path / "cut", "a", _nothing, lambda done: told.append(done.step))
    assert resumed.steps == list(range(20, 40))  # from the last validation
    assert told == [10, 20, 30, 40]
    assert history == at_once
    torch.testing.assert_close(resumed.network.weight, whole.network.weight, rtol=0, atol=0)


def test_training_stops_and_the_best_weights_stay(tmp_path: Path) -> None:
    task = _Line(worse_after=2)
    history = _run(task, tmp_path, FitConfig(steps=1000, learning_rate=0.1, validate_every=10, patience=3))
    assert [done.is_best for done in history] == [True, True, False, False, False]
    kept = abs(task.network.weight.item() - 2) + abs(task.network.bias.item() - 1)
    assert -kept == pytest.approx(history[1].scores["near"])


def test_a_state_of_another_run_is_refused(tmp_path: Path) -> None:
    _run(_Line(), tmp_path, CONFIG)
    with pytest.raises(InputError, match="other data or with other settings: name another --out"):
        _run(_Line(), tmp_path, CONFIG, identity="b")
    (tmp_path / "state.safetensors").write_bytes(b"cut short")
    with pytest.raises(InputError, match="damaged"):
        _run(_Line(), tmp_path, CONFIG)


def test_the_rate_rises_and_falls() -> None:
    config = FitConfig(steps=100, learning_rate=1.0)
    rates = [learning_rate(step, config) for step in range(100)]
    assert max(rates) == pytest.approx(1.0) and rates.index(max(rates)) == 10
    assert rates[0] < 0.1 and rates[-1] < 0.001


def test_the_average_of_the_weights_is_scored_and_kept(tmp_path: Path) -> None:
    task, weights = _Line(), []
    config = FitConfig(steps=30, learning_rate=0.1, validate_every=30, averaging=0.7)
    fit(task, config, tmp_path, "a", lambda *_: weights.append(task.network.weight.item()), _nothing)
    average = 0.0
    for step, weight in enumerate(weights):
        keep = min(0.7, (1 + step) / (10 + step))
        average = keep * average + (1 - keep) * weight
    assert task.network.weight.item() == pytest.approx(average, rel=1e-5)
    assert average != pytest.approx(weights[-1], rel=1e-3)
