"""The training loop of all descriptors: seeded, resumable, with early stopping on the validation tunnels.

A task provides the network, the losses of a step and the scores. What is scored and kept is the exponential moving
average of the weights, because the last steps alone fit the last batches. Every random draw depends on (seed, step)
alone, so a resumed run gives the same weights as an uninterrupted one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Protocol

import numpy as np
import torch
from pydantic import TypeAdapter
from safetensors.torch import save
from torch import Tensor, nn

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, parse_json, read_tensors, require_format
from cdpipe.descriptors.weights_file import list_tensors

FORMAT = "tunnelcd-training"
FORMAT_VERSION = 2  # 1 held no averaged weights
_STATE = "state.safetensors"
_REMEDY = "remove it to train from the start"
_WARM_UP = 0.1


@dataclass(frozen=True, slots=True)
class FitConfig:
    """The settings of a training run.

    Attributes:
        seed: Seed of the initial weights and of every draw.
        steps: Largest number of steps; the learning rate falls to zero over them.
        learning_rate: Peak learning rate.
        validate_every: Steps between two validations.
        patience: Number of validations without a new best score after which training stops.
        averaging: Share of the earlier average in that of a step; less in the first steps, (1 + step) / (10 + step).
    """

    seed: int = 0
    steps: int = 4000
    learning_rate: float = 2e-3
    validate_every: int = 250
    patience: int = 6
    averaging: float = 0.999


class Task(Protocol):
    """A network with its losses and scores."""

    @property
    def network(self) -> nn.Module:
        """The network; `fit` trains it."""

    def losses(self, step: int) -> dict[str, Tensor]:
        """Return the terms of a step's loss by name; their sum is minimised."""

    def scores(self) -> dict[str, float]:
        """Return the validation scores by name; the first one selects the best weights, larger is better."""

    def finish(self) -> dict[str, float]:
        """Post-process the best weights once; return figures for the model card."""


@dataclass(frozen=True, slots=True)
class Progress:
    """The state of training after a validation.

    Attributes:
        step: Number of steps done.
        losses: Mean of each term of the loss since the last validation.
        scores: Validation scores.
        is_best: Whether the first score is the best so far.
        seconds: Wall-clock time so far, interrupted runs included.
    """

    step: int
    losses: Mapping[str, float]
    scores: Mapping[str, float]
    is_best: bool
    seconds: float = field(default=0.0, compare=False)


def learning_rate(step: int, config: FitConfig) -> float:
    """Return the learning rate of a step: linear warm-up over the first tenth, then a half cosine to zero."""
    warm = _WARM_UP * config.steps
    if step < warm:
        return config.learning_rate * (step + 1) / (warm + 1)
    share = torch.tensor((step - warm) / max(config.steps - warm, 1.0))
    return config.learning_rate * 0.5 * float(1.0 + torch.cos(torch.pi * share))


def fit(
    task: Task,
    config: FitConfig,
    folder: Path,
    identity: str,
    on_step: Callable[[int, Mapping[str, float]], None],
    on_validation: Callable[[Progress], None],
) -> list[Progress]:
    """Train a task's network; afterwards it has the averaged weights of the best validation.

    Args:
        task: Network, losses, scores; the network computes where its weights lie.
        config: Steps, rates, patience.
        folder: Holds the state after every validation; training resumes from a state found there.
        identity: Digest of data and settings; a state with another identity is refused.
        on_step: Called with the step and its losses.
        on_validation: Called after every validation, also for those of a resumed run.

    Returns:
        All validations, in order.

    Raises:
        InputError: The state in `folder` is of another run, or damaged, or the validation tunnels cannot tell which
            weights are best.
    """
    network = task.network
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=1e-3)
    identity = json.dumps({"run": identity, **asdict(config)}, sort_keys=True)
    history, average, best = _restore(folder / _STATE, network, optimiser, identity)
    for done in history:
        on_validation(done)
    sums: dict[str, float] = {}
    began = perf_counter() - (history[-1].seconds if history else 0.0)
    for step in range(history[-1].step if history else 0, config.steps):
        if len(history) > config.patience and not any(done.is_best for done in history[-config.patience :]):
            break
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, config)
        network.train()
        losses = task.losses(step)
        optimiser.zero_grad()
        torch.stack(list(losses.values())).sum().backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        keep = min(config.averaging, (1 + step) / (10 + step))
        for name, weights in network.named_parameters():
            average[name].lerp_(weights.detach(), 1.0 - keep)
        numbers = {name: loss.item() for name, loss in losses.items()}
        sums = {name: sums.get(name, 0.0) + value for name, value in numbers.items()}
        on_step(step + 1, numbers)
        if (step + 1) % config.validate_every and step + 1 < config.steps:
            continue
        n_steps = step + 1 - (history[-1].step if history else 0)
        network.eval()
        last = _copy(network.state_dict())
        network.load_state_dict(average)
        scores = task.scores()
        network.load_state_dict(last)
        name, first = next(iter(scores.items()))
        if not np.isfinite(first):
            raise InputError(f"{name} of the validation tunnels is {first}: make more validation tunnels")
        is_best = all(first > next(iter(done.scores.values())) for done in history)
        means = {name: value / n_steps for name, value in sums.items()}
        history.append(Progress(step + 1, means, scores, is_best, perf_counter() - began))
        sums = {}
        if is_best:
            best = _copy(average)
        _save(folder / _STATE, {"last": last, "average": average, "best": best}, optimiser, history, identity)
        on_validation(history[-1])
    network.load_state_dict(best)
    network.eval()
    return history


