"""YAML files and other documents checked against pydantic models; all mistakes of a file are reported at once."""

from __future__ import annotations

import difflib
import json
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.resources.abc import Traversable
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, SerializerFunctionWrapHandler, ValidationError, model_serializer

from cdpipe.core.errors import InputError
from cdpipe.core.files.plain_file import read_bytes
from cdpipe.core.files.yaml_file import MAX_BYTES as MAX_YAML_BYTES
from cdpipe.core.files.yaml_file import Key, YamlError, parse_yaml, parse_yaml_value
from cdpipe.core.names import visible

_MAX_TOLD = 100  # mistakes of a file; the closest known name to each takes time
_MAX_LISTED = 50_000  # pydantic's list of all mistakes takes a kilobyte for each


class Settings(BaseModel):
    """Base of every model read from YAML: frozen; unknown keys, NaN and infinity are mistakes.

    Attributes:
        renamed: What replaced a former key, by its name ("query.compare").
    """

    renamed: ClassVar[Mapping[str, str]] = {}

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class GrownSettings(Settings):
    """Settings whose dump leaves newer keys out while they have their defaults, so that older files keep their bytes.

    Attributes:
        newer: The keys that came later.
    """

    newer: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _without_newer_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        idle = {key for key in self.newer if getattr(self, key) == fields[key].default}
        return {key: value for key, value in handler(self).items() if key not in idle}


ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Document:
    """A parsed file and the origin of each of its keys.

    Attributes:
        source: File name or other origin, for messages.
        value: Content as plain dicts, lists and scalars.
        origins: "file:line" or "--set" of each key path.
    """

    source: str
    value: Any
    origins: Mapping[Key, str] = field(default_factory=dict)

    def where(self, key: Key) -> str:
        """Return the origin of a key, or that of its nearest parent with an origin."""
        while key and key not in self.origins:
            key = key[:-1]
        return self.origins.get(key, self.source)

    def get(self, name: str) -> Any:
        """Return the value of a key of the outermost level; None where there is none, or no keys at all."""
        return self.value.get(name) if isinstance(self.value, dict) else None


def read_yaml(path: Path, text: str | None = None) -> Document:
    """Parse a YAML file (or `text` under that name).

    Raises:
        InputError: The file is missing, cannot be read, is not YAML or too large, or names a key twice.
    """
    try:
        document = _parse(str(path), read_bytes(path, MAX_YAML_BYTES).decode() if text is None else text)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not YAML: {error}") from error
    return replace(document, value=deepcopy(document.value))


@lru_cache(maxsize=256)
def _parse(path: str, text: str) -> Document:
    """Parse a text; cached, because one family is drawn with many seeds and parsing is the slow part."""
    try:
        parsed = parse_yaml(text)
    except YamlError as error:
        where = path if error.line is None else f"{path}:{error.line}"
        raise InputError(f"{where}: not YAML: {' '.join(str(error).split())}") from error
    if parsed.mistakes:
        raise InputError("\n".join(f"{path}:{line}: {visible(told)}" for line, told in parsed.mistakes[:_MAX_TOLD]))
    return Document(path, parsed.value, {key: f"{path}:{line}" for key, line in parsed.lines.items()})


def read_yaml_text(file: Traversable) -> str:
    """Return the text of a YAML file that `find_yaml` found: of this package, of a plugin, or on the search path.

    Raises:
        InputError: It is no plain file, too large, or not UTF-8.
    """
    try:
        content = read_bytes(file, MAX_YAML_BYTES) if isinstance(file, Path) else file.read_bytes()
        return content.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not YAML: {error}") from error


def read_head_comment(file: Traversable) -> str:
    """Return the comment at the head of a YAML file on one line, "" where there is none.

    Raises:
        InputError: As `read_yaml_text`.
    """
    lines = takewhile(lambda line: line.startswith("#"), read_yaml_text(file).splitlines())
    return " ".join(" ".join(line.lstrip("# ") for line in lines).split())


def validate(model: type[ModelT], document: Document) -> ModelT:
    """Check a document against a model.

    Raises:
        InputError: One line per mistake, `file:line: key = value: rule; did you mean …`, and the number of those beyond
            100; of more than 50,000 the number alone.
    """
    _require_keys(document)
    try:
        return model.model_validate(document.value)
    except ValidationError as error:
        if error.error_count() > _MAX_LISTED:
            raise InputError(
                f"{document.source}: {error.error_count()} mistakes: is it another kind of file?"
            ) from error
        mistakes = error.errors()
        mistakes = _without_misspelt(model, mistakes)
        lines = [visible(_describe_mistake(model, document, item)) for item in mistakes[:_MAX_TOLD]]
        if len(mistakes) > _MAX_TOLD:
            lines.append(f"{document.source}: and {len(mistakes) - _MAX_TOLD} more mistakes")
        raise InputError("\n".join(dict.fromkeys(lines))) from error


