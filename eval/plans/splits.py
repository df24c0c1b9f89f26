"""Splits of the test seeds: `dev`, which may be looked at, and `sealed`, which has not been.

`eval/splits.yaml` holds their ranges and how often their scores have been looked at. A sealed seed is drawn from the
name of the version that is released. Each seed of `dev` has one, so plans that share pairs share the sealed ones, too.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Annotated

from pydantic import Field

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.yamlfile import Settings, read_yaml, validate

_NUMBER = "(?:0|[1-9][0-9]{0,8})"
_SEALED = re.compile(rf"sealed(?::({_NUMBER}\.{_NUMBER}\.{_NUMBER}))?")


class Split(Settings):
    """A range of seeds, `end` excluded, and every look at scores of it."""

    first: Annotated[int, Field(ge=0)]
    end: Annotated[int, Field(ge=1)]
    looks: tuple[str, ...] = ()


class Splits(Settings):
    """Both splits of the test seeds."""

    dev: Split
    sealed: Split


def load_splits() -> Splits:
    """Return the splits of the test seeds."""
    return validate(Splits, read_yaml(Path(__file__).parents[1] / "splits.yaml"))


def version_name() -> str:
    """Return the name of the version that runs, from which sealed seeds are drawn."""
    return f"tunnelcd {metadata.version('tunnelcd')}"


def sealed_by(split: str) -> str:
    """Return the name of the version that a split's seeds are drawn from, "" for `dev`.

    Args:
        split: `dev`, `sealed` for the version that runs, or `sealed:0.1.0` for an earlier one.

    Raises:
        InputError: It is none of these, or a version that is not out yet: its seeds are for nobody to see.
    """
    if split == "dev":
        return ""
    found, running = _SEALED.fullmatch(split), version_name()
    if found is None:
        raise InputError(f"--split {visible(split)}: expected dev, sealed or, for an earlier version, sealed:0.1.0")
    version = f"tunnelcd {found[1]}" if found[1] else running
    if _numbers_of(version) > _numbers_of(running):
        raise InputError(f"--split {split}: this is {running}: expected it or an earlier one")
    return version


def find_split(seeds: Sequence[int], claimed: Iterable[str] = ()) -> str:
    """Return the split of the test seeds that some seeds are of, worked out from their numbers.

    Args:
        seeds: The seeds.
        claimed: What senders call the split, as `Plan.split`; a version is tried if it is this one or an earlier one.

    Returns:
        "dev"; "sealed by " and the version from whose name all are drawn; "" if they are of none of these.
    """
    dev = load_splits().dev
    if all(dev.first <= seed < dev.end for seed in seeds):
        return "dev"
    versions = [version_name()]
    for name in claimed:
        with suppress(InputError):
            versions.append(sealed_by(f"sealed:{name.removeprefix('sealed by tunnelcd ')}"))
    every = range(dev.first, dev.end)
    return next((f"sealed by {each}" for each in versions if set(seeds) <= set(seal_seeds(every, each))), "")


def _numbers_of(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]


def seal_seeds(seeds: Sequence[int], version: str) -> tuple[int, ...]:
    """Return the sealed seed of each seed of `dev`.

    Draw number i is SHA-256 of "<version> <i>", as a number, modulo the size of the range; a number that was drawn
    before is passed over. The n-th seed of `dev` gets the n-th number.

    Args:
        seeds: Seeds of `dev`.
        version: Name of a version, `version_name`.

    Raises:
        ValueError: One of them is no seed of `dev`.
    """
    dev, sealed = load_splits().dev, load_splits().sealed
    strange = [seed for seed in seeds if not dev.first <= seed < dev.end]
    if strange:
        raise ValueError(
            f"seed {strange[0]} has no sealed one: expected a plan of test seeds from {dev.first} to {dev.end - 1}"
        )
    drawn: dict[int, None] = {}
    number = 0
    while len(drawn) < dev.end - dev.first:
        hashed = int.from_bytes(hashlib.sha256(f"{version} {number}".encode()).digest(), "big")
        drawn[sealed.first + hashed % (sealed.end - sealed.first)] = None
        number += 1
    in_order = list(drawn)
    return tuple(in_order[seed - dev.first] for seed in seeds)
