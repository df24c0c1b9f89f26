"""The truth of a session's returns as values beside them, and as labels of SemanticKITTI."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Int32Array
from cdpipe.io.out.kitti import LABEL, Label
from cdpipe.io.out.scans import Fields
from cdpipe.io.session import Session
from sim.session.truth import MIXED, read_chunk_labels, read_chunk_surface, read_pair_truth
from sim.story.state import is_story

_KINDS = ("added", "removed", "moved", "reshaped")
_UNLABELED, _OUTLIER, _ROCK, _PROP, _MOVING, _FIRST_CHANGE = 0, 1, 52, 99, 259, 300
# The numbers below 300 are SemanticKITTI's, whose 52 is "other-structure" and 99 "other-object".
LABELS = (
    Label(_UNLABELED, "unlabeled", (0, 0, 0)),
    Label(_OUTLIER, "outlier", (0, 0, 255)),
    Label(_ROCK, "walls-floor-fixtures", (128, 128, 128)),
    Label(_PROP, "object", (255, 255, 50)),
    Label(_MOVING, "moving", (255, 0, 180)),
    *(Label(_FIRST_CHANGE + k, f"change-{kind}", bgr) for k, (kind, bgr) in enumerate(
        zip(_KINDS, ((60, 200, 60), (60, 60, 230), (230, 160, 40), (200, 80, 200)), strict=True))),
)  # fmt: skip


def knows_changes(session: Session) -> bool:
    """Return whether the truth of a session tells what changed: of a story's session there is none of changes."""
    return not is_story(session.path.resolve().parent)


def truth_fields(session: Session) -> Fields:
    """Return what gives `change`, `instance`, and where rock moves `displacement` of returns, as `sim.session.truth`.

    A session of a story has no `change`.

    Raises:
        InputError: When called: the truth of a chunk is missing or damaged.
    """
    has_changes = knows_changes(session)

    @lru_cache(maxsize=1)
    def of_chunk(index: int) -> dict[str, npt.NDArray[Any]]:
        instance, change = read_chunk_labels(session.path, index)
        surface = read_chunk_surface(session.path, index)
        found = {"change": change, "instance": instance} if has_changes else {"instance": instance}
        return found | ({} if surface is None else {"displacement": surface[0]})

    def of_scan(scan: int, pixels: Int32Array) -> Mapping[str, npt.NDArray[Any]]:
        chunk, row = divmod(scan, session.chunk_scans)
        return {name: values[row].ravel()[pixels] for name, values in of_chunk(chunk).items()}

    return of_scan


def semantic_fields(session: Session) -> Fields:
    """Return what gives the uint32 label of returns: one of `LABELS`, and the instance of a prop in the high 16 bits.

    Raises:
        InputError: The truth of the pair is missing or damaged; when called, that of a chunk.
    """
    truth = read_pair_truth(session.path.parent)
    movers = [mover.instance for mover in truth.movers]
    of_change = np.zeros(1 + max((change.id for change in truth.changes), default=0), np.int64)
    for change in truth.changes:
        of_change[change.id] = _FIRST_CHANGE + _KINDS.index(change.kind)
    fields = truth_fields(session)

    def of_scan(scan: int, pixels: Int32Array) -> Mapping[str, npt.NDArray[Any]]:
        found = fields(scan, pixels)
        instance, change = found["instance"].astype(np.int64), found["change"].astype(np.int64)
        is_changed = (change > 0) & (change < len(of_change))
        semantic = np.full(len(pixels), _PROP)
        semantic[np.isin(instance, movers)] = _MOVING
        semantic[instance == 0] = _ROCK
        semantic[instance < 0] = _OUTLIER
        semantic[is_changed] = of_change[change[is_changed]]
        semantic[change == MIXED] = _UNLABELED
        return {LABEL: (semantic | (np.maximum(instance, 0) << 16)).astype(np.uint32)}

    return of_scan
