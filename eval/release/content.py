"""What a release holds: families, seeds and settings, from a small YAML file, and the pairs as their seeds draw them.

description: what it is, in a sentence
published: 2026-11-26                      # for the metadata
settings: [sensor.mode=512x10]             # written over each family before the draw
pairs: {narrow: "20000:20003"}             # seeds of each family, end excluded
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from importlib import resources
from pathlib import Path
from typing import Annotated

from pydantic import Field

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.core.yamlfile import Settings, read_yaml, suggest, validate
from eval.plans.seeds import parse_seeds
from eval.plans.splits import load_splits, version_name
from eval.release.names import release_names
from scenarios.grafted import GraftScenario
from scenarios.library import load_scenario
from scenarios.references import file_digests
from scenarios.schema import Scenario


class ReleaseFile(Settings):
    """The YAML file of a release."""

    description: Annotated[str, Field(min_length=1)]
    published: date
    settings: tuple[str, ...] = ()
    pairs: Annotated[Mapping[str, str], Field(min_length=1)]


@dataclass(frozen=True, slots=True, eq=False)
class ReleasePair:
    """One pair; `name` is opaque: a digest of the version, the scenario as drawn, its files and the seed."""

    name: str
    family: str
    seed: int
    scenario: Scenario


@dataclass(frozen=True, slots=True, eq=False)
class Release:
    """A release with its pairs, in the order of their opaque names; `asked` is its name, or its file, as given."""

    name: str
    asked: str
    version: str
    description: str
    published: date
    settings: tuple[str, ...]
    pairs: tuple[ReleasePair, ...]


def load_release(name_or_path: str) -> Release:
    """Return a release with its pairs drawn; nothing is simulated.

    Args:
        name_or_path: A name of `release_names()`, or a .yaml file.

    Raises:
        InputError: It is unknown, has mistakes, or names a seed that is not of the development split; a family is
            unknown, or a setting does not fit it.
    """
    path = _find(name_or_path)
    content = validate(ReleaseFile, read_yaml(path))
    version = version_name()
    seeds = {family: _parse_seeds(path, family, text) for family, text in content.pairs.items()}
    try:
        pairs = [_draw(family, seed, content.settings, version) for family, own in seeds.items() for seed in own]
    except (InputError, ScenarioError) as error:
        lines = (line.removeprefix("--set: ") for line in str(error).splitlines())
        raise InputError("\n".join(f"{path}: {line}" for line in lines)) from error
    in_order = tuple(sorted(pairs, key=lambda pair: pair.name))
    asked = path.name if path.name == Path(name_or_path).name else name_or_path
    return Release(path.stem, asked, version, content.description, content.published, content.settings, in_order)


def _find(name_or_path: str) -> Path:
    if name_or_path.endswith((".yaml", ".yml")):
        return Path(name_or_path)
    known = release_names()
    if name_or_path not in known:
        near = suggest(name_or_path, known)
        raise InputError(f"release {name_or_path!r} is unknown{near} (known: {', '.join(known)}, or a .yaml file)")
    return Path(str(resources.files("eval") / "release" / f"{name_or_path}.yaml"))


def _parse_seeds(path: Path, family: str, text: str) -> tuple[int, ...]:
    try:
        seeds, dev = parse_seeds(text), load_splits().dev
    except ValueError as error:
        raise InputError(f"{path}: pairs.{family} = {text}: {error}") from error
    for seed in seeds:
        if not dev.first <= seed < dev.end:
            raise InputError(
                f"{path}: pairs.{family} = {text}: seed {seed} is not of the development split: expected "
                f"{dev.first} to {dev.end - 1}, as what is handed out is looked at"
            )
    return seeds


def _draw(family: str, seed: int, settings: tuple[str, ...], version: str) -> ReleasePair:
    scenario = load_scenario(family, seed, settings)
    if isinstance(scenario, GraftScenario):
        raise InputError(f"pairs.{family}: its world is a recording: a release holds simulated pairs alone")
    content = [version, family, seed, scenario.model_dump(mode="json"), file_digests(scenario)]
    name = hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=8).hexdigest()
    return ReleasePair(name, family, seed, scenario)