def _require_keys(document: Document) -> None:
    if not isinstance(document.value, dict):
        found = "nothing in it" if document.value is None else type(document.value).__name__
        raise InputError(f"{document.source}: expected keys and values, got {found}")


def setting_lines(settings: Iterable[str] | Mapping[str, Any]) -> list[str]:
    """Return settings, given as lines, as `{"a.b": value}` or as `{"a": {"b": value}}`, as `a.b=value` lines.

    Values may be paths and numbers of numpy.

    Raises:
        InputError: A value is none that a file could hold.
    """
    if not isinstance(settings, Mapping):
        return list(settings)
    lines: list[str] = []
    for key, value in settings.items():
        inner = {f"{key}.{name}": part for name, part in value.items()} if isinstance(value, Mapping) else {}
        lines += setting_lines(inner) if inner else [f"{key}={_as_text(key, value)}"]
    return lines


def _as_text(key: str, value: Any) -> str:
    def plain(part: Any) -> Any:
        if isinstance(part, Path):
            return str(part)
        if hasattr(part, "item"):  # of numpy, which completion of names in a shell does not wait for
            return part.item()
        raise TypeError

    try:
        return json.dumps(value, default=plain)
    except (TypeError, ValueError) as error:
        told = f"{_brief(value)}: expected text, a path, a number, true or false, or a list of these"
        raise InputError(f"setting {key} = {told}") from error


def apply_settings(document: Document, settings: Iterable[str]) -> Document:
    """Return the document with `a.b=value` settings applied; values are YAML scalars or lists.

    An item of a list goes by its `name`: `props.barrel.size_m=[1, 1, 1]`.

    Raises:
        InputError: The document holds no keys; or a setting has no "=", is not YAML, or names an item that its list
            lacks.
    """
    _require_keys(document)
    value = deepcopy(document.value)
    origins = dict(document.origins)
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name:
            raise InputError(f"--set {setting}: expected key=value, e.g. extract.voxel_m=0.4")
        try:
            parsed = parse_yaml_value(text)
        except YamlError as error:
            raise InputError(f"--set {setting}: the value is not YAML") from error
        *parents, last = name.split(".")
        place: Any = value
        written: Key = ()
        for parent in parents:
            is_new = isinstance(place, dict) and parent not in place
            key, place = _step_into(place, parent, setting)
            written = (*written, key)
            origins |= {written: "--set"} if is_new else {}
        if not isinstance(place, dict):
            raise InputError(f"--set {setting}: {parents[-1]} is a list: name an item and one of its keys")
        place[last] = parsed
        written = (*written, last)
        origins = {key: where for key, where in origins.items() if key[: len(written)] != written}
        origins[written] = "--set"
    return replace(document, value=value, origins=origins)


def _step_into(place: Any, name: str, setting: str) -> tuple[str | int, Any]:
    """Return the key of a group of settings, or of a named item of a list, and what stands there; groups are made."""
    if isinstance(place, list):
        names = [item.get("name") if isinstance(item, dict) else None for item in place]
        if name not in names:
            known = [each for each in names if isinstance(each, str)]
            told = suggest(name, known) or f": expected one of {', '.join(known) or 'no name: its items have none'}"
            raise InputError(f"--set {setting}: no item of the list is called {name!r}{told}")
        return names.index(name), place[names.index(name)]
    found = place.setdefault(name, {})
    if not isinstance(found, dict | list):
        raise InputError(f"--set {setting}: {name} is a value, not a group of settings")
    return name, found


def split_section(document: Document, name: str) -> tuple[Document, Document | None]:
    """Return a document without its section `name`, and the same document with the section's settings applied.

    Returns:
        The second is None without such a section; its keys keep their origins.

    Raises:
        InputError: The section is no group of settings.
    """
    if not isinstance(document.value, dict) or name not in document.value:
        return document, None
    section = document.value[name]
    if not isinstance(section, dict):
        raise InputError(f"{document.where((name,))}: {name} = {_brief(section)}: expected a group of settings")
    below = {key: where for key, where in document.origins.items() if key[:1] != (name,)}
    above = {key[1:]: where for key, where in document.origins.items() if key[:1] == (name,) != key}
    rest = replace(document, value={key: value for key, value in document.value.items() if key != name}, origins=below)
    return rest, replace(rest, value=_overlay(rest.value, section), origins=below | above)


