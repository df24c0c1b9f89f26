"""`tunnelcd doctor`: what it names, and that each of its checks can fail."""

from __future__ import annotations

import contextlib
import importlib.resources
import shutil
import socket
import sys
import tomllib
from collections.abc import Callable
from email.message import Message
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eval.cli import doctor, doctor_checks
from eval.cli.doctor import Finding, examine, faults

Command = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def fine() -> str:
    return "fine"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave nothing but the imports of what is installed: the checks themselves are tried one by one."""
    monkeypatch.setattr(doctor_checks, "OF_PACKAGE", {})
    monkeypatch.setattr(doctor_checks, "OF_EXTRA", {})
    monkeypatch.setattr(doctor_checks, "weights", fine)


def row(what: str) -> Finding:
    return next(each for each in examine() if each.what == what)


@pytest.mark.usefixtures("quick")
def test_everything_is_named_and_fine_here(command: Command) -> None:
    code, out, err = command("doctor")
    assert (code, err) == (0, "")
    named = [line[:15].strip() for line in out.splitlines()]
    assert named[:4] == ["Python", "machine", "threads", "disk"]
    needed = [line.partition(">")[0] for line in PROJECT["dependencies"]]
    extras = [f"extra {name}" for name in PROJECT["optional-dependencies"]]
    assert named[4:-1] == [*needed, "weights", *extras]
    assert out.splitlines()[-1] == "all that is required works"


@pytest.mark.usefixtures("quick")
def test_every_fault_is_told_with_what_mends_it(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name in ("mujoco", "viser"):
            raise metadata.PackageNotFoundError(name)
        return {"numpy": "1.26.4", "dask": "2026.8.0"}.get(name, "9999.0")

    monkeypatch.setattr(doctor, "metadata", SimpleNamespace(**vars(metadata) | {"version": version}))
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    code, out, err = command("doctor")
    assert code == 2
    wanted = {line.partition(">")[0]: line for line in PROJECT["dependencies"]}
    assert err.splitlines() == [
        f"error: numpy: 1.26.4 is not >=2.2: pip install --upgrade '{wanted['numpy']}'",
        f"error: mujoco: not installed: pip install '{wanted['mujoco']}'",
        "error: small_gicp: 9999.0; ModuleNotFoundError: import of small_gicp halted; None in sys.modules: "
        f"pip install --force-reinstall '{wanted['small_gicp']}'",
    ]
    # an extra that is not there is no fault
    assert "extra view      absent  no viser: pip install 'tunnelcd[view]'" in out.splitlines()
    assert "extra cluster   ok      dask 2026.8.0" in out.splitlines()


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("name", "version", "what", "state"),
    [
        ("numpy", "2.1.3", "numpy", "broken"),
        ("numpy", "2.10.0", "numpy", "ok"),
        ("numpy", "2.2.0rc1", "numpy", "broken"),
        ("torch", "2.13.0+cpu", "torch", "ok"),
        ("embreex", "4.4.0", "embreex", "broken"),  # needs its post-release
        ("embreex", "4.4.0.post1", "embreex", "ok"),
        ("pandas", "unknown", "pandas", "broken"),
        ("py4dgeo", "0.9.9", "extra m3c2", "broken"),
        ("pytest", "8.1.0", "extra dev", "broken"),  # by way of the extra `test`
        ("pytest", "8.1.0", "extra test", "broken"),
    ],
)
def test_what_is_installed_is_held_against_the_ranges(
    name: str, version: str, what: str, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {"py4dgeo": "1.2.0", name: version}
    fake = SimpleNamespace(**vars(metadata) | {"version": lambda asked: found.get(asked, "9999.0")})
    monkeypatch.setattr(doctor, "metadata", fake)
    monkeypatch.setattr(doctor, "_import", lambda name: "")
    told = row(what)
    assert told.state == state
    if state == "broken":
        assert f"{version} is not >=" in told.told and "pip install --upgrade '" in f"{told.told}{told.mend}"


@pytest.mark.usefixtures("quick")
def test_a_python_outside_the_range_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.platform, "python_version", lambda: "3.10.13")
    (line,) = faults([row("Python")])
    assert line.startswith("Python: 3.10.13, ") and line.endswith("tunnelcd needs Python >=3.11: install one")
    monkeypatch.setattr(doctor.platform, "python_version", lambda: "3.14.0rc1")
    assert row("Python").state == "ok"


def test_an_installed_package_tells_the_same_requirements_as_a_source_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [*PROJECT["dependencies"]]
    for extra, own in PROJECT["optional-dependencies"].items():
        for line in own:
            wanted, _, marker = line.partition(";")
            both = f"({marker.strip()}) and " if marker else ""
            lines.append(f'{wanted.strip()}; {both}extra == "{extra}"')
    about = Message()
    about["Requires-Python"] = PROJECT["requires-python"]
    for extra in PROJECT["optional-dependencies"]:
        about["Provides-Extra"] = extra
    told = {"metadata": lambda name: about, "requires": lambda name: lines}
    monkeypatch.setattr(doctor, "metadata", SimpleNamespace(**vars(metadata) | told))

    def plain(needs: Any) -> dict[str, list[tuple[str, str]]]:
        groups = {"": needs.packages, **needs.extras}
        return {name: [(each.name, str(each.specifier)) for each in own] for name, own in groups.items()}

    installed, source = (doctor._read_requirements(place) for place in (tmp_path / "absent", doctor._PYPROJECT))
    assert (installed.python, plain(installed)) == (source.python, plain(source))
    assert ("pytest", ">=8.2") in plain(source)["dev"]


@pytest.mark.usefixtures("quick")
def test_an_extra_that_is_broken_is_told_and_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> str:
        raise RuntimeError("two lines\nof it")

    monkeypatch.setattr(doctor_checks, "OF_EXTRA", {"cluster": broken})
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    found = row("extra cluster")
    assert found.state == "broken" and found.told.endswith("two lines of it: pip install 'tunnelcd[cluster]'")
    assert faults([found]) == []


def test_a_world_a_ray_the_weights_and_a_registration_are_fine() -> None:
    assert doctor_checks.ray() == "a ray meets a wall at 3.000 m"
    assert doctor_checks.world().startswith("builds smoke/one_box: 4 geoms before, ")
    assert doctor_checks.weights().endswith("as their cards say")
    assert doctor_checks.threads().endswith(("thread", "threads"))
    assert doctor_checks.registration().startswith("aligns a shifted room within 0.")


@pytest.mark.parametrize("extra", sorted(doctor_checks.OF_EXTRA))
def test_the_extras_that_are_here_do_their_job(extra: str) -> None:
    names = [line.partition(">")[0].partition("[")[0] for line in PROJECT["optional-dependencies"][extra]]
    try:
        for name in names:
            metadata.version(name)
    except metadata.PackageNotFoundError:
        pytest.skip(f"the extra `{extra}` is not installed")
    assert doctor_checks.OF_EXTRA[extra]()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda content: content[:-4] + b"\0\0\0\0", r"sphere\.safetensors is [0-9a-f]{16}, its model card"),
        (lambda content: content[:1000], "."),  # cut short: whatever the library says
    ],
)
def test_a_damaged_checkpoint_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes], words: str
) -> None:
    shutil.copytree(
        ROOT / "cdpipe" / "descriptors" / "weights",
        tmp_path / "descriptors" / "weights",
        ignore=shutil.ignore_patterns("*.py"),
    )
    file = tmp_path / "descriptors" / "weights" / "sphere.safetensors"
    file.write_bytes(damage(file.read_bytes()))
    monkeypatch.setattr(importlib.resources, "files", lambda _: tmp_path)
    with pytest.raises(Exception, match=words):
        doctor_checks.weights()
    monkeypatch.setattr(doctor_checks, "OF_PACKAGE", {})
    found = doctor._tried("weights", doctor_checks.weights, "install tunnelcd anew")
    assert found.state == "broken" and faults([found])[0].endswith(": install tunnelcd anew")


def test_a_cluster_starts_where_the_port_of_its_dashboard_is_taken() -> None:
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):  # another program holds it already, which serves the test as well
            other.bind(("127.0.0.1", 8787))
            other.listen()
        assert doctor_checks.cluster() == "a worker computes"


@pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="reads the sockets of Linux")
def test_the_cluster_that_is_tried_listens_on_this_machine_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    found: list[str] = []

    class Watched(distributed.Client):
        def submit(self, *args: Any, **settings: Any) -> Any:
            own = {str(each.readlink()) for each in Path("/proc/self/fd").iterdir() if each.is_symlink()}
            for table in ("tcp", "tcp6"):
                rows = [line.split() for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]]
                found.extend(row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own)
            return super().submit(*args, **settings)

    monkeypatch.setattr(distributed, "Client", Watched)
    doctor_checks.cluster()
    assert found and all(address.startswith("0100007F:") for address in found)


def test_wrong_answers_of_packages_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Caster:
        def __init__(self, meshes: object) -> None:
            pass

        def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, None, None]:
            return np.array([2.9]), None, None

    def align(target: np.ndarray, *_: object, **__: object) -> SimpleNamespace:
        return SimpleNamespace(T_target_source=np.eye(4))

    monkeypatch.setattr("sim.geometry.raycast.Caster", Caster)
    with pytest.raises(RuntimeError, match=r"a wall 3\.0 m away at 2\.9 m"):
        doctor_checks.ray()
    monkeypatch.setattr("small_gicp.align", align)
    with pytest.raises(RuntimeError, match=r"was aligned 14\.2 cm off"):
        doctor_checks.registration()
