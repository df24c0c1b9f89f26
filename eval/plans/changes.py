"""Changes of a plan by the options --seeds, --split, --preset, --set and --grid."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from cdpipe.core.errors import InputError
from cdpipe.core.files import parse_yaml_value
from cdpipe.core.yamlfile import Document, validate
from eval.plans.parts import get_key, has_effect_on_true_regions, require_valid_setting, require_valid_settings
from eval.plans.plan import Plan
from eval.plans.seeds import parse_seeds
from eval.plans.splits import seal_seeds, sealed_by
from eval.plans.worlds import get_group


def change_plan(
    plan: Plan,
    *,
    seeds: str | None = None,
    split: str = "dev",
    presets: Sequence[str] = (),
    settings: Sequence[str] = (),
    grid: Sequence[str] = (),
) -> Plan:
    """Return the plan with the options --seeds, --split, --preset, --set and --grid applied.

    Args:
        plan: The plan.
        seeds: "A:B", replaces the plan's seeds.
        split: `sealed` replaces each seed of the plan, a seed of `dev`, by a sealed one of this version;
            `sealed:0.1.0` by one of that version.
        presets: Names or files, replace the plan's variants, its own grids, thresholds and targets. A variant that is
            a preset alone keeps what the plan sets for it by scenario.
        settings: `key=value`, written over every variant and every grid point.
        grid: `key=v1,v2`; every variant runs at every combination. The plan's own grids stay. Variants merged by the
            truth get neither settings nor grids of `merge`; variants with regions from the truth get none of `query`
            except radius and suppression.

    Raises:
        InputError: An option is malformed, or its key or value is wrong.
    """
    _refuse_mistakes(seeds, settings, grid)
    axes = [_read_axis(text) for text in grid]
    document = plan.model_dump(mode="json")
    if seeds is not None:
        document["seeds"] = parse_seeds(seeds)
    if version := sealed_by(split):
        try:
            document |= {"seeds": seal_seeds(document["seeds"], version), "split": f"sealed by {version}"}
        except ValueError as error:
            raise InputError(f"--split {split}: plan {plan.name}: {error}") from error
    if presets:
        document |= {"variants": [_find_variant(document["variants"], name) for name in presets]}
        document |= {"grid": [], "targets": {}, "thresholds": {}}
    if document.get("thresholds") and (settings or grid):
        raise InputError(
            f"{'--set' if settings else '--grid'}: plan {plan.name} holds a threshold for each of its methods, which "
            "other settings make wrong: copy the plan, and change it there"
        )
    overridden = {get_key(setting) for setting in (*settings, *itertools.chain(*axes))}
    document["variants"] = [
        {
            **variant,
            "set": [*_drop_settings(variant["set"], overridden), *added],
            "per_scenario": {name: _drop_settings(own, overridden) for name, own in variant["per_scenario"].items()},
        }
        for variant in document["variants"]
        for added in _list_additions(variant, axes, settings)
    ]
    for each in document["grid"]:
        each["keys"].update({get_key(setting): [parse_yaml_value(setting.partition("=")[2])] for setting in settings})
        if "each" in each:
            kept = dict.fromkeys(tuple(_drop_settings(listed, overridden)) for listed in each["each"])
            each["each"] = [list(listed) for listed in kept]
    return validate(Plan, Document(f"plan {plan.name} with the settings of the command line", document))


def _find_variant(variants: Sequence[Mapping[str, Any]], preset: str) -> Mapping[str, Any]:
    """Return the variant of a plan that is this preset alone, or a new one."""
    name = os.path.realpath(preset) if preset.endswith((".yaml", ".yml")) else preset
    plain = [each for each in variants if each["preset"] == name and not each["set"] and "oracle_merge" not in each]
    alone = [each for each in plain if not each.get("oracle_regions")]
    return alone[0] if alone else {"preset": name, "set": [], "per_scenario": {}}


def _list_additions(
    variant: Mapping[str, Any], axes: Sequence[Sequence[str]], settings: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return the settings that the options add to a variant, one tuple for each copy of it."""
    if "oracle_merge" in variant:
        axes = [axis for axis in axes if get_group(axis[0]) != "merge"]
        settings = [setting for setting in settings if get_group(setting) != "merge"]
    if variant.get("oracle_regions"):
        axes = [axis for axis in axes if has_effect_on_true_regions(axis[0])]
        settings = [setting for setting in settings if has_effect_on_true_regions(setting)]
    return [(*point, *settings) for point in itertools.product(*axes)]


def _refuse_mistakes(seeds: str | None, settings: Sequence[str], grid: Sequence[str]) -> None:
    """Check every option and raise all mistakes at once."""
    axes = [get_key(text) for text in grid if "=" in text]
    keys = [*axes, *{get_key(setting) for setting in settings}]
    mistakes = [
        f"--grid {key}: set twice, by another --grid or by --set: leave one of them out"
        for key in dict.fromkeys(axes)
        if keys.count(key) > 1
    ]
    options: list[tuple[str, Callable[[str], object], Sequence[str]]] = [
        ("--seeds", parse_seeds, [] if seeds is None else [seeds]),
        ("--set", require_valid_setting, settings),
        ("--grid", _check_axis, grid),
    ]
    for option, check, texts in options:
        for text in texts:
            try:
                check(text)
            except ValueError as error:
                mistakes.append(f"{option} {text}: {error}")
    if mistakes:
        raise InputError("\n".join(mistakes))


def _check_axis(text: str) -> None:
    key, equals, values = text.partition("=")
    if not equals or not key or not all(values.split(",")):
        raise ValueError("expected key=v1,v2, e.g. extract.voxel_m=0.2,0.4")
    require_valid_settings(_read_axis(text))


def _read_axis(text: str) -> list[str]:
    key, _, values = text.partition("=")
    return [f"{key}={value}" for value in values.split(",")]


def _drop_settings(settings: Iterable[str], keys: set[str]) -> list[str]:
    return [setting for setting in settings if get_key(setting) not in keys]
