"""Share of the planned pairs that a run folder holds; an incomplete run gets no verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import Document, validate
from eval.plans.cells import list_planned_cases
from eval.plans.plan import Plan


@dataclass(frozen=True, slots=True)
class Coverage:
    """Number of session pairs in the plan of a run, and of those with all of their cells; both 0 without a plan.

    `mistake` says why a plan that is there cannot be read.
    """

    n_done: int
    n_planned: int
    mistake: str = ""

    @property
    def is_whole(self) -> bool:
        """Whether all planned pairs are complete."""
        return not self.mistake and self.n_done == self.n_planned

    @property
    def sentence(self) -> str:
        """The counts in words."""
        if self.mistake:
            return f"no verdict, as the plan of the run cannot be read here: {self.mistake}."
        return f"{self.n_done} of {self.n_planned} planned pairs so far: no verdict before all are there."


def measure_coverage(provenance: Mapping[str, Any], cases: Iterable[tuple[str, int, str]]) -> Coverage:
    """Compare the rows of a run with its latest plan; a run is whole where that is absent.

    Args:
        provenance: Content of provenance.json.
        cases: Scenario, seed and variant of each row of results.csv.
    """
    plan, mistake = _read(provenance)
    if mistake:
        return Coverage(0, 0, mistake)
    planned = set() if plan is None else list_planned_cases(plan)
    missing = planned - set(cases)
    pairs = {(scenario, seed) for scenario, seed, _ in planned}
    return Coverage(len(pairs - {(scenario, seed) for scenario, seed, _ in missing}), len(pairs))


def read_stored_plan(provenance: Mapping[str, Any]) -> Plan | None:
    """Return the latest plan of a run; None where it is absent or not valid here (a preset's file is elsewhere)."""
    plan, _ = _read(provenance)
    return plan


def explain_unreadable_plan(provenance: Mapping[str, Any]) -> str:
    """Return why the plan of a run is not valid here, "" where it is, or where there is none."""
    return _read(provenance)[1]


def _read(provenance: Mapping[str, Any]) -> tuple[Plan | None, str]:
    document = provenance.get("plan")
    # of a run that stored no plan, or of others' methods alone (`eval.running.runner.start_provenance`)
    if not isinstance(document, dict) or "scenarios" not in document or document.get("variants") == []:
        return None, ""
    try:
        return validate(Plan, Document("provenance.json", document)), ""
    except InputError as error:
        return None, str(error).splitlines()[0]
