"""Names from files are shown by the page, its charts, pictures and LaTeX tables as they are, and do nothing."""

from __future__ import annotations

import csv
import html
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from eval.core.charts import Axis, Drawing, Heat, Panel, Series
from eval.core.figures import picture, png
from eval.report.comparing.page import compare_sides, write_comparison
from eval.report.latex import to_latex
from eval.report.page import write_page
from eval.report.tables import Cell, Table
from eval.running.results.sides import read_side
from eval.running.runfolder import write_json
from tests.eval.report.test_page_browser import needs_browser, opened

RUN = "document.title='owned'"
HOSTILE = (
    "<!--<script>", f"</script><script>{RUN}</script>", f"<img src=x onerror=\"{RUN}\">\" onmouseover=\"{RUN}\" x=\"",
    "<b>bold</b> &lt;i&gt; <a href=\"javascript:alert(1)\">x</a>", "%{x} %{y:.3f} {{ 7 * 7 }} {% include 'page.css' %}",
    r"$\frac$ \input{/etc/passwd}", "_hidden $x_1$ and $y", "a\x1b[2Jb\u202ec\u2028]]>-->", "[2cm] *", "*",
    '=1+cmd|"/C calc"!A0', "+1-2+cmd|x!A0",
)  # fmt: skip
PLAIN = tuple(f"method {place}" for place in range(len(HOSTILE)))


def shown(name: str) -> str:
    return name.replace("\x1b", r"\x1b").replace("\u202e", r"\u202e").replace("\u2028", r"\u2028")


def write_run(folder: Path, methods: tuple[str, ...]) -> Path:
    """Write a run of two worlds, called as badly as the methods, with a grid, a factor and every table of the page."""
    folder.mkdir()
    worlds = [f"{methods[0]}/one", f"{methods[1]}/two"]
    rows: list[dict[str, Any]] = []
    for place, name in enumerate(methods):
        share = 0.9 - 0.02 * place
        rows += [
            {"scenario": world, "family": world, "seed": seed, "variant": name, "preset": name, "status": "ok",
             "error": "", "is_unchanged_pair": False, "n_observable": 4, "after_path_m": 200.0, "score_radius_m": 4.5,
             "region_recall": share, "region_recall_at_k": share, "region_auroc": share, "object_iou_point": share,
             "object_f1_50": share, "t_total_s": 1.0 + place, "bytes_regions_before": 1e4 * (1 + place),
             "pair_kind": "clean",
             "merge_error_m": 0.01 * place, "merge_error_deg": 0.1, "overlap_true": 0.9, "t_merge_s": 0.5}
            for world in worlds for seed in (1, 2)
        ]  # fmt: skip
    rows[-1] |= {"status": "failed", "error": methods[0]}
    for a in range(2):
        rows += [{**rows[0], "variant": f"{methods[0]}[{methods[1]}=1{a},b={b}]", "object_iou_point": 0.1 * (a + b)}
                 for b in range(2)]  # fmt: skip
    rows += [{**rows[0], "variant": f"f[{methods[4]}={methods[5]}{a}]", "object_iou_point": 0.1 * a} for a in range(2)]
    pd.DataFrame(rows).to_csv(folder / "results.csv", index=False)
    provenance = {"plan": {"name": methods[0], "targets": {}}, "command": methods[1], "machine": {"cpu": methods[2]}}
    write_json(folder / "provenance.json", {"tool": "tunnelcd", **provenance})
    return folder


