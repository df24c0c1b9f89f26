"""The best, the median and the ten worst objects of a run, each drawn: the truth beside what was answered."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Int64Array
from cdpipe.io.answer import Answer, read_answer
from eval.report.objects.objects import Shown, change_panels, object_title
from eval.report.tables import Picture
from eval.running.run_data import Row, RunData, flag, number, of, split_variant, text
from eval.scoring.answer_rows import find_answer_rows
from eval.tables.columns import count, significant
from eval.truth.ground_truth import GroundTruth, load_ground_truth

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
    pairs: dict[tuple[str, int], _Opened | str] = {}
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

    Missed ones have an IoU of 0. Of equal ones the larger comes first among the worst, and among the best.
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
    """Return the variant with the paper's rule in a variant's place, if there is one."""
    names = dict.fromkeys(str(row["variant"]) for row in data.results)
    split = ((name, *split_variant(name)) for name in names)
    return [name for name, stem, settings in split if stem == variant and settings.get(VOXEL_RULE) == "voxel"][:1]


def why(data: RunData, row: Row) -> str:
    """Return why an object was missed, as far as the tables say; "" for one that was not."""
    if number(row, "matched_object") >= 0:
        return ""
    names = {name: row[name] for name in ("scenario", "seed", "variant")}
    cases = of(data.results, **names)
    if cases and text(cases[0], "status") != "ok":
        return f"no answer: {text(cases[0], 'status').replace('_', ' ')}"
    if flag(row, "is_found"):
        return "its region holds no object that overlaps it"
    wanted = str(int(number(row, "id")))
    regions = of(data.regions, **names)
    near = [region for region in regions if wanted in text(region, "found_changes").removesuffix(".0").split(";")]
    if any(flag(region, "is_withdrawn") for region in near):
        return "its region was withdrawn"
    return "its region was below the threshold" if near else "no candidate region finds it"


class _Opened:
    """A pair with the answers that are drawn."""

    def __init__(self, truth: GroundTruth, answers: dict[str, Answer]) -> None:
        self.truth = truth
        self.answers = answers
        self.rows: dict[str, Sequence[Int64Array]] = {
            name: find_answer_rows(answer, truth) for name, answer in answers.items()
        }


def _open(data: RunData, scenario: str, seed: int, shown: Sequence[str]) -> _Opened | str:
    """Open a pair, or say why it cannot be drawn."""
    try:
        truth = load_ground_truth(data.folder.pair(scenario, seed))
    except InputError:
        return f"The simulated pair {scenario}, seed {seed}, is not in the run folder: its objects are not drawn."
    answers = {}
    for name in shown:
        try:
            answer = read_answer(data.folder.answer(scenario, seed, name))
        except InputError:
            continue
        if answer.report is not None:
            answers[name] = answer
    return _Opened(truth, answers)


def _picture(data: RunData, words: str, row: Row, opened: _Opened, shown: Sequence[str]) -> Picture:
    change_id = int(number(row, "id"))
    index = next(place for place, change in enumerate(opened.truth.pair.changes) if change.id == change_id)
    scenario, seed = str(row["scenario"]), int(row["seed"])
    beside = []
    for place, name in enumerate(shown):
        rows = of(data.changes, scenario=scenario, seed=seed, variant=name, id=change_id)
        title = name if place == 0 else "voxel rule"
        beside.append(Shown(title, opened.answers.get(name), opened.rows.get(name, ()), rows[0] if rows else {}))
    change = opened.truth.pair.changes[index]
    address = change_panels(index, opened.truth, beside)
    reason = why(data, row)
    caption = (
        f"{scenario}, seed {seed}; {significant(change.hull_volume_m3)} m³, {count(change.n_returns)} returns from "
        f"{significant(number(row, 'range_m'))} m on"
    )
    return Picture(f"{words}: {object_title(change)}", address, f"{caption}{'; ' if reason else ''}{reason}")
