"""The provenance of united runs, and whether they may be united: one plan, one set of versions, weights and threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

from cdpipe.core.errors import InputError
from eval.core.provenance import IDLE

_MUST_AGREE = ("format_version", "seeds", "plan", "plan_digest", "versions", "config_digests", "checkpoints")
_WORDS = {
    "versions": "versions of packages", "config_digests": "settings", "checkpoints": "weights", "seeds": "seeds",
    "plan": "plans", "plan_digest": "plans", "format_version": "formats",
}  # fmt: skip
_TOLD = 4
# No row depends on these; in a cluster all must be of one `distributed`.
_IDLE_PACKAGES = (*IDLE, "distributed")


def unite_provenance(
    names: Sequence[str], told: Sequence[Mapping[str, Any]], command: str
) -> tuple[dict[str, Any], list[str]]:
    """Return the provenance of united runs, and what is worth a note.

    `started` and `finished` are the first and the last, `parts` tells of each run its folder, shard, times, command,
    commit and machine. The machine is the common one; where there are several, the fields that differ name all.

    Args:
        names: The folders.
        told: The provenance of each.
        command: The command that unites them.

    Raises:
        InputError: Two of them differ in what rows depend on.
    """
    for (name, one), (other_name, other) in combinations(zip(names, told, strict=True), 2):
        _require_alike(name, one, other_name, other)
    parts = [part for name, each in zip(names, told, strict=True) for part in _parts(name, each)]
    commits = list(dict.fromkeys(str(each.get("git_commit")) for each in told))
    notes = [] if len(commits) == 1 else [f"the runs are of several commits: {', '.join(commits)}"]
    if unfinished := [name for name, each in zip(names, told, strict=True) if not each.get("finished")]:
        notes.append(f"not finished when they were united: {', '.join(unfinished)}")
    united = {key: value for key, value in told[0].items() if key not in ("shard", "parts")}
    united |= {
        "started": min(str(each.get("started")) for each in told),
        "command": command,
        "git_commit": told[0].get("git_commit") if len(commits) == 1 else None,
        "machine": unite_fields([part.get("machine") for part in parts]),
        "parts": parts,
    }
    return united, notes


def resume_provenance(name: str, earlier: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a run that keeps cells of an earlier one in its folder.

    On another machine, `machine` and `parts` tell of both, as in united runs.

    Raises:
        InputError: The packages have other versions, or the numeric libraries other threads.
    """
    try:
        _require_alike("its finished cells", earlier, "the others", now, ("versions",))
    except InputError as error:
        raise InputError(f"{name}: {error}; or name a new folder, or add --force, which makes all anew") from error
    if "parts" not in earlier and earlier.get("machine") == now.get("machine"):
        return dict(now)
    parts = [*_parts(name, earlier), *_parts(name, now)]
    return {**now, "machine": unite_fields([part.get("machine") for part in parts]), "parts": parts}


def _require_alike(
    name: str, first: Mapping[str, Any], other_name: str, other: Mapping[str, Any], keys: Sequence[str] = _MUST_AGREE
) -> None:
    for key in keys:
        one, two = first.get(key), other.get(key)
        if key == "versions" and isinstance(one, Mapping) and isinstance(two, Mapping):
            one, two = _shared(_packages(first), _packages(other))
        if one != two:
            raise InputError(
                f"{name} and {other_name}: of different {_WORDS[key]} ({_name_difference(one, two)}): rows of both in "
                "one table would mean different things; run them alike"
            )
    threads = [_threads(each) for each in (first, other)]
    if threads[0] != threads[1]:
        raise InputError(
            f"{name} and {other_name}: of different threads of the numeric libraries "
            f"({_name_difference(*threads)}): their rows may differ in the last digits; run them alike"
        )


def _packages(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the versions of the packages that rows depend on; older runs recorded some extras among `versions`."""
    told = [part for key in ("versions", "extras") if isinstance(part := provenance.get(key), Mapping)]
    return {name: version for part in told for name, version in part.items() if name not in _IDLE_PACKAGES}


def _shared(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return of each what both recorded."""
    return [{name: each[name] for name in one if name in two} for each in (one, two)]


def _threads(provenance: Mapping[str, Any]) -> Any:
    machine = provenance.get("machine")
    return machine.get("threads") if isinstance(machine, Mapping) else None


def _name_difference(one: Any, two: Any) -> str:
    """Return the first keys at which two values differ, with both values."""
    if not (isinstance(one, Mapping) and isinstance(two, Mapping)):
        return f"{one!r:.60} and {two!r:.60}"
    keys = [key for key in {**one, **two} if one.get(key) != two.get(key)]
    named = [f"{key}: {one.get(key, 'none')!r:.60} and {two.get(key, 'none')!r:.60}" for key in keys[:_TOLD]]
    more = f", and {len(keys) - _TOLD} more" if len(keys) > _TOLD else ""
    return ", ".join(named) + more


def _parts(name: str, provenance: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what is told of a run in the union; a union tells of its own parts."""
    if isinstance(parts := provenance.get("parts"), list) and parts:
        return [dict(part) for part in parts if isinstance(part, Mapping)]
    keys = ("shard", "started", "finished", "command", "git_commit", "machine")
    return [{"folder": name, **{key: provenance.get(key) for key in keys}}]


def unite_fields(told: Sequence[Any]) -> Any:
    """Return what several runs tell of their machines or packages: fields that differ name all values; {} of none."""
    known = [each for each in told if isinstance(each, Mapping)]
    if told and all(each == told[0] for each in told):
        return told[0]
    keys = list(dict.fromkeys(key for each in known for key in each))
    return {key: _unite_field([each.get(key) for each in known]) for key in keys}


def _unite_field(values: Sequence[Any]) -> Any:
    if all(value == values[0] for value in values):
        return values[0]
    return " and ".join(dict.fromkeys(str(value) for value in values))
