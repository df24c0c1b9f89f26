"""Reads damaged files with every reader, in processes that are watched: `python -m tests.trust.fuzz`.

An input is one damaged file in a reader's example folder; it follows from (seed, reader, number) alone. Its outcome is

- `read` or `one line`: as it should be;
- `several lines`: an `InputError` of more than one line where one was expected, or of none;
- `traceback`: any other exception, or one that a process of the reader's own prints;
- `over 10 s`: more than 10 s of CPU time, or a minute without an answer;
- `over memory`: the process grew by more than 500 MB plus ten times the folder;
- `death`: the process ended.

Every input with another outcome than the first two is kept: `--replay FOLDER/KEPT` reads it again. A reader that read
none of 50 inputs or more fails too: the damage of its files does not reach it.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

ROOT = Path(__file__).parents[2]
OUTCOMES = ("read", "one line", "several lines", "traceback", "over 10 s", "over memory", "death")
DEFECTS = OUTCOMES[2:]
MOST_S, SILENT_S = 10.0, 60.0
MOST_BYTES, MOST_TIMES = 500 << 20, 10
_MANY = 50
# A process that has grown by this much is replaced, so that the growth of later inputs is seen.
_RESTART_BYTES = 150 << 20
# Beyond this an allocation fails, so that one input cannot take the machine down.
_LIMIT_BYTES = 6 << 30


@dataclass
class Tally:
    """The outcomes of one reader."""

    outcomes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    peak_bytes: int = 0

    def row(self, name: str) -> dict[str, Any]:
        """Return its row of the table."""
        counts = {outcome: self.outcomes[outcome] for outcome in OUTCOMES}
        peak_mb = round(self.peak_bytes / 2**20)
        told = {"reader": name, "inputs": sum(counts.values()), **counts}
        return {**told, "slowest (CPU s)": round(self.slowest_s, 1), "peak (MB)": peak_mb}


def fuzz(
    out: Path, n_inputs: int, seed: int, n_processes: int, names: Sequence[str] = (), *, quiet: bool = False
) -> list[dict[str, Any]]:
    """Read so many damaged inputs, and return one row per reader; offending inputs are kept in `out`."""
    examples = make_examples(out / "examples", names)
    todo: SimpleQueue[tuple[str, int]] = SimpleQueue()
    counts = share_inputs(n_inputs, list(examples))
    for name, number in _interleaved(counts):
        todo.put((name, number))
    tallies = {name: Tally() for name in examples}
    lock, started = threading.Lock(), time.monotonic()

    def work() -> None:
        with Watched(out, seed) as watched:
            while True:
                try:
                    name, number = todo.get_nowait()
                except Empty:
                    return
                answer = watched.read(name, number)
                with lock:
                    tally = tallies[name]
                    tally.outcomes[answer["outcome"]] += 1
                    tally.slowest_s = max(tally.slowest_s, answer["seconds"])
                    tally.peak_bytes = max(tally.peak_bytes, answer["bytes"])
                    n_done = sum(each.outcomes.total() for each in tallies.values())
                    if not quiet and n_done % 2000 == 0:
                        print(f"{n_done} of {n_inputs} inputs, {time.monotonic() - started:.0f} s", flush=True)

    with ThreadPoolExecutor(n_processes) as pool:
        for worker in [pool.submit(work) for _ in range(n_processes)]:
            worker.result()  # a mistake in the harness ends it: inputs that nobody read would look harmless
    return [tally.row(name) for name, tally in tallies.items()]


def make_examples(folder: Path, names: Sequence[str] = ()) -> dict[str, Path]:
    """Write the examples of the named readers, by default all that are installed; return their folders by name."""
    from tests.trust.readers import READERS  # noqa: PLC0415 - slow to load, and a watched process loads it too

    found = {}
    for reader in READERS:
        if (names and reader.name not in names) or (reader.extra and find_spec(reader.extra) is None):
            continue
        found[reader.name] = folder / reader.name.replace(" ", "_").replace(",", "")
        if not found[reader.name].is_dir():
            found[reader.name].mkdir(parents=True)
            reader.make(found[reader.name])
    return found


def share_inputs(n_inputs: int, names: Sequence[str]) -> dict[str, int]:
    """Return how many inputs each reader gets, at least one."""
    from tests.trust.readers import READERS  # noqa: PLC0415

    shares = {reader.name: reader.share for reader in READERS if reader.name in names}
    return {name: max(1, round(n_inputs * share / sum(shares.values()))) for name, share in shares.items()}


def _interleaved(counts: dict[str, int]) -> Iterator[tuple[str, int]]:
    """Yield (reader, number); runs of one reader, so that a process seldom changes it."""
    size = 25
    for start in range(0, max(counts.values()), size):
        for name, n in counts.items():
            step = max(1, size * n // max(counts.values()))
            first = start // size * step
            last = n if start + size >= max(counts.values()) else min(n, first + step)
            yield from ((name, number) for number in range(first, last))


class Watched:
    """A process that reads inputs; it is replaced when it dies, hangs or has grown."""

    def __init__(self, out: Path, seed: int) -> None:
        self._out, self._seed = out, seed
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: SimpleQueue[bytes] = SimpleQueue()
        self.printed = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `__exit__`; what the process and its own print

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self.printed.close()

    def read(self, name: str, number: int) -> dict[str, Any]:
        """Read one input, keep it if it is a defect, and return what came of it."""
        asked = time.monotonic()
        process = self._process or self._start()
        assert process.stdin is not None
        process.stdin.write(json.dumps([name, number]).encode() + b"\n")
        process.stdin.flush()
        answer: dict[str, Any] = {"outcome": "death", "seconds": 0.0, "bytes": 0, "text": ""}
        try:
            line = self._answers.get(timeout=SILENT_S)
            if line:
                answer = json.loads(line)
            else:
                code = process.wait()
                answer["text"] = f"ended with exit code {code}"
        except Empty:
            answer |= {"outcome": "over 10 s", "seconds": time.monotonic() - asked, "text": "no answer for a minute"}
        printed = self._take_printed()
        if answer["outcome"] in OUTCOMES[:3] and "Traceback (most recent call last)" in printed:
            answer |= {"outcome": "traceback", "text": printed[-4000:]}
        if answer["outcome"] in ("death", "over 10 s") or answer.get("is_grown"):
            self._end()
        if answer["outcome"] in DEFECTS:
            self._keep(name, number, answer)
        return answer

    def _start(self) -> subprocess.Popen[bytes]:
        argv = [sys.executable, "-m", "tests.trust.fuzz", "--serve", str(self._out), "--seed", str(self._seed)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.printed, env=environment, cwd=ROOT
        )
        self._answers = SimpleQueue()
        threading.Thread(target=_pump, args=(self._process, self._answers), daemon=True).start()
        self._answers.get(timeout=SILENT_S)  # it has loaded the readers
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                pipe.close()
            self._process = None

    def _take_printed(self) -> str:
        """Return what was printed since the last call."""
        size = self.printed.seek(0, os.SEEK_END)
        printed = os.pread(self.printed.fileno(), size, 0).decode(errors="replace")
        self.printed.seek(0)
        self.printed.truncate()
        return printed

    def _keep(self, name: str, number: int, answer: dict[str, Any]) -> None:
        folder = self._out / "kept" / f"{answer['outcome'].replace(' ', '_')}-{name.replace(' ', '_')}-{number}"
        folder.mkdir(parents=True, exist_ok=True)
        example = make_examples(self._out / "examples", [name])[name]
        path, content = make_input(name, example, self._seed, number)
        (folder / "damaged").write_bytes(content)
        about = {"reader": name, "seed": self._seed, "number": number, "file": path.relative_to(example).as_posix()}
        (folder / "about.json").write_text(json.dumps({**about, **answer}, indent=1))


def _pump(process: subprocess.Popen[bytes], answers: SimpleQueue[bytes]) -> None:
    assert process.stdout is not None
    try:
        for line in process.stdout:
            answers.put(line)
    except ValueError:  # closed by `_end`
        pass
    answers.put(b"")


def make_input(name: str, example: Path, seed: int, number: int) -> tuple[Path, bytes]:
    """Return which file of a reader's example is damaged, and its damaged content."""
    from tests.trust.mutators import mutate  # noqa: PLC0415
    from tests.trust.readers import READERS  # noqa: PLC0415

    (reader,) = (each for each in READERS if each.name == name)
    rng = random.Random(f"{seed} {name} {number}")
    files = sorted({path for pattern in reader.files for path in example.glob(pattern) if path.is_file()})
    path = rng.choice(files)
    return path, mutate(path.name, path.read_bytes(), rng)


