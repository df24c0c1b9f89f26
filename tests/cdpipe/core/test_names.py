import io
import re
from pathlib import Path

import pandas as pd
import pytest

from cdpipe.core.names import LONGEST, bare, folded, path_part, require_name, require_table_name, visible

HOSTILE = (
    "", ".", "..", "...", "/", "../..", "../../etc/passwd", ".hidden", "a/b", "a\\b", "C:\\x", "a\0b", "a\nb", "CON",
    "nul.txt", "com1", "x.", "x ", " ", "~", "-rf", "*", "$HOME", "ä", "日本", "\ud800", "\x1b[31m", "n" * 5000,
    "." * 300, "\u202egpj",
)  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_path_part_stays_in_its_folder_on_every_system(name: str, tmp_path: Path) -> None:
    part = path_part(name)
    assert re.fullmatch(r"[A-Za-z0-9_=,-][A-Za-z0-9._=,-]*", part)
    assert len(part) <= LONGEST and not part.endswith(".")
    assert part.partition(".")[0].lower() not in {"con", "nul", "com1"}
    (tmp_path / f".{part}.json.partial").write_text("")  # the longest name that is made of it
    assert (tmp_path / part).resolve().parent == tmp_path.resolve()
    assert path_part(part) == part


def test_shipped_names_keep_their_folders() -> None:
    for name in ("tunnelcd", "paper-topn", "site1", "narrow_platform.speed_mps=0.5_", "oracle-merge"):
        assert path_part(name) == name
    assert (
        path_part("tunnelcd[query.radius_m=3,extract.voxel_m=0.4]") == "tunnelcd_query.radius_m=3,extract.voxel_m=0.4_"
    )


def test_long_names_that_begin_alike_stay_apart() -> None:
    assert path_part("n" * 5000) != path_part("n" * 5001)
    assert path_part("n" * LONGEST) == "n" * LONGEST


@pytest.mark.parametrize("names", [("my method", "my_method"), ("A", "a"), ("x[a=1]", "x_a=1_"), ("..", "_..")])
def test_names_that_would_share_a_folder_are_equal_when_folded(names: tuple[str, str]) -> None:
    assert folded(names[0]) == folded(names[1])


@pytest.mark.parametrize("name", ["", "..", "___", "ä", "n" * 201, "a\x1bb", "a\nb", "a\u202eb", "paper ", "\u3000a"])
def test_what_is_no_name(name: str) -> None:
    with pytest.raises(ValueError, match=r"name|too long"):
        require_name(name)


@pytest.mark.parametrize(
    ("one", "other", "is_one"),
    [
        ("mine", "Mine", True), ("mine", "mi\u2060ne ", True), ("mine", "\uff4d\uff49\uff4e\uff45", True),
        ("qed", "q\u0323ed", True), ("1", "1\u0301", True), ("\u03b1\u03b2", "\u03b1\u03b2\u0323", True),
        ("\u0e01", "\u0e01\ufe0f", True), ("\u0e01\u0e34", "\u0e01\u0e34\u0e34", True), ("m", "m\u0e34", True),
        ("\u0e01\u0e34", "\u0e01\u0e38", False), ("\u0e01\u0e34", "\u0e01", False),
        ("\u0915\u093f", "\u0915\u0941", False), ("\u0915\u093e", "\u0915", False), ("mine", "mine2", False),
    ],
)  # fmt: skip
def test_names_that_a_reader_takes_for_one(one: str, other: str, is_one: bool) -> None:
    assert (bare(one) == bare(other)) is is_one


def test_what_a_table_reads_as_something_else_is_no_name_there() -> None:
    for name in ("NA", "<NA>", "null", "1e5", "007", "inf", "True", "#N/A", "-nan"):
        read = pd.read_csv(io.StringIO(f"name,value\n{name},1\n"))["name"].iloc[0]
        assert require_name(name) == name and not isinstance(read, str)
        with pytest.raises(ValueError, match="does not read as a number or as missing"):
            require_table_name(name)
    for name in ("=1+a", "@a", "-a", "+a"):
        with pytest.raises(ValueError, match="as a formula of a spreadsheet does"):
            require_table_name(name)
    for name in ("my method 2 (ä)", "3deg", "nano", "v1.5e"):
        assert require_table_name(name) == name


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain ä 日本 5\u20096", "plain ä 日本 5\u20096"),
        ("\x1b]0;x\x07", r"\x1b]0;x\x07"),
        ("a\nb\tc\rd", r"a\nb\tc\rd"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202eabc\u2066", r"\u202eabc\u2066"),
        ("\u2028\ufeff\ud800", r"\u2028\ufeff\ud800"),
    ],
)
def test_what_is_not_shown_becomes_an_escape(text: str, shown: str) -> None:
    assert visible(text) == shown
    assert visible(visible(text)) == shown
