"""The rounds of a soak, and what they count."""

from __future__ import annotations

import contextlib
import os
import random
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import yaml

from eval.leaderboard.templates import write_template
from tests.soak.command import Command
from tests.soak.comparing import Found, compare_files, compare_runs
from tests.soak.disturbers import Disturber, OneMachine, OwnCluster
from tests.trust.contents import find_damaged

_SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")  # a quarter of the returns
_WORLD = " ".join(f"--world {setting}" for setting in _SMALL)
_METHOD = f"{shlex.quote(sys.executable)} given/method.py {{before}} {{after}} {{out}} {{merge}}"
_RELEASE = """description: d
published: 2026-11-26
settings: [sensor.mode=512x10, platform.scan_spacing_m=1.0]
pairs: {smoke/one_box: "20000:20001"}
"""
_MOST_STARTS = 40  # of one run or command; then it counts as one that never ends


@dataclass(frozen=True)
class Size:
    """What is run, disturbed and undisturbed."""

    scenarios: Sequence[str] = ("smoke/one_box", "smoke/unchanged")
    n_seeds: int = 4
    presets: Sequence[str] = ("paper", "tunnelcd", "voxel-diff", "random-regions")
    has_page: bool = True

    @property
    def n_pairs(self) -> int:
        return len(self.scenarios) * self.n_seeds

    @property
    def n_cells(self) -> int:
        return self.n_pairs * len(self.presets)

    def plan(self) -> str:
        document = {
            "name": "soak",
            "scenarios": [{"name": name, "set": list(_SMALL)} for name in self.scenarios],
            "seeds": f"20000:{20000 + self.n_seeds}",
            "targets": {"method": self.presets[0]},
            "variants": [{"preset": name} for name in self.presets],
        }
        return yaml.safe_dump(document)


@dataclass
class Tally:
    """What one kind of disturbance did: one row of the table."""

    times: int = 0
    lost: int = 0
    doubled: int = 0
    differ: int = 0
    half_written: int = 0
    not_one_line: int = 0


HEADINGS = (
    "times",
    "rows lost",
    "rows doubled",
    "rows that differ",
    "half-written files",
    "errors that are not one line",
)


@dataclass(frozen=True)
class Written:
    """A command that writes, to be killed.

    Attributes:
        words: The words after `tunnelcd`, without `--quiet`.
        out: What it writes, in its working folder.
        given: What lies in its working folder before, by name: a path below that of the undisturbed work.
        is_once: Whether it refuses to run where `out` is.
    """

    words: str
    out: str
    given: Mapping[str, str] = field(default_factory=dict)
    is_once: bool = False

    @property
    def argv(self) -> list[str]:
        return [*shlex.split(self.words), *([] if self.words.startswith("report") else ["--quiet"])]


COMMANDS: Mapping[str, Written] = {
    "simulate": Written(f"simulate smoke/one_box --seed 20000 {_WORLD} --out pair", "pair", is_once=True),
    "detect": Written("detect pair/before pair/after --out answer", "answer", {"pair": "simulate/pair"}, is_once=True),
    "describe": Written("describe pair/before", "pair", {"pair": "simulate/pair"}),
    "convert to OSF": Written("convert pair/before osf/a.osf", "osf", {"pair": "simulate/pair"}),
    "convert from OSF": Written("convert osf/a.osf session", "session", {"osf": "convert to OSF/osf"}, is_once=True),
    "dataset": Written(f"dataset smoke/one_box --seeds 9998:10002 --draws 1 {_WORLD} --out data", "data"),
    # two validations, and so a state to go on from
    "train sphere": Written("train data --steps 300 --threads 1 --out weights", "weights", {"data": "dataset/data"}),
    "train 3deg": Written(
        "train data --descriptor 3deg --steps 2 --threads 1 --out weights", "weights", {"data": "dataset/data"}
    ),
    "train range-net": Written(
        "train data --descriptor range-net --steps 2 --threads 1 --out weights", "weights", {"data": "dataset/data"}
    ),
    "release": Written("dataset --release given/r.yaml --out release/r.zip", "release", {"given": "given"}),
    "simulate a story": Written(
        f"simulate smoke/one_box --sessions 3 --seed 20000 {_WORLD} --out story", "story", is_once=True
    ),
    "pair of a story": Written("pair story 1 3 --out pair", "pair", {"story": "simulate a story/story"}, is_once=True),
    "story": Written("story story --out page", "page", {"story": "simulate a story/story"}),
    "graft": Written("graft pair/before --out grafted", "grafted", {"pair": "simulate/pair"}, is_once=True),
    "export": Written("export run --with-truth --out copy", "copy", {"run": "run/run"}),
    "blind export": Written("export run --out copy", "copy", {"run": "run/run"}),
    "merge-runs": Written("merge-runs a b --out union", "union", {"a": "run/run", "b": "run/run"}, is_once=True),
    # the tables beside the answers hold times
    "evaluate": Written(
        f"evaluate --plan given/plan.yaml --command {shlex.quote(_METHOD)} --merge given --as mine --reference run "
        "--out bench",
        "bench/answers",
        {"given": "given", "run": "run/run"},
    ),
    "submit": Written("submit bench --out zip/mine.zip", "zip", {"bench": "evaluate/bench"}),
    "leaderboard": Written("leaderboard zip/mine.zip --out board/index.html", "board", {"zip": "submit/zip"}),
    "world as GLB": Written("convert smoke/one_box mesh/w.glb --seed 20000", "mesh"),
    "trace": Written("trace mesh/w.glb --units m --up y --out traced/w.yaml", "traced", {"mesh": "world as GLB/mesh"}),
    "report": Written("report run", "run", {"run": "run/run"}),
    "score a run": Written("score run", "run", {"run": "run/run"}),
    "score predictions": Written(
        "score run --predictions answers --as other", "run", {"run": "run/run", "answers": "answers"}
    ),
}


