"""Distributions in a scenario's YAML, and their replacement by draws of the seed.

Every draw has its own generator, `stream(seed, "scenario", path)`. The path is the dotted key; an item of a list is
named by its `name`, or by its index if it has none. So no draw depends on any other key of the file.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

import numpy as np

from cdpipe.core.files import Key
from cdpipe.core.geometry import stream

NAMES = ("uniform", "normal", "integers", "choice")
_MOST_COPIES = 10_000
_WHOLE = 2**63  # whole numbers are drawn from this far below 0 to this far above, which is excluded


@dataclass(frozen=True, slots=True)
class Drawing:
    """A tree whose distributions were replaced.

    Attributes:
        value: The tree, of plain dicts, lists and scalars.
        origins: For every key path of `value`, the key path it comes from in the tree that was drawn from.
        broken: Key paths of `value` that are None because their distribution has no valid form.
    """

    value: Any
    origins: dict[Key, Key] = field(default_factory=dict)
    broken: set[Key] = field(default_factory=set)


def draw(tree: Any, seed: int) -> Drawing:
    """Replace every distribution of a tree by its draw, a malformed one by None, and write repeated items out."""
    drawer = _Drawer(seed)
    value = drawer.value(tree, (), (), ())
    return Drawing(value, drawer.origins, drawer.broken)


def find_malformed(tree: Any, key: Key = ()) -> dict[Key, str]:
    """Return the rule that each malformed distribution, `repeat`, `chance` or `one_of` breaks, by key path."""
    found: dict[Key, str] = {}
    if isinstance(tree, list):
        for index, item in enumerate(tree):
            found |= find_malformed(item, (*key, index))
            for name, rule_of in (("repeat", _repeat_rule), ("chance", _chance_rule)):
                if isinstance(item, dict) and name in item and (rule := rule_of(item[name])):
                    found[(*key, index, name)] = rule
    elif isinstance(tree, dict):
        if rule := _distribution_rule(tree):
            found[key] = rule
        elif "one_of" in tree and (rule := _one_of_rule(tree["one_of"])):
            found[(*key, "one_of")] = rule
        for name, item in tree.items():
            found |= find_malformed(item, (*key, name))
    return found


def is_distribution(tree: Any) -> bool:
    """Tell whether a value is a mapping that names a distribution, well-formed or not."""
    return isinstance(tree, dict) and any(name in tree for name in NAMES)


def merge_trees(base: Any, over: Any) -> Any:
    """Return `base` overwritten by `over`: mappings key by key, lists and distributions as a whole.

    What the options of a `one_of` in `over` give is left out of `base`: it would win over them.
    """
    if not (isinstance(base, dict) and isinstance(over, dict)) or is_distribution(base) or is_distribution(over):
        return over
    drawn = option_keys(over)
    kept = {key: item for key, item in base.items() if key not in drawn}
    return {**kept, **{key: merge_trees(kept[key], item) if key in kept else item for key, item in over.items()}}


def option_keys(tree: Mapping[Any, Any]) -> set[Any]:
    """Return the keys that the options of a mapping's `one_of` give, less those that stand beside it."""
    options = tree.get("one_of")
    if not isinstance(options, list):
        return set()
    return {key for option in options if isinstance(option, dict) for key in option} - set(tree)


def join_key(key: Key) -> str:
    """Return a key path as `a.b.0`."""
    return ".".join(str(part) for part in key)