class Server:
    """Reads inputs in this process, each in the same copy of its reader's example."""

    def __init__(self, out: Path, seed: int, place: Path) -> None:
        self._out, self._seed, self._place = out, seed, place
        self._name = ""
        self._folder = place
        self._n_read = 0

    def answer(self, name: str, number: int) -> dict[str, Any]:
        """Read one input; return its outcome, CPU seconds, growth in bytes, and what was said."""
        example = self._out / "examples" / name.replace(" ", "_").replace(",", "")
        if name != self._name:
            self._copy(name, example)
        path, content = make_input(name, example, self._seed, number)
        target = self._folder / path.relative_to(example)
        target.write_bytes(content)
        n_bytes = sum(each.stat().st_size for each in self._folder.rglob("*") if each.is_file())
        grown, held, used = _peak_bytes(), _held_bytes(), _cpu_s()
        outcome, text = read_one(name, self._folder)
        seconds, peak = _cpu_s() - used, max(0, _peak_bytes() - held) if _peak_bytes() > grown else 0
        if outcome in ("read", "one line", "several lines") or text.startswith("MemoryError"):
            if peak > MOST_BYTES + MOST_TIMES * n_bytes or text.startswith("MemoryError"):
                outcome = "over memory"
            elif seconds > MOST_S:
                outcome = "over 10 s"
        self._restore(example, target, path)
        told = {"outcome": outcome, "seconds": seconds, "bytes": peak, "text": text[:4000]}
        return {**told, "is_grown": peak > _RESTART_BYTES}

    def _copy(self, name: str, example: Path) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        shutil.copytree(example, self._folder)
        self._name = name

    def _restore(self, example: Path, target: Path, path: Path) -> None:
        """Undo the damage, and what the reader wrote."""
        expected = {each.relative_to(example): each for each in example.rglob("*")}
        for each in sorted(self._folder.rglob("*"), reverse=True):
            if (there := each.relative_to(self._folder)) not in expected:
                shutil.rmtree(each) if each.is_dir() else each.unlink()
            elif each.is_file() and each.stat().st_mtime_ns != expected[there].stat().st_mtime_ns:
                shutil.copy2(expected[there], each)
        if not target.is_file() or any(not (self._folder / there).exists() for there in expected):
            self._copy(self._name, example)


