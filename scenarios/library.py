"""Scenarios by name or file: read, merged with what they extend, drawn with a seed, and checked."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Any

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.files import Key
from cdpipe.core.geometry import stream
from cdpipe.core.names import visible
from cdpipe.core.yamlfile import Document, apply_settings, read_yaml, suggest, validate
from scenarios.catalogue import family_files, family_of, prop_files, prop_names, read_prop
from scenarios.dangling import Mistake, find_dangling, items_at, mapping_at
from scenarios.distributions import NAMES, draw, find_malformed, is_distribution, join_key, merge_trees, option_keys
from scenarios.grafted import GraftScenario, take_props
from scenarios.references import file_keys, find_contradictions
from scenarios.schema import PROP_KINDS, Prop, Scenario, source_of

CHECKED_SEEDS = range(8)
_READ: ContextVar[dict[tuple[str, tuple[str, ...]], Document] | None] = ContextVar("read", default=None)
SUFFIXES = (".yaml", ".yml")
# A part of the scenario, or of a session, and what is wrong with it: value and rule.
_OF_SCENARIO = re.compile(r": (sensor|platform)\.[\w.]+( = .*)")
_OF_SESSION = re.compile(r": (?:before|after)\.(sensor|platform)( = .*)")
_ITEM = re.compile(r"\b[a-z_]+\.\d+\b")


def load_scenario(name_or_path: str, seed: int, settings: Iterable[str] = ()) -> Scenario:
    """Return a scenario as its seed draws it.

    Args:
        name_or_path: A name of `scenario_names()`, or a YAML file.
        seed: Not negative.
        settings: `a.b=value` pairs written over the file before anything is drawn.

    Raises:
        ScenarioError: The name is unknown, or the file has mistakes: one line each.
        InputError: The file cannot be read, a setting has no valid form, or the seed is negative.
    """
    if seed < 0:
        raise InputError(f"seed = {seed}: expected a whole number >= 0")
    scenario, mistakes = _draw_scenario(_read(name_or_path, settings), seed)
    return _require_valid(scenario, mistakes)


def load_grafted(name_or_path: str, recording: Mapping[str, Any], seed: int) -> GraftScenario:
    """Return the props of a scenario as its seed draws them, to be grafted into a recording.

    Args:
        name_or_path: A name of `scenario_names()`, or a YAML file; "none" for no props. Of a scenario with a tunnel
            only the props count, without their places.
        recording: Values of `Recording`; paths as seen from the working folder.
        seed: Not negative.

    Raises:
        ScenarioError, InputError: As `load_scenario`; or the file names a recording of its own.
    """
    document = Document(name_or_path, {"family": "graft"}) if name_or_path == "none" else _read(name_or_path, ())
    tree = take_props(document.value) if mapping_at(document.value, "tunnel") else document.value
    if "recording" in tree:
        where = document.where(("recording",))
        raise ScenarioError(f"{where}: recording: the file names its own: `tunnelcd simulate` takes such a file")
    origins = {**document.origins, ("recording",): "the command line"}
    given = replace(document, value={**tree, "recording": dict(recording)}, origins=origins)
    scenario = _require_valid(*_draw_scenario(given, seed))
    assert isinstance(scenario, GraftScenario)  # a tree with a recording is one
    return scenario


def check_scenario(name_or_path: str, settings: Iterable[str] = ()) -> Scenario:
    """Check a scenario for several seeds without simulating it, and return it as seed 0 draws it.

    Args:
        name_or_path: A name of `scenario_names()`, or a YAML file.
        settings: `a.b=value` pairs written over the file before anything is drawn.

    Raises:
        ScenarioError: The name is unknown, or the file has mistakes; each is reported once for all seeds.
        InputError: The file cannot be read, or a setting has no valid form.
    """
    document = _read(name_or_path, settings)
    first, mistakes = _draw_scenario(document, CHECKED_SEEDS[0])
    for seed in CHECKED_SEEDS[1:]:
        told = {_key_of(line) for line in mistakes}
        mistakes += [line for line in _draw_scenario(document, seed)[1] if _key_of(line) not in told]
    return _require_valid(first, mistakes)


def _require_valid(scenario: Scenario | None, mistakes: list[str]) -> Scenario:
    if scenario is None or mistakes:
        raise ScenarioError("\n".join(sorted(mistakes, key=_line_of)))
    return scenario


def _draw_scenario(document: Document, seed: int) -> tuple[Scenario | None, list[str]]:
    """Draw a scenario, and return it with every mistake found; None if it does not fit the schema."""
    if word := next((name for name in NAMES if name in document.value), ""):
        rule = "a distribution stands in place of a value, not among the keys of a scenario: give it a key"
        return None, [_format_mistake(document, (word,), rule)]
    mistakes = [_format_mistake(document, key, rule) for key, rule in find_malformed(document.value).items()]
    drawn = draw(document.value, seed)
    tree = dict(drawn.value)
    is_frozen = tree.pop("frozen", False)
    if not isinstance(is_frozen, bool):
        mistakes.append(_format_mistake(document, ("frozen",), "expected true or false"))
    turnover = tree.pop("turnover", 0.0)
    if isinstance(turnover, bool) or not isinstance(turnover, int | float) or not 0 <= turnover <= 1:
        mistakes.append(_format_mistake(document, ("turnover",), "expected a share between 0 and 1"))
        turnover = 0.0
    place = Document(document.source, tree, {key: document.where(source) for key, source in drawn.origins.items()})
    tree, unknown = _resolve_props(place)
    tree, missing = _resolve_files(replace(place, value=tree))
    mistakes += missing
    references = find_dangling(tree) + unknown
    mistakes += [_format_mistake(place, key, rule) for key, rule in references]
    try:
        scenario = validate(GraftScenario if "recording" in tree else Scenario, replace(place, value=tree))
    except InputError as error:
        mistakes += _drop_inherited(_drop_repeated(str(error).splitlines(), drawn.broken, references))
        return None, _tell_copies_once(mistakes, drawn.origins)
    mistakes += [_format_mistake(place, key, rule) for key, rule in find_contradictions(scenario)]
    mistakes = _tell_copies_once(mistakes, drawn.origins)
    return _freeze(scenario) if is_frozen else _turn_over(scenario, turnover, seed), mistakes


def _freeze(scenario: Scenario) -> Scenario:
    """Return the scenario without its changes: the world stays as in the before session."""
    stay = {"change": "none", "to": None, "shift": None, "loaded_share": None}  # age is no change
    props = tuple(prop.model_copy(update=stay) for prop in scenario.props if prop.change != "added")
    return scenario.model_copy(update={"props": props, "surface": ()})


def _turn_over(scenario: Scenario, turnover: float, seed: int) -> Scenario:
    """Return the scenario with this share of its unchanged props added or removed instead, in equal parts."""
    props: list[Prop] = []
    for prop in scenario.props:
        number = stream(seed, "turnover", prop.name).random()
        is_turned = prop.change == "none" and prop.aged is None and number < turnover
        update = {"change": "added" if number < turnover / 2 else "removed"} if is_turned else {}
        props.append(prop.model_copy(update=update))
    return scenario.model_copy(update={"props": tuple(props)})


def _resolve_props(document: Document) -> tuple[dict[Any, Any], list[Mistake]]:
    """Return the tree with the mesh of every prop whose kind is on the search path, and the kinds that are nowhere."""
    unknown: list[Mistake] = []
    tree, files = document.value, prop_files()
    for index, prop in enumerate(items_at(tree, "props")):
        kind = prop.get("kind") if isinstance(prop, dict) else None
        if not isinstance(kind, str) or kind in PROP_KINDS:
            continue
        if kind in files:
            tree = _replace_at(tree, ("props", index), read_prop(kind).model_dump(exclude_none=True) | prop)
        else:
            hint = suggest(kind, prop_names()) or f"; known are {', '.join(prop_names())}"
            unknown.append((("props", index, "kind"), f"no prop is called {kind}{hint}"))
    return tree, unknown


def _resolve_files(document: Document) -> tuple[dict[Any, Any], list[str]]:
    """Return the tree with every file's path as seen from the working folder, and the files that are missing.

    A relative path starts at the file that holds its key, one given by --set at the working folder.
    """
    tree, missing = document.value, []
    for key, name in file_keys(document.value):
        holder, colon, line = document.where(key).rpartition(":")
        path = Path(holder).parent / name if colon and line.isdigit() else Path(name)
        if not _is_there(path, may_be_folder=key[:2] == ("recording", "sessions")):
            seen = "" if str(path) == name else f": expected {path}"
            missing.append(_format_mistake(document, key, f"no such file{seen}"))
        tree = _replace_at(tree, key, str(path))
    return tree, missing


def _is_there(path: Path, *, may_be_folder: bool) -> bool:
    """Tell whether a file or folder is there; pipes and devices, which would be waited for, and circles are none."""
    try:
        return path.is_file() or (may_be_folder and path.is_dir())
    except OSError:  # a name that no file can have
        return False


def _replace_at(value: Any, key: Key, new: str) -> Any:
    """Return dicts and lists with one value replaced; all other values are shared, not copied."""
    if not key:
        return new
    parts: Any = dict(value) if isinstance(value, dict) else list(value)
    parts[key[0]] = _replace_at(parts[key[0]], key[1:], new)
    return parts


def _tell_copies_once(lines: list[str], origins: Mapping[Key, Key]) -> list[str]:
    """Return the mistakes without those that a `repeat` repeats: what is wrong with all copies is told of the first."""
    firsts: dict[Key, str] = {}
    items = [key for key in origins if len(key) == 2 and isinstance(key[1], int)]
    for place in sorted(items, key=lambda key: (str(key[0]), int(key[1]))):
        firsts.setdefault(origins[place], join_key(place))
    first_of = {join_key(place): firsts[source] for place, source in origins.items() if source in firsts}
    told = [_ITEM.sub(lambda found: first_of.get(found[0], found[0]), line) for line in lines]
    return list(dict.fromkeys(told))


def _drop_inherited(lines: list[str]) -> list[str]:
    """Drop the mistakes of a session's own sensor or platform in keys that it has from the scenario's."""
    of_scenario = {found[1] + found[2] for line in lines if (found := _OF_SCENARIO.search(line))}
    inherited = ((line, _OF_SESSION.search(line)) for line in lines)
    return [line for line, found in inherited if found is None or found[1] + found[2] not in of_scenario]


def _drop_repeated(lines: list[str], broken: set[Key], told: list[Mistake]) -> list[str]:
    """Drop the schema's mistakes about values that could not be drawn, and those already reported with their line.

    Such a value is none to the rules of what holds it, which may ask for it.
    """
    untold = {*broken, *(key[:-1] for key in broken)} - {()}
    names = [f": {join_key(key)} = " for key in untold] + [rule.partition(";")[0] for _, rule in told]
    return [line for line in lines if not any(name in line for name in names)]


def _format_mistake(document: Document, key: Key, rule: str) -> str:
    """Return one line: where a mistake is, what stands there, and the rule that it breaks."""
    value = document.value
    for part in key:
        is_there = part in value if isinstance(value, dict) else isinstance(value, list) and part in range(len(value))
        if not is_there:
            return visible(f"{document.where(key)}: {join_key(key)}: {rule}")
        value = value[part]
    return visible(f"{document.where(key)}: {join_key(key)} = {_brief(repr(value))}: {rule}")


def _brief(text: str, most: int = 60) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _key_of(line: str) -> str:
    return line.split(" = ", maxsplit=1)[0]


def _line_of(line: str) -> tuple[str, int]:
    match = re.match(r"(.*?):(\d+): ", line)
    return (match[1], int(match[2])) if match else (line, 0)


@contextmanager
def scenarios_read_once() -> Iterator[None]:
    """Read each scenario once in the block, however many seeds draw it; the files must not change meanwhile."""
    token = _READ.set({})
    try:
        yield
    finally:
        _READ.reset(token)


def _read(name_or_path: str, settings: Iterable[str]) -> Document:
    settings, known = tuple(settings), _READ.get()
    if known is None:
        return _read_anew(name_or_path, settings)
    if (name_or_path, settings) not in known:
        known[name_or_path, settings] = _read_anew(name_or_path, settings)
    return known[name_or_path, settings]


def _read_anew(name_or_path: str, settings: Sequence[str]) -> Document:
    document = _read_extended(_path_of(name_or_path), ())
    return apply_settings(_without_old_odometry(document, apply_settings(Document("--set", {}), settings)), settings)


def _without_old_odometry(base: Document, over: Document) -> Document:
    """Return `base` without each session's odometry to which `over` gives another source: it starts anew."""
    for session in ("before", "after"):
        key: Key = (session, "odometry")
        old, new = (mapping_at(mapping_at(each.value, session), "odometry") for each in (base, over))
        if not {"source", "file"} & new.keys() or source_of(new) == source_of(old):
            continue
        kept = {name: value for name, value in mapping_at(base.value, session).items() if name != "odometry"}
        origins = {place: where for place, where in base.origins.items() if place[:2] != key}
        base = replace(base, value=base.value | {session: kept}, origins=origins) if old else base
    return base


