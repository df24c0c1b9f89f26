"""The two sides of a comparison: their runs, matching rows, and rows that only one side has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.yamlfile import suggest
from eval.plans.cells import list_planned_cases
from eval.plans.coverage import read_stored_plan
from eval.running.results.run_data import RunData, covered_by, read_run
from eval.running.results.values import Row, flag
from eval.scoring.scoring import METRICS_VERSION
from eval.tables.rows import PAIR

_MAX_NAMED = 6
# figures that depend on the pair alone, not on the answer: changes, path, what a region must reach, rock that moved
_OF_THE_WORLD = (
    "n_changes", "n_observable", "after_path_m", "score_radius_m", "overlap_true", "n_surface_places",
    "n_surface_changes",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One side of a comparison: its run, and the only variant that is compared, "" for all of them."""

    data: RunData
    variant: str = ""

    @property
    def path(self) -> Path:
        """Folder of its run."""
        return self.data.folder.path

    @property
    def name(self) -> str:
        """Its folder, and the variant if there is only one."""
        return f"{self.path}:{self.variant}" if self.variant else str(self.path)

    @property
    def results(self) -> pd.DataFrame:
        """Its rows of results.csv that are compared."""
        rows = [row for row in self.data.results if not self.variant or row["variant"] == self.variant]
        return pd.DataFrame(rows)


def read_side(text: str) -> Side:
    """Read a side written as `RUN` or `RUN:VARIANT`.

    Raises:
        InputError: There is no such run folder, it has no results, or no such variant.
    """
    folder, variant = Path(text), ""
    if not folder.is_dir():
        ends = [place for place, letter in enumerate(text) if letter == ":"]
        found = [place for place in ends if Path(text[:place]).is_dir()]
        if not found:
            raise InputError(f"{text}: no such run folder: expected RUN or RUN:VARIANT")
        folder, variant = Path(text[: found[0]]), text[found[0] + 1 :]
    data = read_run(folder)
    known = list(dict.fromkeys(str(row["variant"]) for row in data.results))
    if variant and variant not in known:
        raise InputError(f"{folder}: no variant {variant}{suggest(variant, known) or ':'} it has {', '.join(known)}")
    return Side(data, variant)


def check_versions(a: Side, b: Side) -> None:
    """Refuse sides that were scored by different metrics versions.

    Raises:
        InputError: The versions differ between the sides or within one.
    """
    found = {side.path: list_versions(side.data.results) for side in (a, b)}
    if len(set().union(*found.values())) <= 1:
        return
    told = " and ".join(f"{path}: metrics version {' and '.join(sorted(each))}" for path, each in found.items())
    ways = "; ".join(_mending(path) for path, each in found.items() if each != {str(METRICS_VERSION)})
    raise InputError(f"{told}: their columns do not mean the same: {ways}")


def check_extras(side: Side) -> None:
    """Refuse a run in which an optional package answered for some rows of a method and not, or otherwise, for others.

    What the answers of other programs say of their packages is their own statement, and stops no page.

    Raises:
        InputError: Rows of one variant depend on two versions of a package, or on one that some of them lacked.
    """
    found: dict[tuple[str, str], set[str]] = {}
    rows = (row for row in side.data.results if side.variant in ("", row["variant"]))
    for row in rows:
        told = row.get("extras")  # rows of older runs and of other programs do not say
        for used in filter(None, told.split(";") if isinstance(told, str) else ()):
            name, _, version = used.partition(" ")
            found.setdefault((str(row["variant"]), name), set()).add(version)
    mixed = {key: versions for key, versions in found.items() if len(versions) > 1}
    plan = read_stored_plan(side.data.provenance) if mixed else None
    ours = None if plan is None else {variant for _, _, variant in list_planned_cases(plan)}
    for (variant, name), versions in mixed.items():
        if ours is None or variant in ours:
            raise InputError(
                f"{side.path}: rows of {variant} are of {name} {' and '.join(sorted(versions))}: make them "
                "all with one of them"
            )


def matched_variants(a: Side, b: Side) -> list[tuple[str, str]]:
    """Return pairs of variants (of A, of B) to compare; a variant that a side names is compared with all others."""
    names = [list(dict.fromkeys(str(row["variant"]) for row in side.data.results)) for side in (a, b)]
    if a.variant and b.variant:
        return [(a.variant, b.variant)]
    if a.variant or b.variant:
        fixed, others = (a.variant, names[1]) if a.variant else (b.variant, names[0])
        others = [name for name in others if name != fixed or not is_one_run(a, b)]
        return [(fixed, name) if a.variant else (name, fixed) for name in others]
    return [(name, name) for name in names[1] if name in names[0]]


def is_one_run(a: Side, b: Side) -> bool:
    """Tell whether both sides are of the same run."""
    return a.path.resolve() == b.path.resolve()