class _Drawer:
    """Draws a tree: `source` is the key path of a value in the tree, `place` in the result, `path` names its stream."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.origins: dict[Key, Key] = {}
        self.broken: set[Key] = set()

    def value(self, tree: Any, source: Key, place: Key, path: tuple[str, ...]) -> Any:
        self.origins[place] = source
        if isinstance(tree, list):
            return self._list(tree, source, place, path)
        if not isinstance(tree, dict):
            return tree
        if _distribution_rule(tree):
            self.broken.add(place)
            return None
        if is_distribution(tree):
            return self._distribution(tree, source, place, path)
        return self._mapping(tree, source, place, path)

    def _generator(self, path: tuple[str, ...]) -> np.random.Generator:
        return stream(self.seed, "scenario", ".".join(path))

    def _distribution(self, tree: dict[str, Any], source: Key, place: Key, path: tuple[str, ...]) -> Any:
        ((name, argument),) = tree.items()
        generator = self._generator(path)
        if name == "choice":
            index = int(generator.integers(len(argument)))
            return self.value(argument[index], (*source, "choice", index), place, (*path, str(index)))
        if name == "integers":
            return int(generator.integers(*argument))
        return float(generator.uniform(*argument) if name == "uniform" else generator.normal(*argument))

    def _mapping(self, tree: dict[str, Any], source: Key, place: Key, path: tuple[str, ...], depth: int = 0) -> Any:
        options: Any = tree.get("one_of")
        chosen: Any = {}
        if options is not None and not _one_of_rule(options):
            # alternatives of alternatives are draws of their own
            index = int(self._generator((*path, *("one_of",) * (depth + 1))).integers(len(options)))
            option, origin = options[index], (*source, "one_of", index)
            if isinstance(option, dict) and not is_distribution(option) and not _distribution_rule(option):
                self.origins[place] = origin
                chosen = self._mapping(option, origin, place, path, depth + 1)
            else:
                chosen = self.value(option, origin, place, path)
        own = {
            key: self.value(item, (*source, key), (*place, key), (*path, str(key)))
            for key, item in tree.items()
            if key != "one_of"
        }
        self.origins[place] = source
        return merge_trees(chosen, own)

    def _list(self, items: list[Any], source: Key, place: Key, path: tuple[str, ...]) -> list[Any]:
        result: list[Any] = []
        for index, item in enumerate(items):
            for label, copy in self._copies(item, index, path):
                own_path = (*path, label)
                if isinstance(copy, dict) and "chance" in copy:
                    copy = {key: part for key, part in copy.items() if key != "chance"}  # noqa: PLW2901 - narrowed here
                    rule = _chance_rule(item["chance"])
                    if not rule and self._generator((*own_path, "chance")).random() >= item["chance"]:
                        continue
                result.append(self.value(copy, (*source, index), (*place, len(result)), own_path))
        return result

    def _copies(self, item: Any, index: int, path: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        """Yield the stream label and the content of each copy of a list item."""
        name = item.get("name") if isinstance(item, dict) else None
        label = name if isinstance(name, str) else str(index)
        if not isinstance(item, dict) or "repeat" not in item:
            yield label, item
            return
        repeat = item["repeat"]
        if isinstance(repeat, dict) and not _repeat_rule(repeat):
            repeat = self._distribution(repeat, (), ("repeat",), (*path, label, "repeat"))
        once = {key: part for key, part in item.items() if key != "repeat"}
        for number in range(1, 2 if _repeat_rule(repeat) else repeat + 1):
            named = {"name": f"{name}-{number}"} if isinstance(name, str) else {}
            yield f"{label}-{number}", {**once, **named}


def _distribution_rule(tree: dict[str, Any]) -> str:
    """Return the rule that a mapping breaks which is, or seems meant as, a distribution; "" if it breaks none."""
    named = [name for name in NAMES if name in tree]
    if not named:
        (key, *others) = tree or [""]
        close = get_close_matches(str(key), NAMES, n=1, cutoff=0.75)
        is_misspelt = bool(close) and not others and isinstance(tree[key], list)
        return f'unknown distribution; did you mean "{close[0]}"?' if is_misspelt else ""
    if len(tree) > 1:
        return f"a distribution has one key, one of {', '.join(NAMES)}; got {', '.join(map(str, tree))}"
    form, is_valid = _FORMS[named[0]]
    return "" if is_valid(tree[named[0]]) else f"expected {named[0]}: {form}"


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _is_range(value: Any) -> bool:
    return _is_pair(value) and all(isinstance(part, int) for part in value) and -_WHOLE <= value[0] < value[1] <= _WHOLE


_FORMS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "uniform": (
        "[a, b] with a <= b and b - a finite",
        lambda value: _is_pair(value) and 0 <= float(value[1]) - float(value[0]) < math.inf,
    ),
    "normal": ("[mean, sigma] with sigma >= 0", lambda value: _is_pair(value) and value[1] >= 0),
    "integers": ("[a, b] with whole a < b, b excluded, within 64 bits", _is_range),
    "choice": ("[..] with at least one alternative", lambda value: isinstance(value, list) and len(value) > 0),
}


def _repeat_rule(repeat: Any) -> str:
    if isinstance(repeat, dict) and len(repeat) == 1 and not _distribution_rule(repeat):
        ((name, argument),) = repeat.items()
        bounds = [argument[0], argument[1] - 1] if name == "integers" else [None]
        return next((rule for rule in map(_repeat_rule, argument if name == "choice" else bounds) if rule), "")
    is_count = isinstance(repeat, int) and not isinstance(repeat, bool) and 0 <= repeat <= _MOST_COPIES
    return "" if is_count else f"expected a whole number from 0 to {_MOST_COPIES}, or integers or choice of such"


def _chance_rule(chance: Any) -> str:
    return "" if _is_number(chance) and 0 <= chance <= 1 else "expected a number from 0 to 1"


def _one_of_rule(options: Any) -> str:
    is_valid = isinstance(options, list) and options and all(isinstance(option, dict) for option in options)
    return "" if is_valid else "expected a list of mappings, one of which is drawn and merged into this one"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