class Soak:
    """A soak: its folder, its random moments, and what it has counted.

    Args:
        folder: New or empty.
        rng: Draws the moments, the numbers of workers, and who is killed.
        size: What it runs.
    """

    def __init__(self, folder: Path, rng: random.Random, size: Size) -> None:
        self.tallies: dict[str, Tally] = {}
        self.rng = rng
        self.size = size
        self.folder = folder.absolute()
        self.usual = self.folder / "undisturbed"
        self.usual.mkdir(parents=True)
        self.plan = self.folder / "plan.yaml"
        self.plan.write_text(size.plan())
        (self.usual / "given").mkdir()
        (self.usual / "given" / "plan.yaml").write_text(Size(["smoke/one_box"], 1).plan())
        (self.usual / "given" / "r.yaml").write_text(_RELEASE)
        write_template(self.usual / "given" / "method.py", "given")
        self._took_s: dict[str, float] = {}
        self._n_rounds = 0
        self._began = time.monotonic()

    def seconds(self) -> float:
        return time.monotonic() - self._began

    def tell(self, text: str) -> None:
        minutes, seconds = divmod(int(self.seconds()), 60)
        sys.stderr.write(f"[{minutes:02d}:{seconds:02d}] {text}\n")

    def is_clean(self) -> bool:
        return all(sum(asdict(tally).values()) == tally.times > 0 for tally in self.tallies.values())

    def run_undisturbed(self) -> None:
        """Run the plan, draw the names of its blind copies, and write its page."""
        folder = self.usual / "run"
        folder.mkdir()
        self._must(folder, "list")  # imports
        start = time.monotonic()
        self._must(folder, "run", self.plan, "--out", "run", "--quiet")
        self._took_s["run"] = time.monotonic() - start
        self._must(folder, "export", "run", "--out", "named", "--quiet")
        self._write_page(folder)
        self.tell(f"undisturbed: {self.size.n_cells} cells in {self._took_s['run']:.1f} s")

    def disturb(self, name: str) -> None:
        """Do one round of a kind of disturbance."""
        if name in COMMANDS:
            self.kill_command(name, self.rng.randint(1, 4))
        elif name in RUNS:
            self.disturb_run(name, self.rng.randint(2, 5))
        else:
            disks()[name](self, name)

    def disturb_run(self, name: str, n_times: int) -> None:
        """Disturb a run so often, run it until it ends, and compare."""
        tally, folder = self._tally(name), self._round_folder()
        make, target, slowness = RUNS[name]
        disturber = make(folder, self.plan, self.rng, target)
        # as long as two pairs take, or half of the run, and the start of workers
        most_s = self._took_s["run"] * min(2 / self.size.n_pairs, 0.5) * slowness
        try:
            for _ in range(_MOST_STARTS):
                client = disturber.start()
                while n_times and not client.wait(self.rng.uniform(0.05, most_s)):
                    if told := disturber.disturb(client):
                        n_times, tally.times = n_times - 1, tally.times + 1
                        self.tell(f"{name}: {told}, {self._n_finished(folder)} of {self.size.n_cells} cells")
                client.wait()
                self._judge(tally, client, folder)
                if client.code == 0:
                    break
        finally:
            disturber.end()
        self._compare_run(tally, folder)
        shutil.rmtree(folder)

    def kill_command(self, name: str, n_kills: int) -> None:
        """Kill a command that writes so often, run it until it ends, and compare."""
        tally, command = self._tally(name), COMMANDS[name]
        usual = self._undisturbed(name)
        folder = self._round_folder()
        self._give(folder, command)
        for number in range(n_kills + 1):
            if command.is_once and (folder / command.out).exists():
                break  # it had ended before it was killed
            client, start = Command(command.argv, folder), time.monotonic()
            if number < n_kills and not client.wait(self.rng.uniform(0.0, 1.1) * self._took_s[name]):
                tally.times += client.kill()
            client.wait()
            if number == 0 and not client.is_killed:  # other work had slowed the undisturbed run down
                self._took_s[name] = min(self._took_s[name], time.monotonic() - start)
            self._judge(tally, client, folder)
        self._count(tally, compare_files(usual / command.out, folder / command.out))
        self._count(tally, {"half_written": [str(path) for path in folder.glob(".*")]})
        self.tell(f"{name}: killed {n_kills} times, compared")
        shutil.rmtree(folder)

    def fill_disk(self, name: str) -> None:
        """Run on a disk with room for half of the run, give it room, go on."""
        tally, folder = self._tally(name), self._round_folder()
        n_bytes = sum(path.stat().st_size for path in (self.usual / "run" / "run").rglob("*"))
        with _small_disk(folder / "run", n_bytes // 2) as resize:
            for workers in ((), ("--workers", 2)):
                client = Command(["run", self.plan, "--out", "run", "--quiet", *workers], folder)
                client.wait()
                tally.times += client.code == 2
                self._judge(tally, client, folder)
                self.tell(f"{name}: {self._n_finished(folder)} of {self.size.n_cells} cells")
            resize(8 * n_bytes)
            self._must(folder, "run", self.plan, "--out", "run", "--quiet", "--workers", "2")
            self._compare_run(tally, folder)
        shutil.rmtree(folder)

    def limit_files(self, name: str) -> None:
        """Run where no file may be larger than a random size, as under a quota, several times; then without limit."""
        tally, folder = self._tally(name), self._round_folder()
        largest = max(path.stat().st_size for path in (self.usual / "run" / "run").rglob("*"))
        for share in sorted(self.rng.uniform(0.0, 0.9) for _ in range(3)):
            client = Command(["run", self.plan, "--out", "run", "--quiet"], folder, int(share**3 * largest))
            client.wait()
            tally.times += client.code == 2
            self._judge(tally, client, folder)
        self._must(folder, "run", self.plan, "--out", "run", "--quiet")
        self._compare_run(tally, folder)
        shutil.rmtree(folder)

    def close_folder(self, name: str) -> None:
        """Make a run's folders unchangeable in the middle of it, try again, open them, go on."""
        tally, folder = self._tally(name), self._round_folder()
        client = Command(["run", self.plan, "--out", "run", "--quiet", "--workers", "2"], folder)
        while not client.wait(0.05) and self._n_finished(folder) < self.size.n_cells // 4:
            pass
        with _closed(folder / "run"):
            for _ in range(2):
                client.wait()
                tally.times += client.code == 2
                self._judge(tally, client, folder)
                client = Command(["run", self.plan, "--out", "run", "--quiet"], folder)
            client.wait()
        self.tell(f"{name}: {self._n_finished(folder)} of {self.size.n_cells} cells")
        self._must(folder, "run", self.plan, "--out", "run", "--quiet")
        self._compare_run(tally, folder)
        shutil.rmtree(folder)

    def table(self) -> str:
        """Return the table: one row is one kind of disturbance."""
        columns = [asdict(tally).values() for tally in self.tallies.values()]
        rows = {
            **{name: asdict(tally).values() for name, tally in self.tallies.items()},
            "all": map(sum, zip(*columns, strict=True)),
        }
        lines = [
            ("disturbance", *HEADINGS),
            ("---",) * (1 + len(HEADINGS)),
            *((name, *row) for name, row in rows.items()),
        ]
        return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)

    def _tally(self, name: str) -> Tally:
        return self.tallies.setdefault(name, Tally())

    def _round_folder(self) -> Path:
        self._n_rounds += 1
        folder = self.folder / f"{self._n_rounds:04d}"
        folder.mkdir()
        return folder

    def _n_finished(self, folder: Path) -> int:
        return len(list(folder.glob("run/cells/*/*/*.json")))

    def _must(self, folder: Path, *argv: object) -> None:
        command = Command(argv, folder)
        command.wait()
        if command.code != 0 or command.complaint():
            raise SystemExit(f"{' '.join(command.argv)}: exit code {command.code}, undisturbed: {command.complaint()}")

    def _write_page(self, folder: Path) -> None:
        if self.size.has_page:
            self._must(folder, "report", "run", "--views", "none")

    def _give(self, folder: Path, command: Written) -> None:
        """Copy what a command needs into its working folder; the answers of one method serve as predictions."""
        for name, source in command.given.items():
            if name != "answers":
                self._undisturbed(Path(source).parts[0])
                shutil.copytree(self.usual / source, folder / name)
                continue
            for answer in (self.usual / "run" / "run").glob("answers/*/*/voxel-diff"):
                shutil.copytree(answer, folder / name / answer.parts[-3] / answer.parts[-2])

    def _undisturbed(self, name: str) -> Path:
        """Run a command undisturbed, unless it has been, and return its working folder."""
        folder = self.usual / name
        if not folder.exists():
            folder.mkdir()
            self._give(folder, COMMANDS[name])
            start = time.monotonic()
            self._must(folder, *COMMANDS[name].argv)
            self._took_s[name] = time.monotonic() - start
        return folder

    def _judge(self, tally: Tally, client: Command, folder: Path) -> None:
        """Look at what a command that ended has said, and left."""
        complaint = client.complaint()
        self._count(
            tally, {"not_one_line": [complaint] if complaint else [], "half_written": list(find_damaged(folder))}
        )

    def _compare_run(self, tally: Tally, folder: Path) -> None:
        self._write_page(folder)
        self._count(tally, compare_runs(self.usual / "run" / "run", folder / "run"))

    def _count(self, tally: Tally, found: Found) -> None:
        for column, what in found.items():
            setattr(tally, column, getattr(tally, column) + len(what))
            for each in what:
                self.tell(f"{column.upper()}: {each}")


