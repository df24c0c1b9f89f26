"""YAML: bounded in size, depth and number of values, aliases counted as what they stand for."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import yaml

MAX_BYTES = 500_000
MAX_DEPTH = 64
MAX_VALUES = 40_000
"""The largest shipped file holds 2,100 values, aliases expanded."""
_MAX_NUMBER_LENGTH = 100  # characters; 0b and 64 digits are 66
_MAX_INTEGER = 2**64
# Numbers that YAML 1.1, which asks for a dot and a sign, reads as text: 1e5, 1.5e3, -2E-3.
_EXPONENT = re.compile(r"[-+]?(?:[0-9]{1,99}\.?[0-9]{0,99}|\.[0-9]{1,99})[eE][-+]?[0-9]{1,5}$")
_TOO_DEEP = f"nested deeper than {MAX_DEPTH} levels"
_TOO_MANY = f"more than {MAX_VALUES} values, aliases counted as what they stand for"

Key = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class ParsedYaml:
    """The content of a YAML text.

    Attributes:
        value: Plain dicts, lists and scalars; an alias is a copy of what it stands for.
        lines: Line of each key path.
        mistakes: Keys that stand twice, as (line, what is wrong).
    """

    value: Any
    lines: dict[Key, int] = field(default_factory=dict)
    mistakes: list[tuple[int, str]] = field(default_factory=list)


class YamlError(ValueError):
    """A text that is no YAML, or more than is read; `line` says where, None if that is not known."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line


def parse_yaml(text: str) -> ParsedYaml:
    """Parse a YAML text with the safe loader.

    Raises:
        YamlError: It is no YAML, of more than `MAX_BYTES`, nested deeper than `MAX_DEPTH`, or of more than `MAX_VALUES`
            values.
    """
    if len(text) > MAX_BYTES:
        raise YamlError(f"{len(text) / 1e6:.1f} MB, more than the {MAX_BYTES / 1e6:.1f} MB it may have")
    try:
        builder = _Builder()
        value = builder.build(yaml.compose(text, Loader=_BoundedLoader), ())
    except YamlError:
        raise
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise YamlError(f"{error.problem!s:.200}", line) from error
    except Exception as error:  # constructors of explicit types (`!!int ""`) let through whatever a value provokes
        raise YamlError(str(error).splitlines()[0][:200] if str(error) else type(error).__name__) from error
    return ParsedYaml(value, builder.lines, builder.mistakes)


def parse_yaml_value(text: str) -> Any:
    """Return the value of a short YAML text, such as that of a setting.

    Raises:
        YamlError: It is no YAML, or names a key twice.
    """
    parsed = parse_yaml(text)
    if parsed.mistakes:
        raise YamlError(parsed.mistakes[0][1])
    return parsed.value


class _BoundedLoader(yaml.SafeLoader):
    """Composes nodes down to a depth, so that no text exhausts the stack, and up to a number."""

    _depth = 0
    _n_nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._depth += 1
        self._n_nodes += 1
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]  # types-PyYAML leaves it untyped
        line = event.start_mark.line + 1
        if self._depth > MAX_DEPTH:
            raise YamlError(_TOO_DEEP, line)
        if self._n_nodes > 2 * MAX_VALUES:  # keys are nodes, too
            raise YamlError(_TOO_MANY, line)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    """Puts texts that `_BoundedLoader` would read as numbers into quotes."""


for _each in (_BoundedLoader, _Dumper):
    _each.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, [*"-+.0123456789"])


def dump_yaml(value: Any, **options: Any) -> str:
    """Return a text that `parse_yaml` reads as the value; options are those of `yaml.dump`."""
    return str(yaml.dump(value, Dumper=_Dumper, **options))


class _Builder:
    """Builds plain values from nodes; the same node is built again for each alias, and each time is counted."""

    def __init__(self) -> None:
        self.lines: dict[Key, int] = {}
        self.mistakes: list[tuple[int, str]] = []
        self._n_values = 0
        self._constructor = yaml.constructor.SafeConstructor()

    def build(self, node: Any, key: Key) -> Any:
        if node is None:
            return None
        line = node.start_mark.line + 1
        self._n_values += 1
        # an alias within its own anchor has no end
        if len(key) > MAX_DEPTH:
            raise YamlError(_TOO_DEEP, line)
        if self._n_values > MAX_VALUES:
            raise YamlError(_TOO_MANY, line)
        self.lines.setdefault(key, line)
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*key, index)) for index, item in enumerate(node.value)]
        if not isinstance(node, yaml.MappingNode):
            return self._scalar(node)
        content: dict[Any, Any] = {}
        for name_node, item in node.value:
            name = self._scalar(name_node)
            line = name_node.start_mark.line + 1
            if name in content:
                self.mistakes.append((line, f"{name!s:.200}: the key is here a second time"))
            self.lines[(*key, name)] = line
            content[name] = self.build(item, (*key, name))
        return content

    def _scalar(self, node: Any) -> Any:
        line = node.start_mark.line + 1
        if not isinstance(node, yaml.ScalarNode):
            raise YamlError("a key must be a word or a number", line)
        is_text = node.tag == "tag:yaml.org,2002:str"
        if not is_text and len(node.value) > _MAX_NUMBER_LENGTH:
            raise YamlError(f"{node.value[:20]}...: too long for a number", line)
        try:
            node.value.encode()
        except UnicodeEncodeError as error:
            raise YamlError(f"{node.value[:40]!a}: half of a surrogate pair is no character", line) from error
        value = node.value if is_text else self._constructor.construct_object(node)
        if isinstance(value, int) and abs(value) >= _MAX_INTEGER:
            raise YamlError(f"{node.value[:40]}: beyond 64 bits", line)
        return value