def _save(
    path: Path,
    weights: Mapping[str, Mapping[str, Tensor]],
    optimiser: torch.optim.Optimizer,
    history: list[Progress],
    identity: str,
) -> None:
    """Write the state that the next step depends on, as safetensors, so that nothing is unpickled."""
    tensors = {f"{part}.{name}": tensor for part, of_part in weights.items() for name, tensor in of_part.items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": tensor for name, tensor in state.items()}
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, "identity": identity}
    about = json.dumps({**document, "history": [asdict(done) for done in history]})
    content = save({name: tensor.clone().contiguous() for name, tensor in tensors.items()}, {"about": about})
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):  # a closed folder does not even let look
            partial.unlink()
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def _restore(
    path: Path, network: nn.Module, optimiser: torch.optim.Optimizer, identity: str
) -> tuple[list[Progress], dict[str, Tensor], dict[str, Tensor]]:
    """Load a state into network and optimiser; return the validations so far, the averaged and the best weights."""
    if not path.is_file():
        return [], _copy(network.state_dict()), _copy(network.state_dict())
    try:
        _, metadata = read_tensors(path, lambda types: None, (), remedy=_REMEDY)
        about = parse_json(metadata["about"])
        # the first states carry no number; they hold the same as those of format 1
        found = about.get("format", FORMAT), about.get("format_version", 1)
        require_format(path, found, FORMAT, FORMAT_VERSION, _REMEDY, oldest=FORMAT_VERSION)
        if about["identity"] != identity:
            raise InputError(f"{path}: of a run on other data or with other settings: name another --out")
        history = TypeAdapter(list[Progress]).validate_python(about["history"])
        arrays, _ = read_tensors(path, _list_state(network), remedy=_REMEDY)
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        network.load_state_dict(_below("last.", tensors))
        states: dict[int, dict[str, Tensor]] = {}
        for key, tensor in _below("optimiser.", tensors).items():
            index, _, name = key.partition(".")
            states.setdefault(int(index), {})[name] = tensor
        optimiser.load_state_dict({**optimiser.state_dict(), "state": states})
        device = next(network.parameters()).device
        average, best = (_below(part, tensors, device) for part in ("average.", "best."))
        return history, average, best
    except (AttributeError, KeyError, ValueError, TypeError, RuntimeError) as error:
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: damaged ({told}): {_REMEDY}") from error


def _list_state(network: nn.Module) -> dict[str, ArraySpec]:
    """Return what the state of a training run holds: three sets of weights, and AdamW's moments of each parameter."""
    weights = {name: replace(spec, is_finite=False) for name, spec in list_tensors(network.state_dict()).items()}
    state = {f"{part}.{name}": spec for part in ("last", "average", "best") for name, spec in weights.items()}
    for index, parameter in enumerate(network.parameters()):
        moments = {"step": torch.zeros(()), "exp_avg": parameter, "exp_avg_sq": parameter}
        parts = list_tensors({f"optimiser.{index}.{name}": tensor for name, tensor in moments.items()})
        state |= {name: replace(spec, is_optional=True, is_finite=False) for name, spec in parts.items()}
    return state


def _copy(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in tensors.items()}


def _below(prefix: str, tensors: Mapping[str, Tensor], device: torch.device | None = None) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): each.to(device) for name, each in tensors.items() if name.startswith(prefix)}
