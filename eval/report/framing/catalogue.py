"""The index of a folder of reports: one offline page that leads to the page and the notes of each, or to its files."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cdpipe.core.errors import InputError
from eval.core.output import require_no_links, require_replaceable
from eval.core.tablefile import table_file
from eval.report.render import render_page, write_file
from eval.running.runfolder import read_json

_KINDS = {"notes": (".md",), "tables": (".csv", ".xz"), "pictures": (".png", ".jpg", ".svg")}
_QUESTION = re.compile(r"\| \[[^\]|]+\]\(([^)|]+)\) \| ([^|]+) \|")
_ANSWER = re.compile(r'<p class="answer">([^<]*)</p>')
_HEAD_BYTES = 100_000
_MARK = b"<title>Reports (tunnelcd)</title>"


@dataclass(frozen=True, slots=True)
class Report:
    """One report: its name, question and answer, of what it is, and the addresses of its files.

    Attributes:
        name: Its folder, below the folder of all.
        question: What it is about, of the README of all reports or of its plan.
        answer: The first sentence of its page, "" where there is none.
        plan: The plan that was run, "" where it is no run.
        finished: The day, "" where that is not known.
        page: Address of its page, or of its first note; "" where there is neither.
        contents: How many files of which kind.
        files: (address, name) of each; of a report with a page its notes alone.
    """

    name: str
    question: str
    answer: str
    plan: str
    finished: str
    page: str
    contents: str
    files: Sequence[tuple[str, str]]


def write_index(folder: Path) -> Path:
    """Write `index.html` into a folder of reports.

    Returns:
        Path of the page.

    Raises:
        InputError: It is no folder, is a report itself, holds a link, no report or another page, or cannot be written.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: name a folder of reports, as `reports`")
    require_no_links(folder)
    for own in (table_file(folder / "results.csv"), folder / "provenance.json"):
        if own.exists():
            raise InputError(f"{folder}: is itself a report ({own.name}): name the folder that holds it")
    require_replaceable(folder / "index.html", _MARK, "index of `tunnelcd report --index`")
    reports = list_reports(folder)
    if not reports:
        raise InputError(f"{folder}: holds no report: expected folders with a page, tables, pictures or notes")
    write_file(folder / "index.html", render_page("index.html", {"reports": reports}))
    return folder / "index.html"


def list_reports(folder: Path) -> list[Report]:
    """Return every report of a folder by its name: each folder in it that holds files, apart from notes."""
    readme = folder / "README.md"
    rows = _QUESTION.findall(readme.read_text(encoding="utf-8", errors="replace")) if readme.is_file() else []
    questions = {address.removesuffix("/README.md"): words.replace("`", "") for address, words in rows}
    found = []
    for each in sorted(path for path in folder.rglob("*") if path.is_dir() and path.name != "notes"):
        report = _read_report(folder, each, questions)
        if report.page or report.files:
            found.append(report)
    return found


def _first_sentence(text: str) -> str:
    words = " ".join(text.split())
    return re.split(r"(?<=[.?!]) ", words, maxsplit=1)[0][:200]


def _read_report(folder: Path, own: Path, questions: Mapping[str, str]) -> Report:
    name = own.relative_to(folder).as_posix()
    provenance = read_json(own / "provenance.json")
    plan = provenance.get("plan")
    described: Mapping[str, Any] = plan if isinstance(plan, Mapping) else {}
    files = sorted(path for path in (*own.iterdir(), *own.glob("notes/*")) if path.is_file())
    page = own / "index.html"
    by_kind = {kind: [path for path in files if path.suffix in suffixes] for kind, suffixes in _KINDS.items()}
    first = next((_address(folder, path) for path in by_kind["notes"]), "")
    # a page shows its pictures and names its tables
    linked = by_kind["notes"] if page in files else [path for paths in by_kind.values() for path in paths]
    return Report(
        name=name,
        question=questions.get(name) or _first_sentence(str(described.get("description") or "")),
        answer=_read_answer(page) if page in files else "",
        plan=", ".join(str(described[key]) for key in ("name", "split") if described.get(key)),
        finished=str(provenance.get("finished") or "")[:10],
        page=_address(folder, page) if page in files else first,
        contents=", ".join(
            f"{len(paths)} {kind if len(paths) > 1 else kind[:-1]}" for kind, paths in by_kind.items() if paths
        ),
        files=[(_address(folder, path), path.name) for path in linked],
    )


def _address(folder: Path, path: Path) -> str:
    return quote(os.fsencode(path.relative_to(folder).as_posix()))


def _read_answer(page: Path) -> str:
    """Return the sentence at the head of a page as text."""
    with page.open(encoding="utf-8", errors="replace") as file:
        found = _ANSWER.search(file.read(_HEAD_BYTES))
    return html.unescape(found[1]) if found else ""
