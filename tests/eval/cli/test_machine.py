"""The command line for programs: JSON, names with descriptions, the version, and an interrupt at any moment."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

from cdpipe.model.config import settings_table
from eval.cli.commands import tools
from eval.cli.doctor import Finding
from eval.core.terminal.printing import echo_json
from eval.plans.files import plan_names
from scenarios import scenario_names
from scenarios.schema import Odometry, Platform, Scenario, Sensor, Simulation

Command = Callable[..., tuple[int, str, str]]


def test_the_version_is_that_of_the_package(command: Command) -> None:
    assert command("--version") == (0, f"tunnelcd {metadata.version('tunnelcd')}\n", "")


def test_settings_come_with_default_unit_and_meaning(command: Command) -> None:
    code, out, _ = command("list", "settings", "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    assert list(rows) == [key for key, _, _ in settings_table()]
    assert rows["map.voxel_m"] == {
        "name": "map.voxel_m", "default": 0.2, "unit": "m", "description": "cell of the thinned map",
    }  # fmt: skip
    units = {name: rows[name]["unit"] for name in (
        "map.airborne", "merge.min_overlap", "merge.accept_all", "merge.n_candidates", "query.radius_m",
    )}  # fmt: skip
    assert units == {
        "map.airborne": "keep | drop", "merge.min_overlap": "share", "merge.accept_all": "true | false",
        "merge.n_candidates": "number", "query.radius_m": "m",
    }  # fmt: skip
    code, out, _ = command("list", "settings")
    assert "map.voxel_m = 0.2  [m]\n    cell of the thinned map\n" in out
    assert max(map(len, out.splitlines())) <= 90


def test_keys_of_the_world_come_with_default_unit_and_meaning(command: Command) -> None:
    code, out, _ = command("list", "world", "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    parts = {"sensor": Sensor, "platform": Platform, "before.odometry": Odometry, "sim": Simulation}
    assert {f"{name}.{key}" for name, part in parts.items() for key in part.model_fields} <= set(rows)
    assert {name.partition(".")[0] for name in rows} == set(Scenario.model_fields)
    assert rows["platform.scan_spacing_m"] == {
        "name": "platform.scan_spacing_m", "default": 0.25, "unit": "m",
        "description": "path between the recorded revolutions",
    }  # fmt: skip
    units = {"platform.speed_mps": "m/s", "before.odometry.yaw_deg_per_m": "deg/m", "sensor.sub_rays": "1 | 7 | 19",
             "before.air.dust.mg_per_m3": "mg/m3", "before.odometry.scale_percent": "%", "sensor.glass": "true | false",
             "before.odometry.yaw_deg_per_100m": "deg/100m", "tunnel.floor.stones.per_m2": "1/m2"}  # fmt: skip
    assert {name: rows[name]["unit"] for name in units} == units
    assert (rows["before.trajectory"]["default"], rows["after"]["default"]) == (None, "")
    assert rows["props.NAME.to"]["description"].endswith("keys as of props.NAME.place")
    assert rows["tunnel.variation"]["description"] == "Slow change of width and of height along every drift"
    code, out, _ = command("list", "world")
    assert "platform.scan_spacing_m = 0.25  [m]\n    path between the recorded revolutions\n" in out
    assert "before.trajectory = null\n" in out and max(map(len, out.splitlines())) <= 90


@pytest.mark.parametrize(("kind", "names"), [("scenarios", scenario_names), ("plans", plan_names)])
def test_names_come_with_a_line_each(command: Command, kind: str, names: Callable[[], list[str]]) -> None:
    code, out, _ = command("list", kind)
    lines = out.splitlines()
    assert code == 0
    assert [line.split()[0] for line in lines] == names()
    assert all(len(line.split()) > 2 for line in lines)
    found = json.loads(command("list", kind, "--json")[1])
    assert [row["name"] for row in found] == names()
    assert all(row["description"] and "\n" not in row["description"] for row in found)


@pytest.mark.parametrize("kind", ["props", "methods"])
def test_each_prop_and_method_has_a_line_of_its_own(command: Command, kind: str) -> None:
    rows = json.loads(command("list", kind, "--json")[1])
    assert len(rows) > 10 and len({row["description"] for row in rows}) == len(rows)
    assert all(20 < len(row["description"]) < 120 for row in rows)


@pytest.mark.parametrize("kind", ["presets", "sensors", "metrics"])
def test_presets_sensors_and_metrics_are_described(command: Command, kind: str) -> None:
    rows = json.loads(command("list", kind, "--json")[1])
    assert all(row["description"] for row in rows)
    first = {"presets": "c2c", "sensors": "os0-128-nominal", "metrics": "region_recall"}
    assert rows[0]["name"] == first[kind]


def test_all_names_as_json(command: Command) -> None:
    found = json.loads(command("list", "--json")[1])
    assert set(found) == {"scenarios", "props", "plans", "presets", "methods", "metrics", "sensors", "recordings"}
    assert found["plans"] == plan_names()


def test_check_as_json_tells_what_each_file_is(command: Command) -> None:
    code, out, err = command("check", "smoke", "smok", "--json")
    first, second = json.loads(out)
    assert (code, err.count("\n")) == (2, 1)
    assert first["file"] == "smoke" and first["is"].startswith("a plan of ") and first["mistakes"] == []
    assert second["is"] is None and second["mistakes"] == [err.removeprefix("error: ").strip()]


def test_doctor_as_json(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [Finding("a", "ok", "1.0", True), Finding("b", "broken", "none", True, "pip install b")]
    monkeypatch.setattr("eval.cli.doctor.examine", lambda: iter(found))
    code, out, err = command("doctor", "--json")
    assert (code, err) == (2, "error: b: none: pip install b\n")
    assert json.loads(out)[1] == {
        "what": "b", "state": "broken", "told": "none", "is_required": True, "mend": "pip install b",
    }  # fmt: skip
    monkeypatch.setattr("eval.cli.doctor.examine", lambda: iter(found[:1]))
    assert command("doctor", "--json")[0] == 0


def test_a_name_with_a_line_break_is_one_mistake(command: Command, tmp_path: Path) -> None:
    code, out, err = command("check", tmp_path / "x\ny.yaml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"error: {tmp_path / 'x'}\\ny.yaml: no such file")


def test_a_score_as_json(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("eval.scoring.scoring.score", lambda *_: {"region_recall": 1.0, "t_cd_s": float("nan")})
    code, out, err = command("score", tmp_path, tmp_path, "--json")
    assert (code, json.loads(out), err) == (0, {"region_recall": 1.0, "t_cd_s": None}, "")


@pytest.mark.parametrize(
    "words", [("list",), ("list", "settings"), ("check", "smoke", "narrow"), ("check", "smok"), ("doctor",)]
)
def test_the_json_is_written_to_a_file_as_well(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    found = [Finding("a", "ok", "1.0", True)]
    monkeypatch.setattr("eval.cli.doctor.examine", lambda: iter(found))
    file = tmp_path / "found.json"
    plain, printed = command(*words), command(*words, "--json")
    told = command(*words, "--out", file)
    assert told == plain and told[0] == printed[0]
    assert file.read_text() == printed[1]
    file.unlink()
    assert command(*words, "--json", "--out", file)[1] == printed[1] == file.read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["found.json"]


def test_a_score_is_written_to_a_file(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("eval.scoring.scoring.score", lambda *_: {"region_recall": 1.0, "t_cd_s": float("nan")})
    file = tmp_path / "score.json"
    assert command("score", tmp_path, tmp_path, "--out", file, "--quiet") == (0, "", "")
    assert json.loads(file.read_text()) == {"region_recall": 1.0, "t_cd_s": None}


@pytest.mark.parametrize(("name", "said"), [(".", "is a folder"), ("none/x.json", "there is no folder")])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, said: str
) -> None:
    monkeypatch.setattr("eval.cli.doctor.examine", lambda: pytest.fail("examined"))
    code, out, err = command("doctor", "--out", tmp_path / name)
    assert (code, out, err.count("\n")) == (2, "", 1) and said in err


@pytest.mark.parametrize("words", [("list", "plans"), ("check", "smoke"), ("doctor",), ("score", "pair", "answer")])
@pytest.mark.parametrize("is_linked", [False, True])
def test_a_file_that_is_there_is_not_replaced(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], is_linked: bool
) -> None:
    monkeypatch.setattr("eval.cli.doctor.examine", lambda: pytest.fail("examined"))
    monkeypatch.setattr("eval.scoring.scoring.score", lambda *_: pytest.fail("scored"))
    mine = file = tmp_path / "changes.json"
    mine.write_text("[]")
    if is_linked:
        file = tmp_path / "link.json"
        file.symlink_to(mine.name)
    told = f"error: --out {file}: exists: name a new file, or remove this one\n"
    assert command(*words, "--out", file) == (2, "", told)
    assert mine.read_text() == "[]" and file.is_symlink() == is_linked


def test_a_world_that_is_too_large_is_told_by_check(command: Command, tmp_path: Path) -> None:
    file = tmp_path / "long.yaml"
    file.write_text(
        "score_radius_m: 4.5\ntunnel: {nodes: {a: [0, 0, 0], b: [900, 0, 0]}, drifts: [{nodes: [a, b]}]}\n"
        "platform: {kind: ground_robot, scan_spacing_m: 0.25}\nbefore: {route: [a, b]}\nafter: {route: [a, b]}\n"
    )
    assert command("check", file) == (0, f"{file}: a scenario, no mistakes\n", "")
    file.write_text(file.read_text().replace("0.25", "1e-3"))
    code, out, err = command("check", file)
    assert (code, out) == (2, "") and err.startswith(
        f"error: {file}: seed 0: before: platform.scan_spacing_m = 0.001: "
    )
    assert err.endswith(" at least 0.00909\n") and err.count("\n") == 1


@pytest.mark.parametrize("file", ["/dev/stdout", "/dev/null"])
def test_standard_output_is_written_by_json_and_not_named(command: Command, file: str) -> None:
    told = f"error: --out {file}: is no plain file: leave it out, and --json prints on standard output\n"
    assert command("check", "smoke", "--out", file) == (2, "", told)


@pytest.mark.parametrize("kind", ["scenarios", "plans", "presets", "sensors", "settings"])
def test_every_row_is_described(command: Command, kind: str) -> None:
    rows = json.loads(command("list", kind, "--json")[1])
    assert rows and all(len(row["description"].split()) > 1 for row in rows)
    if kind == "settings":
        assert [row["name"] for row in rows if not row["unit"]] == []


def test_settings_of_world_and_method_are_told_apart(command: Command, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "out")
    code, _, err = command("simulate", "smoke/one_box", "--world", "query.radius_m=3", *out)
    assert code == 2 and "of a method, not of the world" in err
    code, _, err = command("detect", tmp_path, tmp_path, "--set", "sensor.mode=512x10", *out)
    assert code == 2 and "of the world, not of a method" in err and "`tunnelcd simulate` by --world" in err
    code, _, err = command("run", "smoke", "--set", "sensor.mode=512x10", *out)
    assert code == 2 and "write it into the plan" in err
    code, _, err = command("simulate", "smoke/one_box", "--world", "sensor.mod=x", *out)
    assert (code, err) == (2, "error: --world: sensor.mod = 'x': unknown key; did you mean \"sensor.mode\"?\n")
    code, _, err = command("simulate", "smoke/one_box", "--set", "sensor.mod=x", *out)
    warning, error = err.splitlines()
    assert code == 2 and warning.startswith("warning: --set: ") and error.startswith("error: --world: sensor.mod")
    assert not list(tmp_path.iterdir())


# of each shell: what it sets, and what it reads
SHELLS = {
    "bash": lambda words: {
        "_TUNNELCD_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1),
    },
    "zsh": lambda words: {"_TUNNELCD_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": " ".join(words)},
    "fish": lambda words: {
        "_TUNNELCD_COMPLETE": "complete_fish", "_TYPER_COMPLETE_ARGS": " ".join(words),
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("shell", "words", "expected"),
    [
        ("zsh", "simulate smoke/", {"smoke/one_box", "smoke/unchanged"}),
        ("fish", "simulate smoke/", {"smoke/one_box", "smoke/unchanged"}),
        *(("bash", words, expected) for words, expected in [
        ("simulate smoke/", {"smoke/one_box", "smoke/unchanged"}), ("run fact", {"factorial"}),
        ("detect a b --preset paper-", {"paper-paired", "paper-topn"}),
        ("detect a b --set query.radius", {"query.radius_m="}), ("dataset --release l", {"lite"}),
        ("simulate narrow --world sensor.sub", {"sensor.sub_rays="}), ("report run --against octo", {"octomap"}),
        ("list sett", {"settings"}),
        ]),
    ],
)  # fmt: skip
def test_a_shell_completes_names_and_loads_nothing_heavy(shell: str, words: str, expected: set[str]) -> None:
    program = (
        "import atexit, sys\n"
        "heavy = {'torch', 'mujoco', 'scipy', 'pandas', 'trimesh', 'numpy'}\n"
        "atexit.register(lambda: print('heavy:', *(heavy & set(sys.modules)), file=sys.stderr))\n"
        "from cdpipe.core.program import main\nmain()\n"
    )
    environment = {**os.environ, **SHELLS[shell](["tunnelcd", *words.split()])}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False,
        cwd=Path(__file__).parents[3],
    )  # fmt: skip
    assert done.stderr == "heavy:\n"
    found = [line.strip('(" )') for line in done.stdout.replace("' '", "\n").splitlines()]
    assert {name for name in expected if any(name in line for line in found)} == expected
    assert len([line for line in found if line]) <= len(expected) + 2


def test_json_holds_nothing_that_a_terminal_obeys(capsys: pytest.CaptureFixture[str]) -> None:
    echo_json({"a\x1b[2J": ["\x9b", float("inf"), True, Path("x")]})
    out = capsys.readouterr().out
    assert "\x1b" not in out and "\x9b" not in out
    assert json.loads(out) == {"a\x1b[2J": ["\x9b", None, True, "x"]}


def test_each_kind_of_names_has_a_title() -> None:
    assert "settings" not in tools._TITLES


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("moment", ["imports", "command"])
def test_an_interrupt_is_one_line_from_the_first_moment_on(moment: str, name: str) -> None:
    number = signal.Signals[name]
    # the program says on standard output that it got there, and waits
    program = {
        "imports": (
            "import sys, time, types\n"
            "class Slow:\n"
            "    def find_spec(self, name, *_):\n"
            "        if name == 'eval.cli.main':\n"
            "            print('there', flush=True); time.sleep(30)\n"
            "sys.meta_path.insert(0, Slow())\n"
            "from cdpipe.core.program import main\nmain()\n"
        ),
        "command": (
            "import time, eval.cli.doctor as doctor\n"
            "doctor.examine = lambda: (print('there', flush=True), time.sleep(30))\n"
            "from cdpipe.core.program import main\nmain()\n"
        ),
    }[moment]
    # the tests may run under `nohup`, which has every child ignore SIGHUP
    usual = "default_int_handler" if name == "SIGINT" else "SIG_DFL"
    heeded = f"import signal; signal.signal(signal.{name}, signal.{usual})\n"
    process = subprocess.Popen(
        [sys.executable, "-c", heeded + program, "doctor"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3],
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=20)
    said = {"imports": "nothing was written", "command": "nothing half-written is left"}[moment]
    by = "" if name == "SIGINT" else f" by {name}"
    assert (process.returncode, err) == (128 + number, f"interrupted{by}; {said}\n")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_closed_terminal_leaves_a_command_of_nohup_alone() -> None:
    program = (
        "import os, signal, eval.cli.doctor as doctor\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "doctor.examine = lambda: (os.kill(os.getpid(), signal.SIGHUP), print('went on', flush=True), os._exit(0))\n"
        "from cdpipe.core.program import main\nmain()\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program, "doctor"],
        capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3],
    )  # fmt: skip
    assert (ended.stdout, ended.stderr) == ("went on\n", "")


@pytest.mark.skipif(os.name != "posix", reason="Windows removes no folder in which a program works")
def test_a_working_folder_that_was_removed_is_one_line(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    program = "import os, sys\nos.rmdir(os.getcwd())\nfrom cdpipe.core.program import main\nmain()\n"
    ended = subprocess.run(
        [sys.executable, "-c", program, "simulate", "smoke/one_box", "--out", "x"],
        capture_output=True, text=True, check=False, cwd=gone,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )  # fmt: skip
    said = "error: the working folder was removed: change to one that is there\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", said)
