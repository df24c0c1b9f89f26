"""Whether the parts of a plan fit each other: all mistakes at once, each where it stands in the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from cdpipe.core.yamlfile import suggest
from eval.plans.variants import methods_of, slug
from eval.plans.worlds import ScenarioItem, group_of, world_slug, worlds_of

if TYPE_CHECKING:
    from eval.plans.plan import Plan

_TOO_LONG = "is too long for a folder's name: put the settings into a file of their own"
_LONGEST_SLUG = 200  # file systems take names of 255 bytes
_AFTER_MERGE = ("query", "extract", "outlier", "cluster", "m3c2", "dufomap")


class Mistake(NamedTuple):
    """One mistake of a plan: the keys that lead to it, what is written there, and the rule that it breaks."""

    where: tuple[str | int, ...]
    written: str
    rule: str


def refuse(mistakes: Iterable[Mistake]) -> None:
    """Raise pydantic's error about all mistakes, if there are any."""
    found = [
        InitErrorDetails(type=PydanticCustomError("plan", "{rule}", {"rule": rule}), loc=where, input=written)
        for where, written, rule in mistakes
    ]
    if found:
        raise ValidationError.from_exception_data("Plan", found)


def misfits(plan: Plan) -> list[Mistake]:
    """Return every mistake that only shows between the parts of a plan."""
    return [*_past_the_end(plan), *_unknown_worlds(plan), *_repeated_variants(plan)]


def repeated_worlds(items: Iterable[ScenarioItem]) -> Iterator[Mistake]:
    """Yield the worlds that are listed twice or cannot be a folder; places are counted from the first item."""
    known: set[object] = set()
    for place, item in enumerate(items):
        for index, world in enumerate(worlds_of([item])):
            folder = world_slug(world.label)
            names = {folder, (world.name, world.settings)}
            rule = _TOO_LONG if len(folder) > _LONGEST_SLUG else "is listed twice" if known & names else ""
            if rule:
                where = (place, "each", index - 1) if index else (place,)
                yield Mistake(where, ",".join(world.own) or world.name, f"scenario {world.label} {rule}")
            known |= names


def _past_the_end(plan: Plan) -> Iterator[Mistake]:
    if plan.until != "merge":
        return
    told = " and ".join(plan.report)
    if told:
        rule = f"report: {told} needs {told}, and the plan ends at the merge; leave one of them out"
        yield Mistake(("report",), told, rule)
    rule = "{} does nothing: the plan ends at the merge; leave it out, or leave out until"
    if plan.wide:
        yield Mistake(("wide",), ", ".join(plan.wide), rule.format("wide"))
    for place, variant in enumerate(plan.variants):
        for setting in variant.every_setting:
            if group_of(setting) in _AFTER_MERGE:
                yield Mistake(("variants", place), variant.preset, rule.format(f"{setting} of {variant.preset}"))
        if variant.oracle_regions:
            yield Mistake(("variants", place, "oracle_regions"), "true", rule.format("oracle_regions"))
    for place, grid in enumerate(plan.grid):
        for key in grid.keys:
            if group_of(key) in _AFTER_MERGE:
                yield Mistake(("grid", place, "keys", key), key, rule.format(f"{key} of the grid of {grid.variant}"))


def _unknown_worlds(plan: Plan) -> Iterator[Mistake]:
    worlds = worlds_of(plan.scenarios)
    labels = [world.label for world in worlds]
    for place, variant in enumerate(plan.variants):
        for index, name in enumerate(variant.scenarios):
            if name not in labels:
                rule = f"scenarios of {variant.preset} names {name!r}, which is no world of the plan"
                yield Mistake(("variants", place, "scenarios", index), name, rule + suggest(name, labels))
    known = dict.fromkeys(name for world in worlds for name in (world.name, world.label))
    asked: list[tuple[tuple[str | int, ...], str, str]] = [
        (("wide", index), "wide", name) for index, name in enumerate(plan.wide)
    ]
    for place, variant in enumerate(plan.variants):
        asked += [
            (("variants", place, "per_scenario", name), f"per_scenario of {variant.preset}", name)
            for name in variant.per_scenario
        ]
    for place, grid in enumerate(plan.grid):
        asked += [
            (("grid", place, "scenarios", index), f"the grid of {grid.variant}", name)
            for index, name in enumerate(grid.scenarios)
        ]
    for where, who, name in asked:
        if name not in known:
            yield Mistake(where, name, f"{who} names {name!r}, which is not in scenarios{suggest(name, known)}")


def _repeated_variants(plan: Plan) -> Iterator[Mistake]:
    told = set()
    for world in worlds_of(plan.scenarios):
        folders = Counter(slug(method.variant) for method in methods_of(plan, world))
        for folder, n in folders.items():
            if folder not in told and (n > 1 or len(folder) > _LONGEST_SLUG):
                told.add(folder)
                rule = f"stands twice in the plan for {world.label}" if n > 1 else _TOO_LONG
                yield Mistake(("variants",), folder, f"variant {folder} {rule}")