class _Elements(HTMLParser):
    """Collects every element with the names of its attributes, and comments."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.add(f"{tag} {sorted(name for name, _ in attrs)}")
        self.found |= {f"{name}={value}" for name, value in attrs if name in ("href", "src") and value[:1] not in "#d"}

    def handle_comment(self, data: str) -> None:
        self.found.add("comment")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("named")
    return {name: write_page(write_run(folder / name, names)) for name, names in (("bad", HOSTILE), ("good", PLAIN))}


def test_names_add_no_element_attribute_or_address(pages: dict[str, Path]) -> None:
    found = {name: _Elements(page.read_text()).found for name, page in pages.items()}
    assert found["bad"] == found["good"]
    assert pages["bad"].read_text().count("<script>") == 1


def test_every_name_stands_on_the_page_as_it_is(pages: dict[str, Path]) -> None:
    text = html.unescape(pages["bad"].read_text())
    assert [name for name in map(shown, HOSTILE) if name not in text] == []
    assert not re.search("[\x1b\u202e\u2028]", text)


def test_no_name_is_a_formula_in_a_table_beside_the_page(pages: dict[str, Path], tmp_path: Path) -> None:
    sides = [read_side(f"{pages['bad'].parent}:{name}") for name in HOSTILE[-2:]]
    write_comparison(compare_sides(*sides), tmp_path)
    tables = [path for path in pages["bad"].parent.glob("*.csv") if path.name != "results.csv"] + [
        *tmp_path.glob("*.csv")
    ]
    cells = [cell for path in tables for row in csv.reader(path.read_text().splitlines()) for cell in row]
    assert {path.name for path in tables} >= {"comparison.csv", "merge.csv", "pareto.csv", "table1.csv"}
    assert any(cell.startswith("'=1+cmd") for cell in cells) and any(cell.startswith("'+1-2+cmd") for cell in cells)
    assert not [cell for cell in cells if re.match(r"[=@]|[+-].*[a-z|!]", cell)]


@needs_browser
def test_every_chart_is_drawn_and_nothing_is_executed(pages: dict[str, Path], tmp_path: Path) -> None:
    dom, complaints = opened(pages["bad"], tmp_path, "--dump-dom")
    assert complaints == ""
    assert "<title>owned" not in dom and 'src="x"' not in dom
    charts = re.split(r'class="chart[^"]*" id="', dom)[1:]
    assert {chart.partition('"')[0] for chart in charts} >= {"by_scenario", "pareto_regions", "grid_1", "factor_1"}
    legend = html.unescape(next(chart for chart in charts if chart.startswith("by_scenario")).partition("</figure>")[0])
    for name in map(shown, HOSTILE):
        assert f"</svg>{name}</button>" in legend


def test_the_comparison_page(pages: dict[str, Path], tmp_path: Path) -> None:
    found = {}
    for name, methods in (("bad", HOSTILE), ("good", PLAIN)):
        a, b = (read_side(f"{pages[name].parent}:{methods[place]}") for place in (0, 1))
        found[name] = _Elements(write_comparison(compare_sides(a, b), tmp_path / name).read_text()).found
    assert found["bad"] == found["good"]


@pytest.mark.parametrize("name", HOSTILE)
def test_pictures_of_matplotlib(name: str) -> None:
    line = Series([0, 1], [0, 1], name=name, labels=[name, ""])
    series = [line, Series([0, 1], [1, 2], name=f"{name}2", style="bars")]
    heat = Heat(np.eye(2), [[name, ""], ["", ""]], 0.0, 1.0)
    x = Axis(name, ticks={0.0: name, 1.0: "b"})
    figure = picture(Drawing([[Panel(x, Axis(name), series, name, heat)]], 200))
    assert png(figure)
    (legend,) = figure.legends
    names = [shown(text).replace("$", r"\$") for text in (name, f"{name}2")]
    assert [text.get_text() for text in legend.get_texts()] == names


def test_latex_sets_names_as_text() -> None:
    rows = tuple((name, (Cell(name, True),)) for name in HOSTILE)
    source = to_latex(Table(("method",), rows))
    body = source.partition(r"\midrule")[2].partition(r"\bottomrule")[0]
    lines = [line for line in body.splitlines() if line.strip()]
    assert len(lines) == len(HOSTILE)
    known = r"\\(textbf|textbackslash|textasciitilde|textasciicircum|[&%$#_{},])"
    for line in lines:
        assert line.endswith(r" \\") and not line.lstrip().startswith(("[", "*"))
        left = re.sub(known, "", line.removesuffix(r"\\"))
        assert not re.search(r"[\\%$#~^]", left), line
        assert left.count("&") == 1
    assert r"\textbackslash{}input\{/etc/passwd\}" in body
