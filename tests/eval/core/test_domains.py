from __future__ import annotations

import pytest

from eval.core.domains import domain_of


@pytest.mark.parametrize(
    ("family", "domain"),
    [
        ("narrow", "in"), ("regions/wide", "in"), ("null/network", "in"),
        ("cave", "out"), ("paper/site1", "out"), ("hard/drift", "out"), ("mine.yaml", "out"),
        ("surface/convergence", "in"), ("surface/null", "in"), ("surface/wide", "out"), ("surface/cave", "out"),
        # what `train/mine` has
        ("dust/narrow", "in"), ("dust/mist", "in"), ("water/null", "in"), ("cross/narrow", "in"),
        ("dynamic/narrow", "out"), ("dust/haul", "out"), ("cross/survey", "out"), ("glare/null", "out"),
    ],
)  # fmt: skip
def test_only_shipped_variations_of_trained_families_are_in_distribution(family: str, domain: str) -> None:
    assert domain_of(family) == domain