# name of a round: what disturbs, whom, and how slowly a run starts
RUNS: Mapping[str, tuple[Callable[[Path, Path, random.Random, str], Disturber], str, float]] = {
    "kill of a run without workers": (OneMachine, "serial", 1.0),
    "kill of the client of --workers": (OneMachine, "client", 2.0),
    "kill of a worker of --workers": (OneMachine, "worker", 2.0),
    "Ctrl-C": (OneMachine, "Ctrl-C", 2.0),
    "kill of the client of a cluster": (OwnCluster, "client", 1.0),
    "kill of a worker of a cluster": (OwnCluster, "worker", 1.0),
    "kill of the scheduler": (OwnCluster, "scheduler", 1.0),
    "any of them": (OwnCluster, "all", 1.0),
}


def disks() -> dict[str, Callable[[Soak, str], None]]:
    """Return the rounds that this user and machine allow, and say which do not go."""
    rounds = {"no file larger than a random size (RLIMIT_FSIZE)": Soak.limit_files}
    if _works("mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs"):
        rounds["full disk (tmpfs)"] = Soak.fill_disk
    if _works("chattr", "+i"):
        rounds["folder closed (chattr +i)"] = Soak.close_folder
    elif os.geteuid() != 0:
        rounds["folder closed (chmod)"] = Soak.close_folder
    return rounds


