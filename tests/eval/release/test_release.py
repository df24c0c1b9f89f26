"""Releases of pairs: made in parts, packed, described, unpacked and scored; damage is one line."""

import csv
import hashlib
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from eval.core.cluster import Where
from eval.core.output import only_writer
from eval.plans.splits import load_splits
from eval.release import making
from eval.release.archive import list_files, pack, read_sums, unpack_release, write_sums
from eval.release.content import load_release, release_names
from eval.release.making import make_release
from scenarios.library import load_scenario
from scenarios.schema import Scenario

Command = Callable[..., tuple[int, str, str]]
CONTENT = """\
description: Two tiny pairs
published: 2026-11-26
settings: [sensor.mode=512x10, sensor.sub_rays=1, platform.scan_spacing_m=3]
pairs: {smoke/one_box: "20000:20001", smoke/unchanged: "20000:20001"}
"""
SETTINGS = ("sensor.mode=512x10", "sensor.sub_rays=1", "platform.scan_spacing_m=3")


@pytest.fixture(scope="module", name="tiny")
def tiny_fixture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("content") / "tiny.yaml"
    path.write_text(CONTENT)
    return path


@pytest.fixture(scope="module", name="made")
def made_fixture(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of the tiny release, made in two steps."""
    file = tmp_path_factory.mktemp("made") / "tiny.zip"
    release = load_release(str(tiny))
    first = make_release(release, file, limit=1)
    assert (first.n_made, first.n_kept, first.n_left, first.n_bytes) == (1, 0, 1, 0)
    assert not file.exists()
    second = make_release(release, file)
    assert (second.n_made, second.n_kept, second.n_left, second.n_bytes) == (1, 1, 0, file.stat().st_size)
    assert [path.name for path in file.parent.iterdir()] == ["tiny.zip"]
    return file


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def rewrite(source: Path, target: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """Write the archive again with other members."""
    with zipfile.ZipFile(source) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return target


def test_the_shipped_release_has_twenty_pairs_of_the_development_split() -> None:
    assert release_names() == ["lite"]
    release, dev = load_release("lite"), load_splits().dev
    assert len({pair.name for pair in release.pairs}) == len({(p.family, p.seed) for p in release.pairs}) == 20
    assert all(dev.first <= pair.seed < dev.end for pair in release.pairs)
    assert {pair.scenario.sensor.mode for pair in release.pairs} == {"512x10"}


def test_sessions_and_truth_together_are_the_simulated_pair(
    made: Path, tmp_path: Path, simulated_once: Callable[[Scenario, int], Path]
) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path / "raw")
    rows = read_rows(tmp_path / "raw" / "truth" / "pairs.csv")
    name = next(row["name"] for row in rows if row["family"] == "smoke/one_box")
    unpack_release(made, tmp_path / "pairs", with_truth=True)
    (tmp_path / "pairs" / name).rename(tmp_path / "pair")
    original = simulated_once(load_scenario("smoke/one_box", 20000, SETTINGS), 20000)
    assert list_files(tmp_path / "pair") == list_files(original)
    for each in list_files(original):
        assert (tmp_path / "pair" / each).read_bytes() == (original / each).read_bytes(), each


def test_the_sessions_tell_nothing_of_the_truth(made: Path, tmp_path: Path, tiny: Path) -> None:
    assert unpack_release(made, tmp_path / "blind") == 2
    files = list_files(tmp_path / "blind")
    assert {name.split("/")[0] for name in files} == {"README.md"} | {p.name for p in load_release(str(tiny)).pairs}
    kinds = {"/".join(name.split("/")[2:]) for name in files if "/" in name}
    assert kinds == {"session.json", "odometry.npz", "chunks/00000.npz"}
    for name in files:
        if name.endswith("session.json"):
            text = (tmp_path / "blind" / name).read_text()
            assert "simulate" not in text and "smoke" not in text


def test_a_trivial_answer_to_an_unpacked_pair_is_scored(made: Path, tmp_path: Path, command: Command) -> None:
    code, out, err = command("dataset", "--unpack", made, "--out", tmp_path / "pairs", "--with-truth", "--quiet")
    assert (code, out, err) == (0, "", "")
    answer = tmp_path / "answer"
    answer.mkdir()
    nothing = {"format": "tunnelcd-answer", "format_version": 1, "method": "nothing", "status": "merge_refused"}
    (answer / "answer.json").write_text(json.dumps({**nothing, "error": "never merges"}))
    rows = read_rows(tmp_path / "pairs" / "pairs.csv")
    scores = {
        row["family"]: json.loads(command("score", tmp_path / "pairs" / row["name"], answer, "--json")[1])
        for row in rows
    }
    assert scores["smoke/one_box"]["region_recall"] == 0
    assert scores["smoke/one_box"]["n_changes"] == 1 and scores["smoke/unchanged"]["n_changes"] == 0


def test_options_that_a_release_has_no_use_for(tmp_path: Path, command: Command) -> None:
    out = ("--out", tmp_path / "x")
    for words, told in (
        (("--release", "lite", "--unpack", "r.zip"), "name one of both"),
        (("--release", "lite", "--draws", "3"), "leave FAMILY, --seeds, --world, --draws"),
        (("--unpack", "r.zip", "--workers", "2"), "leave --workers, --scheduler, --limit out"),
    ):
        code, _, err = command("dataset", *words, *out)
        assert (code, told in err) == (2, True), err


def test_a_card_names_the_file_and_a_recording_is_refused(made: Path, tiny: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(made) as archive:
        assert f"`tunnelcd dataset --release {tiny.name} --out FILE.zip`" in archive.read("README.md").decode()
    assert load_release("lite").asked == "lite"
    (tmp_path / "drive.osf").write_bytes(b"x")
    (tmp_path / "rec.yaml").write_text("recording: {sessions: [drive.osf]}\nprops: []\n")
    pairs = {str(tmp_path / "rec.yaml"): "20000:20001"}
    (tmp_path / "own.yaml").write_text(f"description: x\npublished: 2026-11-26\npairs: {json.dumps(pairs)}\n")
    with pytest.raises(InputError, match=r"own\.yaml: pairs\..*rec\.yaml: its world is a recording"):
        load_release(str(tmp_path / "own.yaml"))


def test_digests_are_of_all_files_and_those_of_other_programs(made: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path)
    assert [*read_sums(tmp_path)] == [name for name in list_files(tmp_path) if name != "SHA256SUMS"]
    if shutil.which("sha256sum"):
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=tmp_path, check=True)


def test_the_same_pairs_give_the_same_archive(made: Path, tmp_path: Path, tiny: Path) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path / "raw")
    pack(tmp_path / "raw", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == made.read_bytes()
    outcome = make_release(load_release(str(tiny)), tmp_path / "raw")
    assert (outcome.n_made, outcome.n_kept) == (0, 2)
    pack(tmp_path / "raw", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == made.read_bytes()


def test_a_pair_that_was_interrupted_is_made_again(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: Path
) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path / "raw")
    release = load_release(str(tiny))
    lost, kept = release.pairs
    shutil.rmtree(tmp_path / "raw" / "sessions" / lost.name)
    (tmp_path / "raw" / ".making-0a1b2c_d").mkdir()  # as a killed run leaves it

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(making, "simulate_pair", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make_release(release, tmp_path / "raw")
    assert {path.name for path in (tmp_path / "raw" / "sessions").iterdir()} == {kept.name}
    assert not list((tmp_path / "raw").glob(".making-*"))
    monkeypatch.undo()
    assert make_release(release, tmp_path / "raw").n_made == 1
    pack(tmp_path / "raw", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == made.read_bytes()


def test_a_release_that_could_not_be_unpacked_is_not_packed_and_keeps_its_pairs(
    made: Path, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = tmp_path / "own.zip.parts"
    with zipfile.ZipFile(made) as archive:
        archive.extractall(parts)
    files, n_bytes = list_files(parts), made.stat().st_size
    for most_bytes in (n_bytes // 2, n_bytes - 1):
        monkeypatch.setattr("eval.release.archive._MOST_BYTES", most_bytes)
        with pytest.raises(InputError, match="its archive is larger than"):
            make_release(load_release(str(tiny)), tmp_path / "own.zip")
        assert [path.name for path in tmp_path.iterdir()] == [parts.name] and list_files(parts) == files
    monkeypatch.setattr("eval.release.archive._MOST_BYTES", n_bytes)
    assert make_release(load_release(str(tiny)), tmp_path / "own.zip").n_bytes == n_bytes
    assert unpack_release(tmp_path / "own.zip", tmp_path / "pairs") == 2


def test_a_second_release_in_one_place_is_refused(tiny: Path, tmp_path: Path) -> None:
    left = tmp_path / "own.zip.parts" / ".making-0a1b2c_d"  # what the first works in
    left.mkdir(parents=True)
    with (
        only_writer(left.parent, "tunnelcd dataset --release"),
        pytest.raises(InputError, match="another `tunnelcd dataset --release` writes there"),
    ):
        make_release(load_release(str(tiny)), tmp_path / "own.zip")
    assert left.is_dir()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CONTENT.replace("20000:20001", "30000:30001", 1), "seed 30000 is not of the development split"),
        (CONTENT.replace("20000:20001", "0:1", 1), "seed 0 is not of the development split"),
        (CONTENT.replace("smoke/one_box", "smoke/one_bx"), 'did you mean "smoke/one_box"'),
        (CONTENT.replace("mode=512x10", "mod=512x10"), "own.yaml: sensor.mod = "),
        (CONTENT.replace("published", "publishd"), 'did you mean "published"'),
        ("description: x\npublished: 2026-11-26\npairs: {}\n", "pairs"),
    ],
)
def test_mistakes_of_a_content_file(tmp_path: Path, command: Command, text: str, said: str) -> None:
    (tmp_path / "own.yaml").write_text(text)
    code, out, err = command("dataset", "--release", tmp_path / "own.yaml", "--out", tmp_path / "own.zip")
    assert (code, out) == (2, "") and said in err and "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["own.yaml"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--release", "lit", "--out", "x.zip"], 'did you mean "lite"'),
        (["narrow", "--release", "lite", "--out", "x.zip"], "leave FAMILY"),
        (["--release", "lite", "--out", "x.zip", "--scheduler", "tcp://127.0.0.1:1"], "give --workers"),
        (["--release", "lite"], "name it with --out"),
        (["narrow", "--out", "x"], "expected FAMILY... with --seeds A:B"),
        (["--unpack", "missing.zip", "--out", "x"], "missing.zip: missing"),
    ],
)
def test_mistaken_options(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = command("dataset", *words)
    assert (code, out, err.count("\n")) == (2, "", 1) and said in err
    assert not list(tmp_path.iterdir())


def test_a_file_or_folder_of_others_is_not_touched(made: Path, tmp_path: Path, tiny: Path) -> None:
    release = load_release(str(tiny))
    with pytest.raises(InputError, match="exists already"):
        make_release(release, made)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match=r"holds thesis\.tex, which is not of this release"):
        make_release(release, tmp_path / "own")
    assert list_files(tmp_path / "own") == ["thesis.tex"]
    for name in (".making-of", ".making-of-it"):
        (tmp_path / "film").mkdir(exist_ok=True)
        (tmp_path / "film" / name).mkdir()
        (tmp_path / "film" / name / "cut.txt").write_text("x")
        with pytest.raises(InputError, match=r"holds \.making-of"):
            make_release(release, tmp_path / "film")
    assert list_files(tmp_path / "film") == [".making-of-it/cut.txt", ".making-of/cut.txt"]
    with pytest.raises(InputError, match="--scheduler: a release is made on this machine"):
        make_release(release, tmp_path / "x", Where(scheduler="tcp://127.0.0.1:1"))


def test_links_do_not_lead_out_of_a_release(tmp_path: Path, tiny: Path) -> None:
    release, others = load_release(str(tiny)), tmp_path / "others"
    (others / "deep").mkdir(parents=True)
    for link, out in (("r.zip.parts", "r.zip"), ("folder/sessions", "folder"), ("folder/.making-0a1b2c_d", "folder")):
        (tmp_path / "folder").mkdir(exist_ok=True)
        (tmp_path / link).symlink_to(others)
        with pytest.raises(InputError, match="is a link"):
            make_release(release, tmp_path / out)
        (tmp_path / link).unlink()
    assert [path.name for path in others.rglob("*")] == ["deep"]


def test_damage_is_one_line_and_nothing_is_left(made: Path, tmp_path: Path, command: Command) -> None:
    content = made.read_bytes()

    def forge(members: dict[str, bytes]) -> None:
        name = next(each for each in members if each.endswith("changes.json"))
        members[name] += b" "

    def escape(members: dict[str, bytes]) -> None:
        members["../evil"] = b"x"

    def escape_with_digest(members: dict[str, bytes]) -> None:
        members["sessions/../../evil"] = b"x"
        members["SHA256SUMS"] += (
            b"2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881  sessions/../../evil\n"
        )

    def forget(members: dict[str, bytes]) -> None:
        del members["truth/pairs.csv"]

    def add(*names: str) -> Callable[[dict[str, bytes]], None]:
        def change(members: dict[str, bytes]) -> None:
            members |= dict.fromkeys(names, b"x")
            digest = hashlib.sha256(b"x").hexdigest()
            members["SHA256SUMS"] += "".join(f"{digest}  {name}\n" for name in names).encode()

        return change

    pair = f"sessions/{'0' * 16}"
    bad = tmp_path / "bad.zip"
    for change, said in (
        (forge, "its digest differs"), (escape, "not in both"), (escape_with_digest, "name of a file"),
        (forget, "not in both"), (lambda members: members.pop("SHA256SUMS"), "no SHA256SUMS in it"),
        (add(f"{pair}/{'a' * 300}"), "longer than a file's name"),
        (add(f"{pair}/{'a/' * 3000}a"), "longer than a file's name"),
        (add(f"{pair}/a", f"{pair}/a/b"), "a file and a folder"), (add(f"{pair}/a", f"{pair}/A"), "stands twice"),
    ):  # fmt: skip
        rewrite(made, bad, change)
        code, out, err = command("dataset", "--unpack", bad, "--out", tmp_path / "out", "--quiet")
        assert (code, out, err.count("\n")) == (2, "", 1) and said in err
    for damaged in (b"", b"PK", content[: len(content) // 2], content[:1000] + b"\0" * 1000 + content[2000:]):
        bad.write_bytes(damaged)
        code, out, err = command("dataset", "--unpack", bad, "--out", tmp_path / "out", "--quiet")
        assert (code, out, err.count("\n")) == (2, "", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.zip"]


def test_croissant_metadata_are_valid_and_read(made: Path, tmp_path: Path) -> None:
    pytest.importorskip("mlcroissant", reason="pip install 'tunnelcd[croissant]'")
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path)
    # in a process of its own: its packages warn of one another
    program = (
        "import mlcroissant, sys\n"
        "data = mlcroissant.Dataset(sys.argv[1])\n"
        "assert not data.metadata.issues.errors and not data.metadata.issues.warnings, data.metadata.issues.report()\n"
        "for row in data.records(sys.argv[2]): print(row[sys.argv[3]])\n"
    )
    words = [str(tmp_path / "croissant.json"), "pairs", "pairs/seed"]
    done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["20000", "20000"]), done.stderr


def test_metadata_describe_every_file_of_the_pairs(made: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(made) as archive:
        archive.extractall(tmp_path)
    document = json.loads((tmp_path / "croissant.json").read_text())
    patterns = [each["includes"] for each in document["distribution"] if "includes" in each]
    described = {path for pattern in patterns for path in tmp_path.glob(pattern)} | {tmp_path / "truth" / "pairs.csv"}
    pairs = {path for kind in ("sessions", "truth") for path in (tmp_path / kind).rglob("*") if path.is_file()}
    left = {path for path in pairs - described if path.name != "session.json"}
    assert left == set() and all(any(tmp_path.glob(pattern)) for pattern in patterns)
    (table,) = [each for each in document["distribution"] if "contentUrl" in each]
    write_sums(tmp_path)
    assert table["sha256"] == read_sums(tmp_path)[table["contentUrl"]]