def only_in(own: Side, other: Side) -> list[str]:
    """Return the variants, scenarios and pairs that `own` has and `other` lacks, named and counted."""
    cases, others = _cases(own, other), _cases(other, own)
    missing = cases - others
    variants, scenarios = {case[2] for case in others}, {case[0] for case in others}
    of_variant = Counter(case[2] for case in missing if case[2] not in variants)
    missing = {case for case in missing if case[2] in variants}
    of_scenario = Counter(case[0] for case in missing if case[0] not in scenarios)
    seeds: dict[tuple[str, str], list[int]] = {}
    for scenario, seed, variant in sorted(case for case in missing if case[0] in scenarios):
        seeds.setdefault((scenario, variant), []).append(seed)
    sharing: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for (scenario, variant), own_seeds in seeds.items():
        sharing.setdefault((scenario, tuple(own_seeds)), []).append(variant)
    return [
        *(f"variant {name}: {_rows(n)}" for name, n in sorted(of_variant.items())),
        *(f"scenario {name}: {_rows(n)}" for name, n in sorted(of_scenario.items())),
        *(
            f"{scenario}, seed {_ranges(numbers)}{_of_variants(names)}: {_rows(len(numbers) * len(names))}"
            for (scenario, numbers), names in sharing.items()
        ),
    ]


def short_names(a: Side, b: Side) -> tuple[str, str]:
    """Return short names of both sides: the folders' names where they differ or the run is the same, else the paths."""
    paths = [side.path.resolve() for side in (a, b)]
    is_short = paths[0] == paths[1] or paths[0].name != paths[1].name
    names = [path.name if is_short else str(side.path) for path, side in zip(paths, (a, b), strict=True)]
    first, second = (
        f"{name}:{side.variant}" if side.variant else name for name, side in zip(names, (a, b), strict=True)
    )
    return first, second


def is_one_machine(a: Side, b: Side) -> bool:
    """Tell whether both runs record the same machine and the same threads."""
    machines = [side.data.provenance.get("machine") for side in (a, b)]
    return bool(machines[0]) and machines[0] == machines[1]


def is_contended(data: RunData) -> bool:
    """Tell whether any case of a run was timed while workers shared the machine."""
    return any(flag(row, "is_contended") for row in data.results)


def why_no_times(a: Side, b: Side) -> str:
    """Return why the times of two sides cannot be compared, "" where they can."""
    if not is_one_machine(a, b):
        return "the runs are of different machines, or one does not say of which"
    names = dict.fromkeys(side.path.resolve().name for side in (a, b) if is_contended(side.data))
    return f"those of {' and '.join(names)} were measured beside other work" if names else ""


def cautions(a: Side, b: Side) -> list[str]:
    """Return the reasons against comparing two sides, one sentence each."""
    found = []
    if (worlds := other_worlds(a, b)) and not is_one_run(a, b):
        named = ", ".join(worlds[:_MAX_NAMED]) + (" and others" if len(worlds) > _MAX_NAMED else "")
        told = "1 shared pair holds" if len(worlds) == 1 else f"{len(worlds)} shared pairs hold"
        found.append(f"{told} other changes, another drive or another score radius on the two sides ({named}).")
    if why := why_no_times(a, b):
        found.append(f"Times are not judged: {why}.")
    for side in {each.path: each for each in (a, b)}.values():
        found += side.data.left_out
        covered = covered_by(side.data)
        if not covered.is_whole:
            found.append(
                f"{side.path.resolve().name} is not finished: {covered.n_done} of {covered.n_planned} planned pairs."
            )
    return found


def other_worlds(a: Side, b: Side) -> list[str]:
    """Return the shared pairs that ask for other things (`_OF_THE_WORLD`): the seed drew another world."""
    return find_other_worlds(a.results, b.results)


def find_other_worlds(a: pd.DataFrame, b: pd.DataFrame) -> list[str]:
    """Return the pairs that rows of results.csv share, and that ask for other things (`_OF_THE_WORLD`)."""
    found = []
    worlds = [results.groupby(PAIR) for results in (a, b)]
    for key in _OF_THE_WORLD:
        if key not in a or key not in b:
            continue
        first, second = (pd.to_numeric(group[key].first(), errors="coerce").astype(float) for group in worlds)
        first, second = first.align(second, join="inner")
        differs = (first - second).abs() > 1e-6 * first.abs().clip(lower=1.0)
        found += [f"{scenario} {number}" for scenario, number in first.index[differs]]
    return list(dict.fromkeys(found))


def list_versions(rows: Iterable[Row]) -> set[str]:
    """Return the metrics versions of some rows of results.csv."""
    values = {row.get("metrics_version") for row in rows}
    return {"unknown" if value is None or pd.isna(value) else f"{float(value):g}" for value in values}


def _mending(path: Path) -> str:
    has_truth = (path / "pairs").is_dir() or (path / "dropped").is_dir()
    if any((path / "answers").glob("*/*/*/answer.json")) and has_truth:
        return f"`tunnelcd score {path}` scores it again"
    return f"{path} holds no answers and truths to score again: run its plan again"


def _cases(own: Side, other: Side) -> set[tuple[str, int, str]]:
    """Return (scenario, seed, variant) of the rows; no variant where either side has but one."""
    is_named = not own.variant and not other.variant
    return {
        (str(row["scenario"]), int(row["seed"]), str(row["variant"]) if is_named else "")
        for row in own.data.results
        if not own.variant or row["variant"] == own.variant
    }


def _of_variants(names: Sequence[str]) -> str:
    return f" of {', '.join(names)}" if any(names) else ""


def _rows(n: int) -> str:
    return "1 row" if n == 1 else f"{n} rows"


def _ranges(seeds: Sequence[int]) -> str:
    """Write rising numbers with ranges: 3, 5-7."""
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and seed == runs[-1][1] + 1:
            runs[-1][1] = seed
        else:
            runs.append([seed, seed])
    return ", ".join(f"{first}" if first == last else f"{first}-{last}" for first, last in runs)