def _works(*argv: str) -> bool:
    """Tell whether a command can be done to a folder, and undo it."""
    with tempfile.TemporaryDirectory() as folder:
        if (
            shutil.which(argv[0]) is None
            or subprocess.run([*argv, folder], check=False, capture_output=True).returncode
        ):
            return False
        subprocess.run(["umount", folder] if argv[0] == "mount" else ["chattr", "-i", folder], check=True)
    return True


@contextlib.contextmanager
def _small_disk(folder: Path, n_bytes: int) -> Iterator[Callable[[int], None]]:
    """Make a folder a disk of its own; yield what gives it another size."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={n_bytes}", "tmpfs", folder], check=True)
    try:
        yield lambda size: subprocess.run(["mount", "-o", f"remount,size={size}", folder], check=True) and None
    finally:
        subprocess.run(["umount", folder], check=True)


@contextlib.contextmanager
def _closed(folder: Path) -> Iterator[None]:
    """Let nobody make, change or remove anything below a folder; root by chattr, others by chmod."""
    close, reopen = (
        (["chattr", "-R", "+i"], ["chattr", "-R", "-i"])
        if os.geteuid() == 0
        else (["chmod", "-R", "a-w"], ["chmod", "-R", "u+w"])
    )
    # a file may be removed while the command walks
    subprocess.run([*close, folder], check=False, capture_output=True)
    try:
        yield
    finally:
        subprocess.run([*reopen, folder], check=True)
