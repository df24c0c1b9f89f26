"""What describes the pairs of a release: truth/pairs.csv, croissant.json and the data card README.md.

All three are made from the finished pairs. The card tells families and seeds, and not which opaque name is which.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file
from cdpipe.io.session import read_session
from eval.core.provenance import digest_file
from eval.release.archive import SESSIONS, TRUTH, list_files
from eval.release.content import Release, ReleasePair
from eval.release.croissant import Column, FileGroup, Table, describe_croissant, write_croissant
from sim.session.truth import read_pair_truth

TABLE = f"{TRUTH}/pairs.csv"
COLUMNS = (
    Column("name", "text", "opaque name: the folder of the pair below sessions and truth"),
    Column("family", "text", "scenario family"),
    Column("seed", "whole", "seed that drew the pair"),
    Column("score_radius_m", "number", "distance within which a region finds a change, metres"),
    Column("sensor", "text", "product line and mode of the sensor"),
    Column("n_scans_before", "whole", "revolutions of the before session"),
    Column("n_scans_after", "whole", "revolutions of the after session"),
    Column("n_changes", "whole", "changed objects; a moved one is two"),
    Column("n_observable", "whole", "changes that both sessions could see"),
    Column("n_surface_changes", "whole", "places where rock moved, came or went"),
    Column("bytes", "whole", "size of the sessions and the truth, not compressed"),
)
_SUMMED = ("n_scans_before", "n_scans_after", "n_changes", "n_observable", "n_surface_changes", "bytes")
_GROUPS = (
    FileGroup("sessions", "ranges, reflectivity, signal, times and poses of 64 revolutions each",
              "application/x-npz", f"{SESSIONS}/*/*/chunks/*.npz"),
    FileGroup("odometry", "pose of each revolution as the robot believed it", "application/x-npz",
              f"{SESSIONS}/*/*/odometry.npz"),
    FileGroup("sensors", "format, frames, units and sensor of each session", "application/json",
              f"{SESSIONS}/*/*/session.json"),
    FileGroup("labels", "instance and change of every return, and true poses", "application/x-npz",
              f"{TRUTH}/*/*/truth/*.npz"),
    FileGroup("changes", "changes, movers and the scenario as drawn", "application/json",
              f"{TRUTH}/*/truth/changes.json"),
)  # fmt: skip
Row = dict[str, Any]


def write_release_card(release: Release, folder: Path) -> None:
    """Write truth/pairs.csv, croissant.json and README.md of a folder with all pairs.

    Raises:
        InputError: A pair is damaged.
    """
    rows = [_measure_pair(folder, pair) for pair in release.pairs]
    names = [column.name for column in COLUMNS]
    with whole_file(folder / TABLE) as partial:
        pd.DataFrame(rows, columns=names).to_csv(partial, index=False, lineterminator="\n")
    table = Table(TABLE, digest_file(folder / TABLE), "One row is one pair of sessions.", COLUMNS)
    version = release.version.removeprefix("tunnelcd ")
    name = f"tunnelcd-{release.name}"
    published = release.published.isoformat()
    write_croissant(folder, describe_croissant(name, release.description, version, _GROUPS, table, published))
    digest = _digest_pairs(folder)
    with whole_file(folder / "README.md") as partial:
        partial.write_text(release_card(release, rows, digest), encoding="utf-8")


def release_card(release: Release, rows: Sequence[Row], digest: str) -> str:
    """Return the data card in Markdown.

    Args:
        release: The release.
        rows: Of truth/pairs.csv.
        digest: Of all files of the pairs.
    """
    settings = ", ".join(f"`{visible(each)}`" for each in release.settings) or "none"
    sensors = ", ".join(sorted({visible(row["sensor"]) for row in rows}))
    return f"""# {visible(release.name)}: {len(rows)} pairs of LiDAR sessions of tunnels, with truth apart

{visible(release.description)}.

One row is the pairs of one family.

{_count_families(rows)}

| | |
|---|---|
| made by | `tunnelcd dataset --release {visible(release.asked)} --out FILE.zip` |
| version | {visible(release.version)}, published {release.published.isoformat()} |
| set over the families | {settings} |
| sensors | {sensors} |
| split | development: these pairs may be looked at; scores on them are no leaderboard |
| digest of all pairs | `{digest}` |
| licence | MIT, as tunnelcd itself: everything is simulated, nothing was recorded |

Scores on other seeds, families or settings than those of the reports differ from the published tables.

## What lies where

`sessions/NAME/before` and `after` are what a method may see: scans, odometry, sensor. Names tell nothing by themselves,
but whoever has tunnelcd can work out what they stand for.
`truth/NAME` holds labels, true poses and changes; `truth/pairs.csv` says which name is which family and seed.
Both folders of a name, copied into one, are a pair as `tunnelcd simulate` writes it.

```
sha256sum --check --quiet SHA256SUMS
tunnelcd dataset --unpack FILE.zip --out pairs --with-truth    # the same check, and whole pairs
tunnelcd detect pairs/NAME/before pairs/NAME/after --out answer
tunnelcd score pairs/NAME answer
```

## Columns of truth/pairs.csv

| column | what |
|---|---|
{chr(10).join(f"| `{column.name}` | {column.description} |" for column in COLUMNS)}

`croissant.json` describes the files for machines (Croissant 1.0).
"""


def _measure_pair(folder: Path, pair: ReleasePair) -> Row:
    parts = [folder / kind / pair.name for kind in (SESSIONS, TRUTH)]
    truth = read_pair_truth(parts[1])
    before, after = (read_session(parts[0] / name) for name in ("before", "after"))
    sensors = dict.fromkeys(f"{each.sensor.product} {each.sensor.mode}" for each in (before, after))
    return {
        "name": pair.name,
        "family": pair.family,
        "seed": pair.seed,
        "score_radius_m": truth.score_radius_m,
        "sensor": ", ".join(sensors),
        "n_scans_before": before.n_scans,
        "n_scans_after": after.n_scans,
        "n_changes": len(truth.changes),
        "n_observable": sum(change.is_observable for change in truth.changes),
        "n_surface_changes": len(truth.surface_changes),
        "bytes": sum((part / name).stat().st_size for part in parts for name in list_files(part)),
    }


def _digest_pairs(folder: Path) -> str:
    """Return one digest of all files of the pairs, their names included."""
    hasher = hashlib.sha256()
    for name in list_files(folder):
        if name.startswith((f"{SESSIONS}/", f"{TRUTH}/")):
            hasher.update(f"{digest_file(folder / name)}  {name}\n".encode())
    return hasher.hexdigest()[:16]


def _count_families(rows: Sequence[Row]) -> str:
    table = pd.DataFrame(rows)
    lines = [
        "| family | seeds | pairs | scans before | scans after | changes | observable | rock | MB |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for family, own in [*table.groupby("family"), ("all", table)]:
        seeds = "" if family == "all" else ", ".join(map(str, sorted(own["seed"])))
        lines.append(f"| {visible(str(family))} | {seeds} | {len(own)} | {_format_sums(own[list(_SUMMED)].sum())} |")
    return "\n".join(lines)


def _format_sums(sums: Mapping[str, int]) -> str:
    counts = [f"{sums[name]:,}" for name in _SUMMED if name != "bytes"]
    return " | ".join([*counts, f"{sums['bytes'] / 1e6:.0f}"])
