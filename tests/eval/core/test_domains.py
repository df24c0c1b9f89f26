from __future__ import annotations

import pytest

from eval.core.domains import domain_of


@pytest.mark.parametrize(
    ("family", "domain"),
    [
        ("narrow", "in"), ("regions/wide", "in"), ("null/network", "in"),
        ("cave", "out"), ("paper/site1", "out"), ("hard/drift", "out"), ("mine.yaml", "out"),
        ("surface/convergence", "in"), ("surface/null", "in"), ("surface/wide", "out"), ("surface/cave", "out"),
        # the tunnels are trained ones, the air is not
        ("dust/narrow", "out"), ("dust/wide", "out"), ("dust/null", "out"),
    ],
)  # fmt: skip
def test_only_shipped_variations_of_trained_families_are_in_distribution(family: str, domain: str) -> None:
    assert domain_of(family) == domain
