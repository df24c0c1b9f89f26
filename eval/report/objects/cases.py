"""The best, the median and the ten worst objects of a run, each drawn: the truth beside what was answered."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

from cdpipe.core.errors import InputError
from cdpipe.io.answer import read_answer
from eval.report.objects.objects import AnsweredPair, object_title
from eval.report.tables import Picture
from eval.running.results.grids import split_variant
from eval.running.results.run_data import RunData
from eval.running.results.values import Row, flag, number, select_rows, text
from eval.tables.columns import count, significant
from eval.truth.ground_truth import load_ground_truth

N_WORST = 10
VOXEL_RULE = "extract.method"


def object_cases(data: RunData, variant: str) -> tuple[list[Picture], list[str]]:
    """Return pictures of the best, the median and the worst objects of a variant, and what could not be drawn.

    Args:
        data: A run.
        variant: Whose objects; beside it stands the paper's rule at the same regions, where the run has it.
    """
    chosen = chosen_cases([row for row in data.changes if row.get("variant") == variant])
    shown = [variant, *voxel_variants(data, variant)]
    pairs: dict[tuple[str, int], AnsweredPair | str] = {}
    pictures, missing = [], []
    for words, row in chosen:
        scenario, seed = str(row["scenario"]), int(row["seed"])
        if (scenario, seed) not in pairs:
            pairs[scenario, seed] = _open(data, scenario, seed, shown)
        opened = pairs[scenario, seed]
        if isinstance(opened, str):
            missing.append(opened)
        else:
            pictures.append(_picture(data, words, row, opened, shown))
    return pictures, list(dict.fromkeys(missing))


def chosen_cases(rows: Sequence[Row]) -> list[tuple[str, Row]]:
    """Return the best, the median and the ten worst observable changes of the main group, none twice.

    Missed changes have an IoU of 0. Of changes with equal IoU the larger one comes first.
    """
    main = [row for row in rows if text(row, "group") == "full" and not math.isnan(number(row, "iou_point"))]
    ranked = sorted(main, key=lambda row: (number(row, "iou_point"), -number(row, "n_truth_cells")))
    if not ranked:
        return []
    top = number(ranked[-1], "iou_point")
    best = next(row for row in ranked if number(row, "iou_point") == top)
    middle = ranked[len(ranked) // 2]
    found = [("Best", best)] + ([("Median", middle)] if middle is not best else [])
    worst = [row for row in ranked if row is not best and row is not middle][:N_WORST]
    return found + [(f"Worst {place}", row) for place, row in enumerate(worst, start=1)]


def voxel_variants(data: RunData, variant: str) -> list[str]:
    """Return the variant that differs from a variant by the paper's extraction rule, if it was run."""
    names = dict.fromkeys(str(row["variant"]) for row in data.results)
    split = ((name, *split_variant(name)) for name in names)
    return [name for name, stem, settings in split if stem == variant and settings.get(VOXEL_RULE) == "voxel"][:1]


def why(data: RunData, row: Row) -> str:
    """Return why an object was missed, as far as the tables say; "" for one that was not."""
    if number(row, "matched_object") >= 0:
        return ""
    names = {name: row[name] for name in ("scenario", "seed", "variant")}
    cases = select_rows(data.results, **names)
    if cases and text(cases[0], "status") != "ok":
        return f"no answer: {text(cases[0], 'status').replace('_', ' ')}"
    if flag(row, "is_found"):
        return "its region holds no object that overlaps it"
    wanted = str(int(number(row, "id")))
    regions = select_rows(data.regions, **names)
    near = [region for region in regions if wanted in text(region, "found_changes").removesuffix(".0").split(";")]
    if any(flag(region, "is_withdrawn") for region in near):
        return "its region was withdrawn"
    return "its region was below the threshold" if near else "no candidate region finds it"


def _open(data: RunData, scenario: str, seed: int, shown: Sequence[str]) -> AnsweredPair | str:
    """Open a pair, or say why it cannot be drawn."""
    try:
        truth = load_ground_truth(data.folder.pair(scenario, seed))
    except InputError:
        return f"The simulated pair {scenario}, seed {seed}, is not in the run folder: its objects are not drawn."
    answers = {}
    for name in shown:
        with suppress(InputError):
            answers[name] = read_answer(data.folder.answer(scenario, seed, name))
    return AnsweredPair(data, (scenario, seed), truth, answers)


def _picture(data: RunData, words: str, row: Row, pair: AnsweredPair, shown: Sequence[str]) -> Picture:
    changes = pair.truth.pair.changes
    index = [change.id for change in changes].index(int(number(row, "id")))
    change, reason = changes[index], why(data, row)
    titles = {name: "voxel rule" if place else name for place, name in enumerate(shown)}
    seen_from = f"{count(change.n_returns)} returns from {significant(number(row, 'range_m'))} m on"
    caption = (
        f"{row['scenario']}, seed {int(row['seed'])}; {significant(change.hull_volume_m3)} m³, "
        f"{seen_from}{'; ' if reason else ''}{reason}"
    )
    return Picture(f"{words}: {object_title(change)}", pair.draw(index, titles), caption)
