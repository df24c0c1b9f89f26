"""What an earlier page of a run showed, kept where the folder no longer holds what it was drawn from.

A committed report has tables and no sessions, answers or lists. A page made from it again keeps from the page that lies
there: pictures, tables, or those with more figures than can be made now. Only texts and pictures are taken over, and
every picture is decoded once: whatever else an earlier page holds does not reach the new one.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from PIL import Image

from cdpipe.core.errors import InputError
from eval.report.site.site import Site
from eval.report.site.worst import WorstPair
from eval.report.tables import Cell, Picture, Section, Table
from eval.tables.columns import UNDEFINED

_LARGEST_BYTES, _MOST_PIXELS = 64_000_000, 40_000_000
_ADDRESS = re.compile(r"data:image/(png|webp);base64,([A-Za-z0-9+/]+=*)")
_FROM_EARLIER = "From an earlier page of this run, in the colours of then."
_KEPT = "Sessions and answers are not beside this page: pictures and tables made of them are those of an earlier page."
# what that sentence says of each pair
_COVERED = re.compile("The (stored answer of|maps for pictures|aligned maps of|truth of) ")
_LONE = {"settings": "settings", "table1": "paper", "table2": "paper"}  # the others need results.csv alone
_TABLED = ("regions", "objects", "surface", "merge")


@dataclass(slots=True)
class KeptPage:
    """What a page shows: tables by caption, and pictures with the heading above them by section."""

    tables: dict[tuple[str, str], Table] = field(default_factory=dict)
    pictures: dict[str, list[tuple[str, Picture]]] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)

    def of_site(self, title: str) -> list[tuple[str, Picture]]:
        """Return the pictures of the section with a title."""
        return [each for key, words in self.titles.items() if words == title for each in self.pictures.get(key, ())]


def read_kept(page: Path) -> KeptPage:
    """Return what a page of ours shows; empty where there is none.

    Raises:
        InputError: It cannot be read, or is larger than 64 MB.
    """
    if not page.is_file():
        return KeptPage()
    try:
        if page.stat().st_size > _LARGEST_BYTES:
            raise InputError(f"{page}: larger than 64 MB: expected a page of `tunnelcd report`, or leave out --keep")
        content = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{page}: cannot be read, so nothing of it can be kept: {error}") from error
    reader = _Reader()
    try:
        reader.feed(content)
    except AssertionError as error:  # of html.parser, where a declaration is malformed
        raise InputError(f"{page}: no page of `tunnelcd report` ({error!s:.200}): leave out --keep") from error
    return reader.found


def keep(content: Mapping[str, Any], kept: KeptPage) -> dict[str, Any]:
    """Return the content of a page with what an earlier one showed besides."""
    found = dict(content)
    for name, section in _LONE.items():
        if name in found:
            found[name] = _fuller(found[name], section, kept)
    for name in _TABLED:
        if found.get(name) is not None:
            found[name] = _with_tables(found[name], name, kept)
    shown = set(_titles(found))
    found["sites"] = [_keep_site(site, kept) for site in found.get("sites", ())]
    found["worst"] = [_keep_worst(place, pair, kept) for place, pair in enumerate(found.get("worst", ()), 1)]
    of_sites = {site.scenario for site in found["sites"]}
    taken = {"worst", *(key for key, words in kept.titles.items() if words in of_sites)}
    found["kept_pictures"] = {
        key: [replace(each, caption=_noted(each.caption)) for _, each in pictures if each.title not in shown]
        for key, pictures in kept.pictures.items() if key not in taken
    }  # fmt: skip
    if kept.tables:
        found["missing"] = [*(line for line in found["missing"] if not _COVERED.match(line)), _KEPT]
    return found


def _noted(caption: str) -> str:
    return caption if _FROM_EARLIER in caption else f"{caption} {_FROM_EARLIER}".strip()


def _titles(content: Mapping[str, Any]) -> Iterable[str]:
    """Yield the titles of all charts and pictures that a page shows outside of its sites."""
    for name in _TABLED:
        part = content.get(name)
        if part is not None:
            yield from (each.title for each in (*part.plots, *part.pictures))
    yield from (chart.title for chart in content["charts"])
    yield from (part.chart.title for part in content.get("effects", ()) if part.chart is not None)


def _fuller(table: Table, section: str, kept: KeptPage) -> Table:
    """Return the table of that caption that has more figures; that of the earlier page says that it is."""
    captions = (table.caption, _noted(table.caption))
    earlier = next((kept.tables[section, each] for each in captions if (section, each) in kept.tables), table)
    if _count_filled(earlier) <= _count_filled(table):
        return table
    return replace(earlier, caption=_noted(earlier.caption))


def _count_filled(table: Table) -> int:
    cells = [cell for _, row in table.rows for cell in row]
    return sum(cell.text not in ("", UNDEFINED) for cell in cells) + sum(bool(cell.interval) for cell in cells)


def _with_tables(part: Section, name: str, kept: KeptPage) -> Section:
    """Return a section with the fuller of its tables, and behind them those that only the earlier page had."""
    tables, cases = (tuple(_fuller(each, name, kept) for each in tables) for tables in (part.tables, part.cases))
    captions = {_noted(each.caption) for each in (*tables, *cases)}
    lost = tuple(
        replace(each, caption=_noted(caption))
        for (key, caption), each in kept.tables.items() if key == name and _noted(caption) not in captions
    )  # fmt: skip
    return replace(part, tables=(*tables, *lost), cases=cases)


def _keep_site(site: Site, kept: KeptPage) -> Site:
    if site.maps or site.regions or site.objects:
        return site
    pictures = kept.of_site(site.scenario)
    above, below = ([each for heading, each in pictures if bool(heading) == is_object] for is_object in (False, True))
    return replace(site, maps=tuple(above), objects=tuple(below), missing=() if pictures else site.missing)


def _keep_worst(place: int, pair: WorstPair, kept: KeptPage) -> WorstPair:
    heading = f"{place}. {pair.scenario}, seed {pair.seed}"
    found = [each for words, each in kept.pictures.get("worst", ()) if words == heading]
    return replace(pair, picture=found[0]) if found and pair.picture is None else pair


class _Reader(HTMLParser):
    """Collects the tables and pictures of a page as text, by the section in which they stand."""

    def __init__(self) -> None:
        super().__init__()
        self.found = KeptPage()
        self._section, self._heading, self._address = "", "", ""
        self._texts: dict[str, list[str]] = {}  # in pieces: a text may come in very many
        self._part = ""
        self._group = ""
        self._rows: list[tuple[str, tuple[Cell, ...]]] = []
        self._opened = ("", False, False)  # tag of a cell, whether it is a best one, whether it heads a group
        self._cells: list[tuple[str, bool, Cell]] = []
        self._headings: tuple[str, ...] = ()
        self._depth_of_summary = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {name: value or "" for name, value in attrs}
        classes = named.get("class", "").split()
        if "id" in named and (tag == "h2" or (tag == "details" and "section" in classes) or named["id"] == "summary"):
            self._section, self._heading = named["id"], ""
        if tag in ("h2", "h3", "caption", "figcaption") or (tag == "p" and "title" in classes):
            self._part = "title" if tag == "p" else tag
            self._texts[self._part] = []
        elif tag == "table":
            self._group, self._rows, self._headings = "", [], ()
            self._texts["caption"] = []
        elif tag == "tr":
            self._cells = []
        elif tag in ("td", "th"):
            self._opened = tag, "best" in classes, "group" in classes
            self._part, self._texts["cell"], self._texts["interval"] = "cell", [], []
        elif tag == "small" or "interval" in classes:
            self._part = "interval"
        elif tag == "img":
            self._address = named.get("src", "")

    def handle_data(self, data: str) -> None:
        if self._part:
            self._texts.setdefault(self._part, []).append(data)

    def _text(self, part: str) -> str:
        return "".join(self._texts.get(part, ()))

    def handle_endtag(self, tag: str) -> None:
        handlers = {"td": self._end_cell, "th": self._end_cell, "tr": self._end_row, "table": self._end_table,
                    "figure": self._end_figure}  # fmt: skip
        if tag in handlers:
            handlers[tag]()
        elif tag == "h2":
            self.found.titles[self._section] = self._text("h2").strip()
        elif tag == "h3":
            self._heading = self._text("h3").strip()
        if tag not in ("small", "span", "a", "code"):
            self._part = ""

    def _end_cell(self) -> None:
        kind, is_best, is_group = self._opened
        self._cells.append((kind, is_group, Cell(self._text("cell"), is_best, self._text("interval"))))

    def _end_row(self) -> None:
        cells = [cell for _, _, cell in self._cells]
        if self._cells and self._cells[0][1]:
            self._group = cells[0].text
        elif self._cells and all(kind == "th" for kind, _, _ in self._cells):
            self._headings = tuple(cell.text for cell in cells)
        elif cells:
            self._rows.append((self._group, tuple(cells)))

    def _end_table(self) -> None:
        caption = self._text("caption")
        self.found.tables.setdefault((self._section, caption), Table(self._headings, tuple(self._rows), caption))

    def _end_figure(self) -> None:
        address, self._address = self._address, ""
        if is_picture(address):
            picture = Picture(self._text("title"), address, self._text("figcaption"))
            self.found.pictures.setdefault(self._section, []).append((self._heading, picture))


def is_picture(address: str) -> bool:
    """Tell whether an address holds a whole PNG or WebP picture, and nothing else."""
    match = _ADDRESS.fullmatch(address)
    if match is None:
        return False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is looked at here
            image = Image.open(io.BytesIO(base64.b64decode(match[2], validate=True)), formats=[match[1].upper()])
        if not 0 < image.width * image.height <= _MOST_PIXELS:
            return False
        image.load()
    except Exception:  # PIL lets through whatever a damaged picture provokes
        return False
    return True
