"""Damaged files are read, or refused on one line: a short form of `make fuzz`, in this process."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest

from tests.trust.fuzz import DEFECTS, Server, Tally, Watched, fuzz, list_unread, make_examples, read_one, share_inputs
from tests.trust.mutators import _crc32c, change_e57
from tests.trust.readers import READERS

N_INPUTS, SEED = 2000, 24
# These take 0.3 s an input: `make fuzz` reads more, and pages, which take 3 s.
SLOW = (
    "OSF", "PCAP and metadata", "PCD scans", "LAZ scans", "E57", "ROS 1 bag", "ROS 2 bag", "MCAP", "table in Parquet",
)  # fmt: skip
N_SLOW = 2
NAMES = [reader.name for reader in READERS if reader.name != "page of a run"]


@pytest.fixture(name="folder", scope="module")
def folder_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the examples of all readers."""
    folder = tmp_path_factory.mktemp("fuzz")
    make_examples(folder / "examples", NAMES)
    return folder


@pytest.mark.filterwarnings("ignore")
def test_the_examples_are_read(folder: Path) -> None:
    for name, example in make_examples(folder / "examples", NAMES).items():
        if name not in SLOW:
            assert read_one(name, example) == ("read", "")


def test_inputs_that_nobody_reads_do_not_look_harmless(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(watched: Watched, name: str, number: int) -> None:
        raise TimeoutError("a reader did not start")

    monkeypatch.setattr(Watched, "read", read)
    with pytest.raises(TimeoutError, match="did not start"):
        fuzz(folder, 1, SEED, 1, [name for name in NAMES if name not in SLOW][:1], quiet=True)


def test_a_reader_that_reads_nothing_is_named() -> None:
    rows = [("none", 50, 0), ("few", 49, 0), ("one", 50, 1)]
    assert list_unread([dict(zip(("reader", "inputs", "read"), row, strict=True)) for row in rows]) == ["none"]


def test_the_checksums_of_e57_are_mended() -> None:
    assert _crc32c(b"123456789") == 0xE3069283
    content = struct.pack("<8s2I4Q", b"ASTM-E57", 1, 0, 1024, 48, 8, 1024) + b"<?xml 1>"
    made = change_e57(content, random.Random(0))
    assert len(made) == 1024 and made[1020:] == _crc32c(made[:1020]).to_bytes(4, "big")


@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_read_or_refused_on_one_line(folder: Path, tmp_path: Path) -> None:
    names = list(make_examples(folder / "examples", NAMES))
    counts = share_inputs(N_INPUTS, [name for name in names if name not in SLOW])
    counts |= dict.fromkeys((name for name in names if name in SLOW), N_SLOW)
    server, tallies, told = Server(folder, SEED, tmp_path / "input"), {name: Tally() for name in names}, []
    for name, n in counts.items():
        for number in range(n):
            answer = server.answer(name, number)
            tallies[name].outcomes[answer["outcome"]] += 1
            if answer["outcome"] in DEFECTS:
                told.append(f"{name} {number}: {answer['outcome']}: {answer['text']}")
    assert told == []
    # most damage is seen, and some of it does no harm
    assert sum(tally.outcomes["one line"] for tally in tallies.values()) > N_INPUTS / 2
    assert sum(tally.outcomes["read"] for tally in tallies.values()) > N_INPUTS / 10


def test_what_a_process_of_a_reader_prints_is_seen(folder: Path, tmp_path: Path) -> None:
    name = next(name for name in NAMES if name not in SLOW)
    with Watched(folder, SEED) as watched:
        assert watched.read(name, 0)["outcome"] in ("read", "one line")
        watched.printed.write(b"Traceback (most recent call last):\n  a process of the reader's\n")
        watched.printed.flush()
        assert watched.read(name, 0)["outcome"] == "traceback"
        assert watched.read(name, 0)["outcome"] in ("read", "one line")
