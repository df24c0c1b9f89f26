"""How much of what was planned a run folder holds: while some is missing, no verdict is passed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, validate
from eval.plans.plan import Plan, planned_cases


@dataclass(frozen=True, slots=True)
class Coverage:
    """Session pairs that the plan of a run names, and how many of them have all of their cells."""

    n_done: int
    n_planned: int

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing."""
        return self.n_done == self.n_planned

    @property
    def sentence(self) -> str:
        """The same in words."""
        return f"{self.n_done} of {self.n_planned} planned pairs so far: no verdict before all are there."


def coverage(provenance: Mapping[str, Any], cases: Iterable[tuple[str, int, str]]) -> Coverage | None:
    """Compare what a run holds with the plan that it was last run with.

    Args:
        provenance: Content of provenance.json.
        cases: Scenario, seed and variant of each row of results.csv.

    Returns:
        None where the plan is not told, or cannot be read any more (a preset's file is gone).
    """
    plan = plan_of(provenance)
    if plan is None:
        return None
    planned = planned_cases(plan)
    missing = planned - set(cases)
    pairs = {(scenario, seed) for scenario, seed, _ in planned}
    return Coverage(len(pairs - {(scenario, seed) for scenario, seed, _ in missing}), len(pairs))


def plan_of(provenance: Mapping[str, Any]) -> Plan | None:
    """Return the plan that a run was last run with; None where it is not told or cannot be read any more."""
    document = provenance.get("plan")
    if not isinstance(document, dict):
        return None
    try:
        return validate(Plan, Document("provenance.json", document))
    except InputError:
        return None
