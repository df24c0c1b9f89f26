"""The index of reports leads to all of them, and names of folders and texts of files are text in it."""

import html
import os
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest

from cdpipe.core.errors import InputError
from eval.report.framing.catalogue import list_reports, write_index
from eval.running.runfolder import write_json

REPORTS = Path(__file__).parents[4] / "reports"
MAX_BYTES = 30_000


def links(page: Path) -> list[str]:
    return [html.unescape(link) for link in re.findall(r'href="([^"]*)"', page.read_text())]


def test_the_committed_index_leads_to_every_report_and_every_link_leads_somewhere() -> None:
    found = links(REPORTS / "index.html")
    assert [link for link in found if not (REPORTS / unquote(link)).is_file()] == []
    assert {path.name for path in REPORTS.iterdir() if path.is_dir()} == {link.partition("/")[0] for link in found}
    pages = {path.relative_to(REPORTS).as_posix() for path in REPORTS.rglob("*/index.html")}
    assert pages <= set(found)
    assert {path.relative_to(REPORTS).as_posix() for path in REPORTS.rglob("*.md")} - {"README.md"} <= set(found)


def test_the_committed_index_is_small_and_the_one_that_the_command_makes(tmp_path: Path) -> None:
    committed = (REPORTS / "index.html").read_bytes()
    assert len(committed) < MAX_BYTES
    copy = Path(shutil.copytree(REPORTS, tmp_path / "reports", ignore=shutil.ignore_patterns("index.html~")))
    assert write_index(copy).read_bytes() == committed, "`tunnelcd report reports --index` makes it anew"


def test_nothing_is_fetched(tmp_path: Path) -> None:
    text = re.sub(r"<script\b.*?</script>", "", (REPORTS / "index.html").read_text(), flags=re.DOTALL)
    assert not re.search(r"http|src=|url\(|@import", text)


def test_a_report_is_what_its_files_say(tmp_path: Path) -> None:
    run = tmp_path / "one"
    (run / "notes").mkdir(parents=True)
    (run / "notes" / "a note.md").write_text("# A")
    (run / "results.csv.xz").write_bytes(b"")
    (run / "index.html").write_text('<p class="answer">a &lt;b&gt; (1.00)</p>')
    plan = {"name": "main", "split": "sealed", "description": "Who wins? And why."}
    write_json(run / "provenance.json", {"plan": plan, "finished": "2026-11-25T19:40:44"})
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "a.png").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    one, two = list_reports(tmp_path)
    assert (one.question, one.answer, one.plan, one.finished) == (
        "Who wins?", "a <b> (1.00)", "main, sealed", "2026-11-25"
    )  # fmt: skip
    assert (one.page, one.contents, one.files) == (
        "one/index.html", "1 note, 1 table", [("one/notes/a%20note.md", "a note.md")]
    )  # fmt: skip
    assert (two.page, two.files) == ("", [("two/a.png", "a.png")])
    (tmp_path / "README.md").write_text("| [one](one) | What does `one` do? | x |\n")
    assert list_reports(tmp_path)[0].question == "What does one do?"


def test_names_and_texts_are_no_markup(tmp_path: Path) -> None:
    bad = "<img src=x onerror=alert(1)>"
    run = tmp_path / bad
    run.mkdir()
    (run / 'a" onclick="x.csv').write_text("")
    write_json(run / "provenance.json", {"plan": {"name": bad, "description": bad}, "finished": bad})
    (tmp_path / "README.md").write_text(f"| [x]({bad}) | <script>{bad}</script> | |\n")
    text = write_index(tmp_path).read_text()
    assert "<img" not in text and text.count("<script>") == 1 and not re.search(r'<a [^>]*onclick="', text)
    assert html.escape(bad) in text


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_folder_without_reports_is_refused_on_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=name) as caught:
        write_index(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / name / "index.html").exists()


@pytest.mark.parametrize("name", ["results.csv", "results.csv.xz", "provenance.json"])
def test_a_folder_that_is_a_run_keeps_its_page(tmp_path: Path, name: str) -> None:
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "a.png").write_bytes(b"")
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"is itself a report.*name the folder that holds it") as caught:
        write_index(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "index.html").exists()


def test_only_an_earlier_index_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "a.md").write_text("# A")
    page = tmp_path / "index.html"
    page.write_text("<!doctype html><title>main: a run (tunnelcd)</title>")
    with pytest.raises(InputError, match="is no index of"):
        write_index(tmp_path)
    assert "main: a run" in page.read_text()
    page.unlink()
    first = write_index(tmp_path).read_text()
    (tmp_path / "one" / "b.md").write_text("# B")
    assert write_index(tmp_path).read_text() != first


def test_a_name_that_is_not_utf_8_is_an_address(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    odd = os.fsdecode(b"\xff\xfe.md")
    (tmp_path / "one" / odd).write_text("# A")
    found = links(write_index(tmp_path))
    assert "one/%FF%FE.md" in found and r"\udcff\udcfe.md" in (tmp_path / "index.html").read_text()
