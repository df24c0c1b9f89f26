"""Index, data card, digests and metadata of a folder of shards: index.csv, README.md, SHA256SUMS, croissant.json.

index.csv has one row per shard, and one per tunnel that cannot be built. All are made from the shards in the folder, so
that they are right after an interrupted run as well.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json
from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from cdpipe.training.shard import FIELDS, SUFFIX, read_about, split_of
from eval.core.provenance import digest_file
from eval.plans.splits import version_name
from eval.plans.worlds import world_slug
from eval.release.archive import write_sums_of
from eval.release.croissant import FILE, Column, FileGroup, Table, describe_croissant, write_croissant

COUNTS = ("n_before", "n_after", "n_covered", "n_positive", "n_negative", "n_changes", "n_observable")
INDEX_COLUMNS = (
    "family", "seed", "split", "status", "shard", *COUNTS, "score_radius_m", "bytes", "sha256", "digest", "reason",
)  # fmt: skip
_SIMULATED = "Simulated tunnels, each driven twice by a ray-cast LiDAR"
_RECORDED = "Tunnels, some of them recorded and others simulated, each driven twice by a LiDAR"
_PURPOSE = "as training data of change descriptors"
_LICENCE_OF_RECORDINGS = "that of the recordings, which their owners give; what tunnelcd simulated is MIT"
_MIT = "MIT, as tunnelcd itself: everything is simulated, nothing was recorded"
_ROW = "One row is one shard, or a tunnel that cannot be built."
_ENCODING = "application/octet-stream"
_TYPES = {**dict.fromkeys((*COUNTS, "seed", "bytes"), "whole"), "score_radius_m": "number"}
_MEANINGS = {
    "family": "scenario family", "seed": "seed that drew the tunnel", "split": "train, validation or test, by the seed",
    "status": "ok, or refused: the tunnel cannot be built", "shard": "file of the shard, empty where refused",
    "n_before": "before keyframes", "n_after": "after keyframes", "n_covered": "with an after keyframe within 5 m",
    "n_positive": "near an observable change", "n_negative": "far from every change", "n_changes": "changed objects",
    "n_observable": "changes that both sessions could see", "bytes": "size of the shard",
    "score_radius_m": "distance within which a region finds a change, metres", "sha256": "digest of the shard",
    "digest": "digest of what the shard is made of", "reason": "why there is no shard",
}  # fmt: skip
_COLUMNS = tuple(Column(name, _TYPES.get(name, "text"), _MEANINGS[name]) for name in INDEX_COLUMNS)
_REMEDY = "remove it and run the command again"
Row = dict[str, Any]


def write_card(out: Path) -> None:
    """Write index.csv, README.md, croissant.json and SHA256SUMS of a folder.

    Raises:
        InputError: A shard is damaged.
    """
    rows = [_shard_row(path) for path in out.glob(f"*{SUFFIX}")]
    rows += [_refused_row(path) for path in out.glob("*.refused.json")]
    # the first after session has the shortest name
    rows.sort(key=lambda row: (row["family"], row["seed"], len(row["shard"]), row["shard"]))
    with whole_file(out / "index.csv") as partial:
        pd.DataFrame(rows, columns=list(INDEX_COLUMNS)).to_csv(partial, index=False)
    document = read_json(out / "dataset.json", "expected a folder made by `tunnelcd dataset`")
    with whole_file(out / "README.md") as partial:
        partial.write_text(card(rows, document["recipe"], document["commands"]), encoding="utf-8")
    table = Table("index.csv", digest_file(out / "index.csv"), _ROW, _COLUMNS)
    shards = FileGroup("shards", "the arrays of one tunnel each, as README.md lists them", _ENCODING, f"*{SUFFIX}")
    version = version_name().removeprefix("tunnelcd ")
    told = f"{_what(rows)}, {_PURPOSE}"
    licence = {"licence": _LICENCE_OF_RECORDINGS} if _has_recordings(rows) else {}
    write_croissant(out, describe_croissant("tunnelcd-training", told, version, (shards,), table, **licence))
    digests = {row["shard"]: row["sha256"] for row in rows if row["status"] == "ok"}
    digests |= {name: digest_file(out / name) for name in ("README.md", "dataset.json", "index.csv", FILE)}
    write_sums_of(out, [f"{digest}  {name}\n" for name, digest in sorted(digests.items())])


def _has_recordings(rows: Sequence[Row]) -> bool:
    return any(row.get("is_recorded", False) for row in rows)


def _what(rows: Sequence[Row]) -> str:
    return _RECORDED if _has_recordings(rows) else _SIMULATED


def fields_table() -> str:
    """Return the table of a shard's arrays in Markdown."""
    lines = ["| array | shape | type | unit | frame | what |", "|---|---|---|---|---|---|"]
    for each in FIELDS:
        shape = each.shape.replace(",", ", ")
        lines.append(f"| `{each.name}` | ({shape}) | {each.dtype} | {each.unit} | {each.frame} | {each.meaning} |")
    return "\n".join(lines)


