"""Croissant 1.0 metadata (JSON-LD of MLCommons) of a folder of data: its files, and the columns of one table.

The specification: http://mlcommons.org/croissant/1.0. `context.json` is the context that it prescribes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from cdpipe.core.names import visible
from cdpipe.core.whole_file import whole_file

FILE = "croissant.json"
LICENCE = "https://spdx.org/licenses/MIT.html"
_PAPER = "https://arxiv.org/abs/2306.15416"
_CITE = (
    "@misc{tunnelcd, title={tunnelcd: a benchmark for change detection between two LiDAR sessions of a tunnel}, "
    "author={{The tunnelcd authors}}, year={2026}}"
)
_TYPES = {"text": "sc:Text", "whole": "sc:Integer", "number": "sc:Float", "truth": "sc:Boolean"}


@dataclass(frozen=True, slots=True)
class FileGroup:
    """Files of one kind: a name, what they hold, their type, and a pattern of their paths."""

    name: str
    description: str
    encoding: str
    pattern: str


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table: its type is text, whole, number or truth."""

    name: str
    type: str
    description: str


@dataclass(frozen=True, slots=True)
class Table:
    """The CSV file that has one row per item: path from the folder, SHA-256, what a row is, the columns."""

    path: str
    sha256: str
    row: str
    columns: tuple[Column, ...]


def describe_croissant(
    name: str,
    description: str,
    version: str,
    groups: Sequence[FileGroup],
    table: Table,
    published: str | None = None,
    licence: str = LICENCE,
) -> dict[str, Any]:
    """Return the metadata document.

    Args:
        name: Of the data.
        description: What they are.
        version: Of the tunnelcd that made them, "0.1.0".
        groups: Files by kind.
        table: The table that lists the items.
        published: Day, ISO 8601; None for data that were not published.
        licence: Address of the licence, or words.
    """
    context = json.loads((resources.files("eval") / "release" / "context.json").read_text(encoding="utf-8"))
    return {
        "@context": context,
        "@type": "sc:Dataset",
        "name": visible(name),
        "description": visible(description),
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "license": licence,
        "url": _PAPER,
        "citeAs": _CITE,
        "version": version,
        **({} if published is None else {"datePublished": published}),
        "distribution": [_describe_table(table), *map(_describe_group, groups)],
        "recordSet": [_describe_rows(table)],
    }


def write_croissant(folder: Path, document: Mapping[str, Any]) -> None:
    """Write croissant.json, complete or not at all."""
    with whole_file(folder / FILE) as partial:
        partial.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _describe_table(table: Table) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": table.path,
        "name": table.path,
        "description": table.row,
        "contentUrl": table.path,
        "encodingFormat": "text/csv",
        "sha256": table.sha256,
    }


def _describe_group(group: FileGroup) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": group.name,
        "name": group.name,
        "description": group.description,
        "encodingFormat": group.encoding,
        "includes": group.pattern,
    }


def _describe_rows(table: Table) -> dict[str, Any]:
    name = Path(table.path).stem
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": table.row,
            "field": [_describe_column(name, table, each) for each in table.columns]}  # fmt: skip


def _describe_column(rows: str, table: Table, column: Column) -> dict[str, Any]:
    return {
        "@type": "cr:Field",
        "@id": f"{rows}/{column.name}",
        "name": column.name,
        "description": column.description,
        "dataType": _TYPES[column.type],
        "source": {"fileObject": {"@id": table.path}, "extract": {"column": column.name}},
    }