def read_one(name: str, folder: Path) -> tuple[str, str]:
    """Read a folder with a reader; return the outcome and what was said."""
    from cdpipe.core.errors import TunnelcdError  # noqa: PLC0415
    from tests.trust.readers import READERS  # noqa: PLC0415

    (reader,) = (each for each in READERS if each.name == name)
    try:
        reader.read(folder)
    except TunnelcdError as error:
        text = str(error)
        lines = text.splitlines()
        is_told = all(line.strip() for line in lines) and (len(lines) == 1 or (reader.lines and len(lines) > 1))
        return ("one line" if is_told else "several lines"), text
    except BaseException as error:
        return "traceback", f"{type(error).__name__}: {error}\n{traceback.format_exc()[-3000:]}"
    return "read", ""


def _cpu_s() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def _peak_bytes() -> int:
    """High-water mark of the memory of this process, or of a child that has ended."""
    return 1024 * max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def _held_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def serve(out: Path, seed: int) -> None:
    """Answer requests (reader, number) on standard input, one line of JSON each."""
    import tests.trust.readers  # noqa: F401, PLC0415

    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_DATA, (_LIMIT_BYTES, _LIMIT_BYTES))
    shared = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as place:
        server = Server(out, seed, Path(place) / "input")
        answers.write(b"\n")
        for line in sys.stdin.buffer:
            answers.write(json.dumps(server.answer(*json.loads(line))).encode() + b"\n")


def replay(kept: Path) -> str:
    """Read a kept input again in this process, and return what came of it."""
    about = json.loads((kept / "about.json").read_text())
    with tempfile.TemporaryDirectory() as place:
        examples = kept.parents[1] / "examples"
        folder = Path(place) / "input"
        shutil.copytree(make_examples(examples, [about["reader"]])[about["reader"]], folder)
        shutil.copy(kept / "damaged", folder / about["file"])
        outcome, text = read_one(about["reader"], folder)
    return f"{about['reader']}: {about['file']}: {outcome}\n{text}"


def write_table(path: Path, rows: Sequence[dict[str, Any]], about: str) -> None:
    """Write the rows as .csv, or as a Markdown page with a line about the run."""
    if path.suffix == ".csv":
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        return
    names = list(rows[0])
    lines = ["# Damaged files, read", "", about, "", f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    path.write_text("\n".join(lines) + "\n")


def add_up(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the last row of a table: sums, and the largest of what cannot be summed."""
    total: dict[str, Any] = {"reader": "all"}
    for name in list(rows[0])[1:]:
        total[name] = (max if "(" in name else sum)(row[name] for row in rows)
    return total


def list_unread(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the readers that read none of many inputs."""
    return [row["reader"] for row in rows if row["inputs"] >= _MANY and not row["read"]]


def main() -> None:
    """Run the program; it exits with 1 if an input had a wrong outcome, or a reader read none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", action="append", default=[], metavar="READER", help="a reader; may be repeated")
    parser.add_argument("--keep", type=Path, default=Path("fuzz"), metavar="DIR", help="for examples and defects")
    parser.add_argument("--out", type=Path, metavar="TABLE", help=".md or .csv")
    parser.add_argument("--replay", type=Path, metavar="DIR/kept/NAME", help="read one kept input again")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        serve(asked.serve, asked.seed)
        return
    if asked.replay:
        print(replay(asked.replay.resolve()))
        return
    started = time.monotonic()
    rows = fuzz(asked.keep.resolve(), asked.inputs, asked.seed, asked.processes, asked.only)
    unread = list_unread(rows)
    rows.append(add_up(rows))
    about = f"Seed {asked.seed}, {asked.processes} processes, {(time.monotonic() - started) / 60:.0f} min."
    about += f" **Not one input was read: {', '.join(unread)}.**" if unread else ""
    if asked.out:
        write_table(asked.out, rows, about)
    for row in rows:
        print(" | ".join(str(value) for value in row.values()))
    print(" | ".join(rows[0]), about, sep="\n")
    raise SystemExit(bool(unread) or any(rows[-1][outcome] for outcome in DEFECTS))


if __name__ == "__main__":
    main()