def card(rows: Sequence[Row], recipe: Mapping[str, Any], commands: Sequence[str]) -> str:
    """Return the data card.

    Args:
        rows: Of the index.
        recipe: What all shards have in common.
        commands: Those that filled the folder.
    """
    made = [row for row in rows if row["status"] == "ok"]
    refused = [row for row in rows if row["status"] == "refused"]
    settings = ", ".join(f"`{each}`" for each in recipe["settings"]) or "none"
    told = "\n".join(f"- {_text(row['family'])} {row['seed']}: {_text(row['reason'])}" for row in refused) or "None."
    made_by = "\n".join(map(visible, commands))
    one = "One shard is one tunnel" + (" with one of its after sessions" if "afters" in recipe else "")
    return f"""# Training data of change descriptors, made by `tunnelcd dataset`

{_what(rows)}; between the drives, objects are added, removed or
moved.
{one}, and a tunnel is of one split: seeds below 10000 train, 10000 to 19999 validate, 20000 to 899999
test and are never trained on.

{_counts_table(made)}

A pair is a before keyframe with the after map rendered at the same place. A keyframe is positive within the family's
score radius of an observable change, negative beyond 1.5 radii of every change, and left out in between.

| | |
|---|---|
| families | {", ".join(sorted({_text(row["family"]) for row in made})) or "none"} |
| set over the scenarios | {settings} |
| after images of each pair | {recipe["draws"]}: the first merged exactly, each other off by a merge error of its own |
| that error, standard deviation of each component | {recipe["error_m"]:g} m and {recipe["error_deg"]:g} deg |
{_afters_row(made, recipe)}| digest of all shards | `{digest_of(made)}` |
| bytes | {sum(row["bytes"] for row in made):,} |
| version | {version_name()} |
| licence | {_LICENCE_OF_RECORDINGS if _has_recordings(rows) else _MIT} |

## Tunnels that could not be built

{told}

## Made by

```
{made_by}
```

The same command makes the same bytes. Shards that are there are kept; what is missing is added.

## Loading

```python
from cdpipe.training.data import ChangePairs, open_dataset, stacked

tunnels = open_dataset("DIR", "train")                      # or "validation"; families=..., seeds=range(...)
pairs = ChangePairs(tunnels)                                # a torch Dataset of (tunnel, draw, anchor)
tensors = stacked(tunnels, ("before_images", "after_images", "labels"))    # all in memory
```

`index.csv` has one row for each shard, and one for each tunnel that cannot be built. A shard is a safetensors file:

{fields_table()}

K before keyframes (the anchors), J after keyframes, C changes, D draws, R x W pixels of a scan's range image, I the
axes of the map's image, V x U its pixels. Names and kinds of the changed props are in the shard's metadata.
"""


def digest_of(rows: Sequence[Row]) -> str:
    """Return one digest of all shards, whatever the order of the rows."""
    lines = sorted(f"{row['shard']} {row['sha256']}" for row in rows)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _text(words: object) -> str:
    """Return text for a cell of a Markdown table: no end of the cell, no element of HTML, no line of its own."""
    return visible(str(words)).replace("&", "&amp;").replace("<", "&lt;").replace("|", "\\|").replace("`", "\\`")


def _afters_row(made: Sequence[Row], recipe: Mapping[str, Any]) -> str:
    """Return what the card says of several after sessions; nothing where each tunnel has one."""
    if "afters" not in recipe:
        return ""
    first = [row for row in made if "-after-" not in row["shard"].removeprefix(world_slug(row["family"]))]
    n_first, n_all = (sum(row["n_before"] for row in rows) for rows in (first, made))
    return (
        f"| after sessions of each tunnel | {recipe['afters']}, a shard each, `...-after-2` and so on from the second; "
        "they share the before session, the rock and the changes, so their pairs are not independent: "
        f"{n_first:,} of the {n_all:,} pairs are of a first after session |\n"
    )


def _counts_table(made: Sequence[Row]) -> str:
    counts = [name for name in COUNTS if name != "n_after"]
    lines = [
        "| family | split | seeds | tunnels | pairs | covered | positive | negative | changes | observable |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    table = pd.DataFrame(made, columns=["family", "split", "seed", *counts])
    for (family, split), own in table.groupby(["family", "split"]):
        sums = " | ".join(f"{count:,}" for count in (own["seed"].nunique(), *own[counts].sum()))
        lines.append(f"| {_text(family)} | {split} | {own['seed'].min()} to {own['seed'].max()} | {sums} |")
    n_tunnels = len(table[["family", "seed"]].drop_duplicates())
    sums = " | ".join(f"{count:,}" for count in (n_tunnels, *table[counts].sum()))
    return "\n".join([*lines, f"| all | | | {sums} |"])


def _require_identity(path: Path, about: Mapping[str, Any]) -> None:
    """Raise `InputError` unless what names, sorts and sums the rows is of its type."""
    kinds: dict[str, Any] = {"family": str, "seed": int, "digest": str, "reason": str, "score_radius_m": (int, float)}
    values = {name: about[name] for name in kinds if name in about}
    if isinstance(counts := about.get("counts"), dict):
        values |= counts
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, kinds.get(name, int)):
            raise InputError(f"{path}: damaged: {name} = {value!r:.40}: {_REMEDY}")


def _shard_row(path: Path) -> Row:
    about, content = read_about(path), path.read_bytes()
    try:
        _require_identity(path, about)
        return {
            **{name: about[name] for name in ("family", "seed", "digest", "score_radius_m")},
            **{name: about["counts"][name] for name in COUNTS},
            "is_recorded": about.get("is_recorded", False) is True,
            "split": split_of(about["seed"]),
            "status": "ok",
            "shard": path.name,
            "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
            "reason": "",
        }
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: its metadata lacks {error}: {_REMEDY}") from error


def _refused_row(path: Path) -> Row:
    about = read_json(path, _REMEDY)
    _require_identity(path, about)
    try:
        told = {name: about[name] for name in ("family", "seed", "digest", "reason")}
        return {**dict.fromkeys(INDEX_COLUMNS, ""), **told, "status": "refused", "split": split_of(about["seed"])}
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: it lacks {error}: {_REMEDY}") from error
