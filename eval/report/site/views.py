"""Which pairs get a 3-D view of their own, and where the page may link to one.

A view holds every map point and weighs megabytes, so the first pair of each scenario and the ten worst pairs get one
unless all are asked for. A link stands on the page only where its file does.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from cdpipe.core.errors import InputError
from eval.report.site.case_view import view_file, write_case_view
from eval.running.results.cases import first_seed, rows_of_case, scenarios
from eval.running.results.run_data import RunData
from eval.running.results.values import select_rows

Views = Literal["none", "chosen", "all"]
HOW_TO_GET = "3-D views of single pairs need the extra view: pip install 'tunnelcd[view]', then write this page again."
NOT_ASKED = "3-D views of single pairs are left out of this copy; `tunnelcd report` writes them into the run folder."


@dataclass(frozen=True, slots=True, eq=False)
class ViewLinks:
    """The 3-D views of a page.

    Attributes:
        links: (scenario, seed) -> the address of its file, relative to the page.
        note: Why there is none, or "".
        missing: What could not be shown, a line each.
    """

    links: Mapping[tuple[str, int], str]
    note: str
    missing: tuple[str, ...]

    def of(self, scenario: str, seed: int) -> str:
        """Return the address of a pair's view, "" where it has none."""
        return self.links.get((scenario, seed), "")


def write_views(data: RunData, variant: str, worst: Sequence[tuple[str, int]], views: Views = "chosen") -> ViewLinks:
    """Write the views of the first pair of each scenario and of some others, and return where they lie.

    Args:
        data: A run; pairs that are no longer in its folder are left out.
        variant: Whose answers are shown.
        worst: (scenario, seed) of the others.
        views: "none" writes and links nothing, "all" takes every pair.
    """
    if views == "none":
        return ViewLinks({}, NOT_ASKED, ())
    if importlib.util.find_spec("viser") is None:
        return ViewLinks({}, HOW_TO_GET, ())
    names = [*scenarios(data, unchanged=False), *scenarios(data, unchanged=True)]
    chosen = [*((name, first_seed(data, name)) for name in names), *worst]
    if views == "all":
        chosen += [(str(row["scenario"]), int(row["seed"])) for row in data.results]
    links, missing = {}, []
    for scenario, seed in dict.fromkeys(chosen):
        is_run = select_rows(data.results, scenario=scenario, seed=seed, variant=variant)
        if not (data.folder.pair(scenario, seed) / "truth").is_dir() or not is_run:
            continue
        try:
            write_case_view(data.folder, (scenario, seed), variant, rows_of_case(data, scenario, seed, variant))
        except (InputError, KeyError) as error:
            missing.append(f"No 3-D view: {error}.")
            continue
        links[scenario, seed] = view_file(data.folder, scenario, seed).relative_to(data.folder.path).as_posix()
    note = "" if links else "No pair with its truth and maps is in the run folder, so there is no 3-D view."
    return ViewLinks(links, note, tuple(missing))
