"""Worlds of the bench with a quarter of the returns: what is measured on them is the same."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from eval.bench import merge, profile, whole
from eval.training import dataset
from tests.eval.running.runs import load_small


@pytest.fixture(scope="module")
def thinned() -> Iterator[None]:
    """Thin out the worlds that these modules draw."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (merge, profile, whole, dataset):
            patch.setattr(module, "load_scenario", load_small)
        yield
