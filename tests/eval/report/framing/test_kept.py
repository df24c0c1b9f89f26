"""A page made again from tables alone keeps what an earlier page showed, as text and pictures and nothing else."""

import base64
import io
import re
import shutil
import struct
import zlib
from pathlib import Path

import pytest
from PIL import Image

from cdpipe.core.errors import InputError
from eval.report.framing.kept import is_picture, read_kept
from eval.report.page import write_page
from tests.eval.report.test_page import report, result_row, run, tables_of, whole  # noqa: F401

PICTURE = re.compile(r'<img src="(data:image/[^"]*)" alt="([^"]*)"')


def address(kind: str = "png", size: tuple[int, int] = (4, 4)) -> str:
    buffer = io.BytesIO()
    Image.new("RGB", size).save(buffer, format=kind)
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def test_pictures_and_tables_of_answers_survive_the_loss_of_what_made_them(run: Path) -> None:  # noqa: F811
    first = write_page(run, "none")
    before, tables = first.read_text(), tables_of(first)
    assert len(PICTURE.findall(before)) == 9
    for name in ("pairs", "answers", "maps"):
        shutil.rmtree(run / name)
    (run / "regions.csv").unlink()
    kept = write_page(run, "none", keeps=True)
    assert sorted(PICTURE.findall(kept.read_text())) == sorted(PICTURE.findall(before))
    assert tables_of(kept) == tables
    missing = kept.read_text().partition('id="missing"')[2].partition("</ul>")[0]
    assert "those of an earlier page" in missing and "regions.csv is not in the run folder" in missing
    assert "cannot be read" not in missing and "maps" not in missing  # the sentence above says it of all pairs
    again = write_page(run, "none", keeps=True)
    assert sorted(PICTURE.findall(again.read_text())) == sorted(PICTURE.findall(before))
    assert tables_of(again) == tables
    assert PICTURE.findall(write_page(run, "none").read_text()) == []


def test_figures_of_the_tables_win_over_those_of_the_page(run: Path) -> None:  # noqa: F811
    page = write_page(run, "none")
    page.write_text(page.read_text().replace("0.93", "0.11"))
    assert (
        "0.11"
        not in write_page(run, "none", keeps=True).read_text().partition('id="results"')[2].partition("</table>")[0]
    )


def test_what_a_page_of_a_stranger_holds_is_text(run: Path) -> None:  # noqa: F811
    bad = "<script>alert(1)</script>"
    escaped = bad.replace("<", "&lt;")
    (run / "index.html").write_text(
        f'<h2 id="regions">x</h2><script>alert(2)</script><figure><p class="title">{escaped}</p>'
        f'<img src="{address()}" onerror="alert(3)"><figcaption>{escaped}<b onclick="alert(4)">c</b></figcaption>'
        "</figure>"
        '<figure><p class="title">no picture</p><img src="javascript:alert(5)"></figure>'
        f'<h2 id="merge">m</h2><table><caption>mine {escaped}</caption><tr><th>a</th></tr>'
        f"<tr><td>{escaped}</td></tr></table>"
    )
    text = write_page(run, "none", keeps=True).read_text()
    assert text.count("<script>") == 1 and "onerror" not in text and "onclick" not in text and "javascript:" not in text
    assert "no picture" not in text
    assert "&lt;script&gt;alert(1)" in text


@pytest.mark.parametrize(
    "other",
    ["", "x.png", "http://x/y.png", "data:text/html;base64,AAAA", "data:image/svg+xml;base64,AAAA",
     "data:image/png;base64,AAAA", f"{address()}\" onerror=\"x", address().replace("png", "webp", 1)],
)  # fmt: skip
def test_only_whole_pictures_are_pictures(other: str) -> None:
    assert is_picture(address()) and is_picture(address("webp"))
    assert not is_picture(other)


def test_a_picture_that_would_fill_the_memory_is_none() -> None:
    assert not is_picture(address(size=(20_000, 2_001)))


def test_a_page_that_cannot_be_read_is_refused_on_one_line(tmp_path: Path) -> None:
    page = tmp_path / "index.html"
    page.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(InputError, match=r"index\.html") as caught:
        read_kept(page)
    assert "\n" not in str(caught.value)
    assert read_kept(tmp_path / "none.html").tables == {}


@pytest.mark.parametrize(
    "text", ["</td></tr></table>", "</table>", "<tr></tr>", "<td>x", "</figure></li></h2>", "<![foo[ x"]
)
def test_a_page_with_tags_out_of_place_is_read_or_refused_on_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "index.html").write_text(text)
    try:
        assert all(table.caption == "" for table in read_kept(tmp_path / "index.html").tables.values())
    except InputError as error:
        assert "index.html: no page of `tunnelcd report`" in str(error) and "\n" not in str(error)


def test_a_text_in_many_pieces_is_one_text(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text('<h2 id="x">' + "y<i>" * 1000 + "</h2>")
    assert read_kept(tmp_path / "index.html").titles == {"x": "y" * 1000}


def png_of(width: int, height: int) -> str:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    content = b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return f"data:image/png;base64,{base64.b64encode(content).decode()}"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [(10_000, 10_000), (20_000, 20_000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_a_picture_that_says_it_is_huge_is_none(size: tuple[int, int]) -> None:
    assert not is_picture(png_of(*size))