def _path_of(name_or_path: str) -> Path:
    files = family_files()
    if name_or_path in files:
        return _shorten(files[name_or_path])
    path = Path(name_or_path)
    if _is_file(path):
        return path
    if path.suffix in SUFFIXES:
        raise ScenarioError(
            f"{visible(_brief(str(path), 300))}: no such file; a scenario is a YAML file or a name such as {min(files)}"
        )
    hint = suggest(name_or_path, files) or "; `tunnelcd list scenarios` names all"
    raise ScenarioError(f'scenario "{visible(_brief(name_or_path))}": unknown{hint}')


def _is_file(path: Path) -> bool:
    """Tell whether there is such a file; there is none of a name that no file system takes."""
    try:
        return path.is_file()
    except OSError:
        return False


def _shorten(path: Path) -> Path:
    """Return the path for messages: relative if it lies below the working folder."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _read_extended(path: Path, children: tuple[Path, ...]) -> Document:
    """Read a file and write it over the one it extends; `family` is its own name unless it gives one."""
    read = read_yaml(path)
    if not isinstance(read.value, dict):
        found = "nothing in it" if read.value is None else type(read.value).__name__
        raise ScenarioError(f"{path}: expected keys and values, got {found}")
    origins = dict(read.origins)
    value: dict[Any, Any] = dict(read.value)
    value.setdefault("family", family_of(path))
    base_name = value.pop("extends", None)
    if base_name is None:
        return Document(str(path), value, origins)
    base = _read_extended(_base_path(base_name, path, origins[("extends",)], children), (*children, path))
    base = _without_old_odometry(base, Document(str(path), value))
    kept = {key: where for key, where in base.origins.items() if not _is_replaced(key, base.value, value)}
    return Document(str(path), merge_trees(base.value, value), kept | origins)


def _base_path(name: Any, path: Path, where: str, children: tuple[Path, ...]) -> Path:
    if not isinstance(name, str):
        raise ScenarioError(f"{where}: extends = {name!r}: expected the name of a scenario or a YAML file")
    try:
        beside = path.parent / name
        base = beside if Path(name).suffix in SUFFIXES and _is_file(beside) else _path_of(name)
    except ScenarioError as error:
        raise ScenarioError(f"{where}: extends = {_brief(repr(name))}: {error}") from error
    if base.resolve() in [child.resolve() for child in (*children, path)]:
        raise ScenarioError(f"{where}: extends = {_brief(repr(name))}: the files extend each other in a circle")
    return base


def _is_replaced(key: Key, base: Any, over: Any) -> bool:
    """Tell whether a key path of `base` lies in something that `over` replaces as a whole."""
    for part in key:
        both = isinstance(base, dict) and isinstance(over, dict)
        if not both or is_distribution(base) or is_distribution(over):
            return True
        if part not in over:
            return part in option_keys(over)
        base, over = base[part], over[part]
    return False
