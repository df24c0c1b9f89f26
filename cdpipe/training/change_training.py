"""Training of the network of `range-net`: mark the changed pixels of images, on simulated changes.

A pixel has changed if it holds returns of an observable change of its own session. It is visible if the other session's
image reaches as far, or if it holds such a change, which the truth calls observable because the other session saw its
place. The change head learns from visible pixels alone, the visibility head from all pixels that hold a point; pixels
with an unobservable change teach no change. In half of the batch every keyframe has a change. In a quarter objects of
other tunnels are pasted in front of the surface (as the composition of Chamelion, arXiv 2602.08189). Augmentation is
that of the sphere descriptor: either session first, reversed heading, mirror image, scale, missing pixels and merge
errors. The images stand on gravity, so they are not turned about the path.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import stream
from cdpipe.core.ranking import average_precision
from cdpipe.descriptors.change_network import ChangeNetwork
from cdpipe.descriptors.devices import compute
from cdpipe.descriptors.sphere_image import COLUMNS
from cdpipe.training.sphere_training import (
    CHANGED,
    PASTED_SHIFT_ROWS,
    UNCOUNTED,
    SphereData,
    augment,
    find_donors,
    paste_objects,
)

BATCH = 32
# One pixel in some thirty of a batch has changed.
_POSITIVE_WEIGHT = 3.0
# The other image reaches as far as a surface if its own is no more than this in front.
_IN_FRONT_M = 0.3
_VISIBLE = 0.5


class ChangeTask:
    """Trains a change network, `network`, on some tunnels and scores it on others."""

    def __init__(self, network: ChangeNetwork, training: SphereData, validation: SphereData, seed: int) -> None:
        """Hold the data.

        Raises:
            InputError: The tunnels hold no object that was added, or no change.
        """
        self.network, self._data, self._validation, self._seed = network, training, validation, seed
        has_changed = [
            (marks == CHANGED).flatten(1).any(dim=1) for marks in (training.before_marks, training.after_marks[:, 0])
        ]
        self._changed = torch.nonzero(has_changed[0] | has_changed[1])[:, 0].numpy()
        self._donors = find_donors(training)
        if not len(self._donors):
            raise InputError("training needs keyframes with an object added: make more tunnels")
        if not any((marks == CHANGED).any() for marks in (validation.before_marks, validation.after_marks)):
            raise InputError("validation needs an observable change: make more validation tunnels")

    def losses(self, step: int) -> dict[str, Tensor]:
        """Return the loss of the change head and that of the visibility head."""
        own, other, marks, is_visible = self.batch(step)
        change, visible = compute(self.network, own, other)
        is_there = own > 0
        is_known = is_there & is_visible & (marks != UNCOUNTED)
        weight = torch.tensor(_POSITIVE_WEIGHT)
        is_changed = (marks == CHANGED).float()
        of_change = functional.binary_cross_entropy_with_logits(change, is_changed, reduction="none", pos_weight=weight)
        of_view = functional.binary_cross_entropy_with_logits(visible, is_visible.float(), reduction="none")
        return {
            "change": (of_change * is_known).sum() / is_known.sum(),
            "visibility": (of_view * is_there).sum() / is_there.sum(),
        }

    def batch(self, step: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what a step learns from, each (BATCH, ROWS, COLUMNS).

        Returns:
            The images of either session and of the other one, metres, and the marks (`SphereData`) and the visibility
            (bool) of the pixels of the first.
        """
        data, draw = self._data, stream(self._seed, "train-range-net", str(step))
        half = BATCH // 2
        chosen = np.concatenate([draw.choice(self._changed, half), draw.integers(len(data.before_m), size=half)])
        errors = draw.integers(data.n_draws, size=BATCH)
        images = [data.before_m[chosen].clone(), data.after_m[chosen, errors].clone()]
        marks = [data.before_marks[chosen], data.after_marks[chosen, errors].clone()]
        pasted = slice(half, half + BATCH // 4)
        donors = draw.choice(self._donors, pasted.stop - pasted.start)
        shifts = draw.integers(-PASTED_SHIFT_ROWS, PASTED_SHIFT_ROWS, len(donors), endpoint=True)
        images[1][pasted], put = paste_objects(images[1][pasted], data, donors, shifts)
        marks[1][pasted] = torch.where(put > 0, put, marks[1][pasted])
        own = int(draw.random() < 0.5)
        is_visible = visible_mask(images[own], images[1 - own], marks[own])
        seen = augment(images[0], images[1], draw)
        found = [seen[own], seen[1 - own], marks[own], is_visible]
        if draw.random() < 0.5:  # reversed heading
            found = [each.flip(1) for each in found]
        if draw.random() < 0.5:  # mirrored tunnel: column c moves to COLUMNS / 2 - 1 - c
            found = [each.flip(2).roll(COLUMNS // 2, 2) for each in found]
        return found[0], found[1], found[2], found[3]

    def scores(self) -> dict[str, float]:
        """Return figures of the pixels of both sessions that hold a point, with a merge error.

        `average_precision` is that of the change probabilities, 0 where the visibility head says hidden;
        `average_precision_change_head` that of the change head alone, `visibility_accuracy` the share of pixels of
        which the other head is right.
        """
        data = self._validation
        after_m, after_marks = (part[:, min(1, data.n_draws - 1)] for part in (data.after_m, data.after_marks))
        directions = (
            (data.before_m, after_m, data.before_marks),
            (after_m, data.before_m, after_marks),
        )
        parts: list[list[Tensor]] = []
        with torch.inference_mode():
            for own, other, marks in (
                batch
                for arrays in directions
                for batch in zip(*(torch.split(each, 8 * BATCH) for each in arrays), strict=True)
            ):
                change, visible = compute(self.network, own, other)
                is_there = own > 0
                of_batch = change.sigmoid(), visible.sigmoid(), marks, visible_mask(own, other, marks)
                parts.append([each[is_there] for each in of_batch])
        change, visible, marks, is_visible = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
        counts = marks != UNCOUNTED
        is_changed = marks[counts] == CHANGED
        judged = np.where(visible >= _VISIBLE, change, 0.0)
        return {
            "average_precision": average_precision(judged[counts], is_changed),
            "average_precision_change_head": average_precision(change[counts], is_changed),
            "visibility_accuracy": float(np.mean((visible >= _VISIBLE) == is_visible)),
        }

    def finish(self) -> dict[str, float]:
        """Return nothing: the threshold of a point is a setting."""
        return {}


def visible_mask(own_m: Tensor, other_m: Tensor, own_marks: Tensor) -> Tensor:
    """Mark the pixels of images whose surface the other session could see.

    Args:
        own_m: (B, ROWS, COLUMNS) images, metres.
        other_m: The other session's images at the same poses.
        own_marks: The marks of the former.
    """
    reaches = (other_m > 0) & (other_m >= own_m - _IN_FRONT_M)
    return reaches | (own_marks == CHANGED)