def suggest(word: str, known: Iterable[str], prefix: str = "") -> str:
    """Return `; did you mean "…"?` for the closest known word, written behind a prefix, or "" where none is close."""
    near = _nearest(word, known)
    return f'; did you mean "{prefix}{near}"?' if near else ""


def _nearest(word: str, known: Iterable[str]) -> str | None:
    return next(iter(difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)), None)


# What pydantic says in the words of Python, in those of a file.
_LIST = "expected a list, such as [a, b] or lines that begin with -"
_GROUP = "expected keys with values, such as {key: value}"
_OF_YAML = {"tuple_type": _LIST, "list_type": _LIST, "dict_type": _GROUP, "model_type": _GROUP}


def _without_misspelt(model: type[BaseModel], mistakes: Sequence[Any]) -> list[Any]:
    """Return the mistakes less the missing keys that are there under a misspelt name: the unknown key suggests them."""
    unknown = [tuple(each["loc"]) for each in mistakes[:_MAX_TOLD] if each["type"] == "extra_forbidden"]
    meant = {(*key[:-1], _nearest(str(key[-1]), _fields_at(model, key[:-1]))) for key in unknown}
    return [each for each in mistakes if each["type"] != "missing" or tuple(each["loc"]) not in meant]


def _describe_mistake(model: type[BaseModel], document: Document, error: Any) -> str:
    key = tuple(error["loc"])
    # pydantic adds the names of union alternatives to the location; keep the keys that exist in the document
    key = _existing_key(document.value, key) if error["type"] != "missing" else key
    name = ".".join(str(part) for part in key)
    where = document.where(key)
    if error["type"] == "extra_forbidden":
        return f"{where}: {name} = {_brief(error['input'])}: unknown key{_near_key(model, key, where)}"
    if error["type"] == "missing":
        return f"{where}: {name}: missing, a value is required"
    hint = ""
    expected = error.get("ctx", {}).get("expected")
    if error["type"] == "literal_error" and isinstance(error["input"], str):
        hint = suggest(error["input"], [word.strip(" '\"") for word in expected.replace(" or ", ",").split(",")])
    if error["type"] == "literal_error" and key[-1:] == ("format_version",) and type(error["input"]) is int:
        hint = "; it is of a newer tunnelcd: update tunnelcd" if error["input"] > 1 else ""
    rule = _OF_YAML.get(error["type"], error["msg"].removeprefix("Value error, "))
    rule = rule[0].lower() + rule[1:] if not rule[:2].isupper() else rule
    return f"{where}: {name} = {_brief(error['input'])}: {rule}{hint}" if name else f"{where}: {rule}{hint}"


def _near_key(model: type[BaseModel], key: Key, where: str) -> str:
    """Suggest a key for an unknown one: the same name in a group where the group is missing, the closest name, or all.

    A file names its group on a line of its own; an option needs the group in the suggestion.
    """
    renamed = model.renamed.get(".".join(map(str, key))) if issubclass(model, Settings) else None
    if renamed:
        return f"; it is {renamed}"
    last = str(key[-1])
    groups = [name for name, field in model.model_fields.items() if isinstance(field.annotation, type)]
    grouped = [f'"{group}.{last}"' for group in groups if last in _fields_at(model, (group,))]
    if len(key) == 1 and grouped:
        return f"; did you mean {' or '.join(grouped)}?"
    group = "".join(f"{part}." for part in key[:-1]) if where == "--set" else ""
    known = list(dict.fromkeys(_fields_at(model, key[:-1])))
    return suggest(last, known, group) or (f"; known are {', '.join(known)}" if known else "")


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _existing_key(value: Any, key: Key) -> Key:
    found: list[str | int] = []
    for part in key:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            continue
        found.append(part)
    return tuple(found)


def _fields_at(model: type[BaseModel], key: Key) -> list[str]:
    """Return the field names that a model allows below a key path, through lists, dicts and unions."""
    models: list[type[BaseModel]] = [model]
    for part in key:
        if isinstance(part, int):
            continue
        below: list[type[BaseModel]] = []
        for candidate in models:
            info = candidate.model_fields.get(str(part))
            below += _models_in(info.annotation) if info else [candidate]
        models = below
    return [name for candidate in models for name in candidate.model_fields]


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [found for inner in typing.get_args(annotation) for found in _models_in(inner)]


def _overlay(below: Any, above: Any) -> Any:
    if not isinstance(below, dict) or not isinstance(above, dict):
        return deepcopy(above)
    return {key: _overlay(below.get(key), above[key]) if key in above else below[key] for key in {**below, **above}}
