"""Packed results: complete, checked, hostile files refused, and the page of them."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from eval.leaderboard.calls import digest_method, read_evaluation
from eval.leaderboard.packing import pack_submission
from eval.leaderboard.page import take_rows, write_leaderboard
from eval.leaderboard.submission import CheckedFile, read_submission, score_again
from eval.plans.splits import seal_seeds, version_name
from eval.running.runfolder import RunFolder, write_json
from eval.scoring import scoring

ONE_BOX = "smoke/one_box"
NAN = float("nan")
Change = Callable[[dict[str, bytes]], None]


@pytest.fixture
def run(evaluated: RunFolder, tmp_path: Path) -> RunFolder:
    shutil.copytree(evaluated.path, tmp_path / "copy")
    return RunFolder(tmp_path / "copy")


@pytest.fixture
def packed(evaluated: RunFolder, tmp_path: Path) -> Path:
    assert pack_submission(evaluated, "", tmp_path / "mine.zip") == 2
    return tmp_path / "mine.zip"


def rewrite(path: Path, change: Change) -> Path:
    """Write the archive anew with other members."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    changed = path.with_name("changed.zip")
    with zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return changed


def in_manifest(change: Callable[[dict[str, Any]], None]) -> Change:
    def whole(members: dict[str, bytes]) -> None:
        document = json.loads(members["submission.json"])
        change(document)
        members["submission.json"] = json.dumps(document).encode()

    return whole


def in_row(**values: Any) -> Change:
    return in_manifest(lambda document: document["pairs"][0]["row"].update(values))


def test_what_was_packed_is_read_and_scored_again(evaluated: RunFolder, packed: Path) -> None:
    found = read_submission(packed)
    assert found.content.name == "mine" and found.content.plan == "smoke"
    assert [(pair.scenario, pair.seed) for pair in found.content.pairs] == [
        (ONE_BOX, 20000),
        ("smoke/unchanged", 20000),
    ]
    assert score_again(found, evaluated).n_checked == 2
    # no folder of this machine is in it
    text = found.content.model_dump_json()
    assert str(evaluated.path) not in text and "script.py" in text and str(evaluated.path.parent) not in text


def test_the_same_results_give_the_same_bytes(evaluated: RunFolder, packed: Path, tmp_path: Path) -> None:
    pack_submission(evaluated, "mine", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == packed.read_bytes()


def test_a_method_that_was_not_evaluated_is_answered_with_those_that_were(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--as nobody: no method of this name was evaluated here, but mine$"):
        pack_submission(run, "nobody", tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()


def test_methods_are_told_by_their_names_and_not_by_their_folders(run: RunFolder, tmp_path: Path) -> None:
    own = run.path / "evaluations" / "mine" / "evaluation.json"
    document = json.loads(own.read_text())
    write_json(run.path / "evaluations" / path_part("k: 1") / "evaluation.json", {**document, "name": "k: 1"})
    with pytest.raises(InputError, match=r"no method of this name was evaluated here, but k: 1, mine$"):
        pack_submission(run, "nobody", tmp_path / "x.zip")
    with pytest.raises(InputError, match=r"holds k: 1, mine: name one with --as$"):
        pack_submission(run, "", tmp_path / "x.zip")


def test_results_that_lack_a_pair_are_not_packed(run: RunFolder, tmp_path: Path) -> None:
    run.cell(ONE_BOX, 20000, "mine").unlink()
    with pytest.raises(InputError, match=r"mine lacks 1 of 2 pairs \(smoke/one_box 20000\)"):
        pack_submission(run, "mine", tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()


def test_results_of_another_simulation_are_not_packed(run: RunFolder, tmp_path: Path) -> None:
    changes = run.pair(ONE_BOX, 20000) / "truth" / "changes.json"
    changes.write_text(changes.read_text() + " ")
    with pytest.raises(InputError, match="simulated anew since"):
        pack_submission(run, "mine", tmp_path / "x.zip")
    shutil.rmtree(run.path / "pairs")  # pairs can be made again: nothing contradicts
    assert pack_submission(run, "mine", tmp_path / "x.zip") == 2


def test_an_answer_that_was_exchanged_after_its_call_is_not_packed(run: RunFolder, tmp_path: Path) -> None:
    answer = run.answer(ONE_BOX, 20000, "mine") / "answer.json"
    answer.write_text(answer.read_text() + " ")
    with pytest.raises(InputError, match=r"smoke/one_box 20000 \(its answer was exchanged\)"):
        pack_submission(run, "mine", tmp_path / "x.zip")


@pytest.mark.parametrize("name", ["other", "../run"])
def test_methods_that_were_not_evaluated_are_not_packed(evaluated: RunFolder, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError):
        pack_submission(evaluated, name, tmp_path / "x.zip")
    with pytest.raises(InputError, match=r"ends in \.zip"):
        pack_submission(evaluated, "mine", tmp_path / "x.tar")


def test_what_would_not_be_read_is_not_packed(
    evaluated: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_large(_: bytes) -> None:
        raise ValueError("30 MB, more than the 24 MB it may have")

    for name, value in (("parse_json", too_large), ("MOST_BYTES", 9)):
        with monkeypatch.context() as patched:
            patched.setattr(f"eval.leaderboard.packing.{name}", value)
            with pytest.raises(InputError, match=r"mine: 2 pairs are too many for one file \(.*--seeds"):
                pack_submission(evaluated, "mine", tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()


def test_figures_that_no_table_holds_are_not_packed(run: RunFolder, tmp_path: Path) -> None:
    cell = run.cell(ONE_BOX, 20000, "mine")
    document = json.loads(cell.read_text())
    write_json(cell, {**document, "row": {**document["row"], "theirs": 1e300}})
    with pytest.raises(InputError, match=r"theirs = 1e\+300: larger than any figure is: a leaderboard would not read"):
        pack_submission(run, "mine", tmp_path / "x.zip")


def test_programs_of_one_name_keep_their_digests(run: RunFolder, tmp_path: Path) -> None:
    own = run.path / "evaluations" / "mine" / "evaluation.json"
    document = json.loads(own.read_text())
    weights = {"/m1/best.pt": "a" * 64, "/m2/best.pt": "b" * 64}
    write_json(own, {**document, "programs": {**document["programs"], **weights}})
    for path in run.path.glob("evaluations/mine/*/*.json"):
        digest = digest_method(read_evaluation(run, "mine"))
        write_json(path, {**json.loads(path.read_text()), "method_digest": digest})
    pack_submission(run, "mine", tmp_path / "x.zip")
    programs = read_submission(tmp_path / "x.zip").content.programs
    assert (programs["best.pt"], programs["best.pt (2)"]) == ("a" * 64, "b" * 64)


PART = {"sha256": "0" * 64, "n_bytes": 1}
NPZ = "answers/00000/answer.npz"
HOSTILE: dict[str, tuple[Change, str]] = {
    "another answer": (lambda m: m.update({NPZ: m[NPZ][:-1] + b"x"}), "digest differs"),
    "a shorter answer": (lambda m: m.update({NPZ: b""}), "0 bytes"),
    "no answer": (lambda m: m.pop("answers/00001/answer.json") and None, "not in both"),
    "one more": (lambda m: m.update({"../../evil.py": b"x"}), "not in both"),
    "no manifest": (lambda m: m.pop("submission.json") and None, "no submission.json"),
    "no JSON": (lambda m: m.update({"submission.json": b"{"}), "Expecting"),
    "deep JSON": (lambda m: m.update({"submission.json": b"[" * 10_000}), "nested"),
    "unknown key": (in_manifest(lambda d: d.update({"x": 1})), "x"),
    "text for a number": (in_row(region_recall="<b>"), "expected a number"),
    "columns without end": (in_row(**{f"c{n}": None for n in range(1_000)}), "pairs.0.row"),
    "a list for a number": (in_row(region_recall=[1]), "region_recall"),
    "a share for a truth value": (in_row(is_unchanged_pair=0.5), "expected a truth value"),
    "a figure without end": (in_row(t_total_s=float("inf")), "larger than any figure"),
    "another pair": (in_row(seed=4), "of another pair"),
    "another method": (in_row(variant="tunnelcd"), "another method"),
    "twice": (in_manifest(lambda d: d["pairs"][1].update(d["pairs"][0])), "stands twice"),
    "other metrics": (in_manifest(lambda d: d.update({"metrics_version": 3})), "metrics version 3"),
    "a long name": (in_manifest(lambda d: d.update({"plan": "p" * 1000})), "plan"),
    "a name of a member": (in_manifest(lambda d: d["pairs"][0]["files"].update({"../x": PART})), "files"),
    "a status and no answer": (in_manifest(lambda d: d["pairs"][0]["files"].pop("answer.npz") and None), "no answer"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_file_that_is_not_what_was_packed_is_one_line(packed: Path, name: str) -> None:
    change, said = HOSTILE[name]
    changed = rewrite(packed, change)
    with pytest.raises(InputError) as caught:
        read_submission(changed)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(changed))


def test_damaged_archives_and_bombs_are_one_line(packed: Path, tmp_path: Path) -> None:
    content = packed.read_bytes()
    bomb = tmp_path / "bomb.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("submission.json", bytes(200 << 20))
    files = {"cut": content[:-30], "none": b"", "text": b"hello", "before": b"MZ" + content, "after": content + b"x"}
    for name, damaged in files.items():
        (tmp_path / name).write_bytes(damaged)
    for path in (bomb, *(tmp_path / name for name in files), tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError) as caught:
            read_submission(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_row_that_its_answer_does_not_earn_is_found(evaluated: RunFolder, packed: Path) -> None:
    found = read_submission(rewrite(packed, in_row(region_recall=1.0)))
    with pytest.raises(InputError, match=r"region_recall = 1\.0 in its row, and its answer scores 0\.0"):
        score_again(found, evaluated)


def test_the_page_is_made_of_the_rows_that_were_scored_again(evaluated: RunFolder, packed: Path) -> None:
    # less than what rounding may differ by: enough to stand before an equal answer
    scored = score_again(read_submission(rewrite(packed, in_row(object_f1_50=9e-7, theirs=3.0))), evaluated)
    row = scored.content.pairs[0].row
    assert row["object_f1_50"] == 0.0 and "theirs" not in row and row["variant"] == "mine"
    assert {name: row[name] for name in ("scenario", "seed")} == {"scenario": ONE_BOX, "seed": 20000}
    with pytest.raises(InputError, match="domain = in"):
        score_again(read_submission(rewrite(packed, in_row(domain="in"))), evaluated)


def as_pair(number: int, source: int, scenario: str) -> Change:
    """Hand in the row and the answer of a pair once more, under another name of it, in the place of another pair."""

    def whole(members: dict[str, bytes]) -> None:
        def change(document: dict[str, Any]) -> None:
            pair = json.loads(json.dumps(document["pairs"][source]))
            pair["scenario"] = pair["row"]["scenario"] = scenario
            document["pairs"][number] = pair

        in_manifest(change)(members)
        for file in ("answer.json", "answer.npz"):
            members[f"answers/{number:05d}/{file}"] = members[f"answers/{source:05d}/{file}"]

    return whole


@pytest.mark.parametrize("alias", ["smoke__one_box", "smoke/one box", "smoke/One_box"])
def test_no_easy_pair_counts_twice_under_another_name(packed: Path, alias: str) -> None:
    with pytest.raises(InputError, match="stands twice"):
        read_submission(rewrite(packed, as_pair(1, 0, alias)))


def test_pairs_are_called_as_in_the_run_that_scores_them(evaluated: RunFolder, packed: Path) -> None:
    found = read_submission(rewrite(packed, as_pair(0, 0, "smoke__one_box")))
    with pytest.raises(InputError, match="smoke__one_box 20000: is called smoke/one_box in "):
        score_again(found, evaluated)


@pytest.mark.parametrize(
    "claim",
    [{"object_iou_point": float("nan")}, {"false_regions_per_100m": None}, {"t_total_s": 0.0}, {"n_objects": 99}],
)
def test_no_column_of_a_row_can_be_left_out_or_bettered(
    evaluated: RunFolder, packed: Path, claim: dict[str, Any]
) -> None:
    (name,) = claim
    with pytest.raises(InputError, match=f"{name} = .* in its row, and its answer scores"):
        score_again(read_submission(rewrite(packed, in_row(**claim))), evaluated)

    def without(document: dict[str, Any]) -> None:
        del document["pairs"][0]["row"][name]

    with pytest.raises(InputError, match=f"{name} = None in its row"):
        score_again(read_submission(rewrite(packed, in_manifest(without))), evaluated)


def without_answer(**values: Any) -> Change:
    """Claim that the first pair cannot be made, with values in its row."""

    def whole(members: dict[str, bytes]) -> None:
        def change(document: dict[str, Any]) -> None:
            pair = document["pairs"][0]
            names = ("scenario", "seed", "variant", "preset", "family", "pair_kind", "metrics_version", "is_contended")
            row = {name: pair["row"][name] for name in names} | {"status": "failed", "error": "does not fit"}
            pair.update({"files": {}, "pair_digest": "", "row": {**row, **values}})

        for file in ("answer.json", "answer.npz"):
            del members[f"answers/00000/{file}"]
        in_manifest(change)(members)

    return whole


def test_a_pair_without_an_answer_has_no_figures(run: RunFolder, packed: Path) -> None:
    with pytest.raises(
        InputError, match=r"smoke/one_box 20000: region_recall = 1\.0 in its row, and there is no answer"
    ):
        read_submission(rewrite(packed, without_answer(region_recall=1.0)))
    unmade = read_submission(rewrite(packed, without_answer(region_recall=float("nan"), t_total_s=None)))
    with pytest.raises(InputError, match="smoke/one_box 20000: no answer, as a pair that cannot be made"):
        score_again(unmade, run)
    shutil.rmtree(run.pair(ONE_BOX, 20000))
    assert score_again(unmade, run).n_checked == 1


def test_a_pair_that_was_made_has_an_answer(packed: Path) -> None:
    def claim(document: dict[str, Any]) -> None:
        document["pairs"][0]["pair_digest"] = "0" * 64

    def change(members: dict[str, bytes]) -> None:
        without_answer()(members)
        in_manifest(claim)(members)

    with pytest.raises(InputError, match="was made, and there is no answer to it"):
        read_submission(rewrite(packed, change))


def test_a_pair_that_others_made_can_be_made(evaluated: RunFolder, packed: Path, tmp_path: Path) -> None:
    made = renamed(read_submission(packed), "theirs")
    unmade = read_submission(rewrite(packed, without_answer()))
    fewer = replace(made, content=made.content.model_copy(update={"pairs": made.content.pairs[:1]}))
    told = "smoke/one_box 20000: no answer, as a pair that cannot be made; "
    for other in (made, fewer):
        with pytest.raises(InputError, match=rf"changed\.zip: {told}.*mine\.zip has it: leave the file out"):
            write_leaderboard([other, unmade], tmp_path / "board.html", None)
    write_leaderboard([unmade], tmp_path / "alone.html", None)
    assert "1 pair could not be made, as the file says, and is in no mean." in (tmp_path / "alone.html").read_text()
    # so have reference rows of a pair, unless it could not be made there either
    rows = [{**pair.row, "variant": "ours"} for pair in made.content.pairs]
    (tmp_path / "report").mkdir()
    pd.DataFrame(rows).to_csv(tmp_path / "report" / "results.csv", index=False)
    with pytest.raises(InputError, match=rf"changed\.zip: {told}report has it: leave the file out"):
        write_leaderboard([unmade], tmp_path / "board.html", tmp_path / "report")
    rows[0] = {**unmade.content.pairs[0].row, "variant": "ours"}
    pd.DataFrame(rows).to_csv(tmp_path / "report" / "results.csv", index=False)
    write_leaderboard([unmade], tmp_path / "board.html", tmp_path / "report")


def test_folders_are_left_out_of_the_packed_command(run: RunFolder, tmp_path: Path) -> None:
    words = ["/usr/bin/python", "/home/me/a=b/m.py", "--w=/home/me/w.pt", "--n=3", "{out}"]
    path = run.path / "evaluations" / "mine" / "evaluation.json"
    document = {**json.loads(path.read_text()), "command": words}
    path.write_text(json.dumps(document))
    called = digest_method(read_evaluation(run, "mine"))
    for call in path.parent.glob("*/*.json"):
        call.write_text(json.dumps({**json.loads(call.read_text()), "method_digest": called}))
    pack_submission(run, "mine", tmp_path / "x.zip")
    assert read_submission(tmp_path / "x.zip").content.command == ["python", "m.py", "--w=w.pt", "--n=3", "{out}"]


def test_answers_are_scored_by_their_own_pairs_alone(run: RunFolder, packed: Path) -> None:
    shutil.rmtree(run.pair(ONE_BOX, 20000))
    with pytest.raises(InputError, match="holds no pair smoke/one_box 20000"):
        score_again(read_submission(packed), run)


def renamed(found: CheckedFile, name: str) -> CheckedFile:
    pairs = [pair.model_copy(update={"row": {**pair.row, "variant": name}}) for pair in found.content.pairs]
    return CheckedFile(found.path, found.sha256, found.content.model_copy(update={"name": name, "pairs": pairs}))


def test_the_page_shows_every_file_escaped(packed: Path, tmp_path: Path) -> None:
    found = read_submission(packed)
    evil = renamed(found, "<script>alert(1)</script>\x1b[2J")
    write_leaderboard([replace(found, n_checked=2), evil], tmp_path / "out" / "board.html", None)
    page = (tmp_path / "out" / "board.html").read_text()
    assert "&lt;script&gt;alert(1)" in page and "<script>alert" not in page and "\x1b" not in page
    assert page.count('class="entry"') == 2 and "Plan smoke, 2 pairs" in page
    assert 'placeholder = "Filter rows"' in page and "<button" not in page  # tables as those of a report
    assert "2 of 2 pairs" in page and "0 of 2 pairs" in page and found.sha256 in page
    assert "http" not in page.replace("http-equiv", "")


@pytest.mark.parametrize(
    ("seeds", "claimed", "told"),
    [
        ((20000, 20999), "sealed by tunnelcd 0.3.0", ""),
        (seal_seeds((20000, 20005), "tunnelcd 0.2.0"), "sealed by tunnelcd 0.2.0", ", sealed by tunnelcd 0.2.0"),
        (seal_seeds((20000, 20005), version_name()), "", f", sealed by {version_name()}"),
        (seal_seeds((20000, 20005), "tunnelcd 0.2.0"), "sealed by tunnelcd 0.1.0", ", seeds {} to {} of no test split"),
        ((40000, 40001), "sealed by tunnelcd 99.0.0", ", seeds {} to {} of no test split"),
        ((40000, 40001), "sealed by <b>", ", seeds {} to {} of no test split"),
        ((10000, 10001), "", ", seeds {} to {} of no test split"),
    ],
)
def test_the_split_is_that_of_the_seeds_whatever_is_claimed(
    packed: Path, tmp_path: Path, seeds: tuple[int, int], claimed: str, told: str
) -> None:
    found = read_submission(packed)
    pairs = [
        pair.model_copy(update={"seed": seed, "row": {**pair.row, "seed": seed}})
        for pair, seed in zip(found.content.pairs, seeds, strict=True)
    ]
    content = found.content.model_copy(update={"pairs": pairs, "split": claimed})
    write_leaderboard([replace(found, content=content)], tmp_path / "board.html", None)
    page = (tmp_path / "board.html").read_text()
    assert f">Plan smoke, 2 pairs{told.format(*sorted(seeds))}</h2>" in page


def test_the_merge_is_the_senders_word(packed: Path, tmp_path: Path) -> None:
    write_leaderboard([read_submission(packed)], tmp_path / "board.html", None)
    (row,) = re.findall(r'<tr class="entry">.*?</tr>', (tmp_path / "board.html").read_text(), re.DOTALL)
    assert 'told the true one<span class="interval">the sender' in row


def test_every_heading_of_the_leaderboard_is_defined_under_the_name_that_it_has_there(
    packed: Path, tmp_path: Path
) -> None:
    write_leaderboard([read_submission(packed)], tmp_path / "board.html", None)
    page = (tmp_path / "board.html").read_text()
    headings = re.findall("<th[^>]*>([^<]+)</th>", page.partition("</thead>")[0])
    defined = [name.partition(":")[0] for name in re.findall("<dt>([^<]+)</dt>", page)]
    assert headings == ["method", "merge", "pairs", *defined] and len(defined) == 6


def test_other_pairs_are_another_table_and_one_name_stands_once(packed: Path, tmp_path: Path) -> None:
    found = read_submission(packed)
    fewer = found.content.model_copy(update={"pairs": found.content.pairs[:1]})
    other = CheckedFile(Path("fewer.zip"), found.sha256, fewer)
    write_leaderboard([found, other], tmp_path / "board.html", None)
    page = (tmp_path / "board.html").read_text()
    assert "Plan smoke, 2 pairs" in page and "Plan smoke, 1 pair<" in page
    with pytest.raises(InputError, match="two results of mine"):
        write_leaderboard([found, found], tmp_path / "board.html", None)
    with pytest.raises(InputError, match=r"ends in \.html"):
        write_leaderboard([found], tmp_path, None)


def test_reference_rows_are_of_the_same_pairs(packed: Path, tmp_path: Path) -> None:
    found = read_submission(packed)
    rows = [{**pair.row, "variant": "ours", "object_f1_50": 0.75} for pair in found.content.pairs]
    other = {**rows[0], "variant": "elsewhere", "seed": 4}
    (tmp_path / "report").mkdir()
    own = [pair.row for pair in found.content.pairs]  # as in the run in which the method was evaluated
    pd.DataFrame([*rows, other, *own]).to_csv(tmp_path / "report" / "results.csv", index=False)
    write_leaderboard([found], tmp_path / "board.html", tmp_path / "report")
    page = (tmp_path / "board.html").read_text()
    assert page.count('class="reference"') == 1 and "ours" in page and "elsewhere" not in page
    assert page.index('class="reference"') < page.index('class="entry"')  # the best F1 stands first
    for pair in rows:  # false objects lower F1 and leave IoU as it is
        pair |= {"object_f1_50": -0.1, "object_iou_point": 1.0}
    pd.DataFrame(rows).to_csv(tmp_path / "report" / "results.csv", index=False)
    write_leaderboard([found], tmp_path / "board.html", tmp_path / "report")
    page = (tmp_path / "board.html").read_text()
    assert page.index('class="reference"') > page.index('class="entry"')


def with_rows(found: CheckedFile, name: str, *rows: dict[str, Any]) -> CheckedFile:
    """Return a submission under another name with other figures."""
    other = renamed(found, name).content
    pairs = [pair.model_copy(update={"row": {**pair.row, **row}}) for pair, row in zip(other.pairs, rows, strict=True)]
    return replace(found, content=other.model_copy(update={"pairs": pairs}))


def test_a_place_is_earned_by_silence_where_nothing_changed(packed: Path, tmp_path: Path) -> None:
    # both find the box; one calls something a change on every pair, with regions, with objects, or by no answer
    changed = {"object_f1_50": 0.8, "is_unchanged_pair": False, "is_alarm": None, "n_objects": 1, "status": "ok"}
    better, unchanged = {**changed, "object_f1_50": 0.9}, {"object_f1_50": NAN, "is_unchanged_pair": True}
    loud = (
        {**unchanged, "is_alarm": True, "n_objects": 0},
        {**unchanged, "is_alarm": False, "n_objects": 1},
        {**unchanged, "is_alarm": None, "n_objects": None, "status": "failed"},
    )
    found = read_submission(packed)
    for each in loud:
        silent = with_rows(found, "silent", changed, {**unchanged, "is_alarm": False, "n_objects": 0})
        write_leaderboard([with_rows(found, "loud", better, each), silent], tmp_path / "board.html", None)
        page = (tmp_path / "board.html").read_text()
        rows = re.findall(r'<tr class="entry">(.*?)</tr>', page, re.DOTALL)
        cells = [re.findall(r"<td>([^<]*)", row) for row in rows]
        place = re.findall("<th[^>]*>([^<]+)</th>", page).index("F1 at 0.5")
        assert [(row[0], row[place]) for row in cells] == [("silent", "0.90"), ("loud", "0.45")]


def test_reference_rows_earn_their_place_by_silence_too(packed: Path, tmp_path: Path) -> None:
    found = read_submission(packed)
    rows = [{**pair.row, "variant": "ours", "n_objects": 0, "is_unchanged_pair": index == 1, "is_alarm": False,
             "object_f1_50": 0.5 if index == 0 else NAN} for index, pair in enumerate(found.content.pairs)]  # fmt: skip
    rows[0]["is_alarm"] = NAN
    (tmp_path / "report").mkdir()
    pd.DataFrame(rows).to_csv(tmp_path / "report" / "results.csv", index=False)
    write_leaderboard([found], tmp_path / "board.html", tmp_path / "report")
    (row,) = re.findall(r'<tr class="reference">.*?</tr>', (tmp_path / "board.html").read_text(), re.DOTALL)
    assert "<td>0.75" in row


def test_only_earlier_results_are_replaced_by_results(evaluated: RunFolder, packed: Path, tmp_path: Path) -> None:
    before = packed.read_bytes()
    assert pack_submission(evaluated, "mine", packed) == 2 and packed.read_bytes() == before
    for name, content in (("other.zip", b"PK\x03\x04 of somebody else"), ("empty.zip", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="exists, and is no file of `tunnelcd submit`"):
            pack_submission(evaluated, "mine", tmp_path / name)
        assert (tmp_path / name).read_bytes() == content
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.zip", "mine.zip", "other.zip"]


def test_only_an_earlier_page_is_replaced_by_a_page(packed: Path, tmp_path: Path) -> None:
    found, page = read_submission(packed), tmp_path / "board.html"
    for _ in range(2):
        write_leaderboard([found], page, None)
    (tmp_path / "mine.html").write_text("<title>my notes</title>")
    with pytest.raises(InputError, match="exists, and is no page of `tunnelcd leaderboard`"):
        write_leaderboard([found], tmp_path / "mine.html", None)
    assert (tmp_path / "mine.html").read_text() == "<title>my notes</title>"


@pytest.mark.parametrize("place", ["file/x", "circle/x", "a" * 300, "dir/" + "a" * 300, "/proc/x"])
def test_places_that_cannot_be_written_are_one_line(
    evaluated: RunFolder, packed: Path, tmp_path: Path, command: Callable[..., tuple[int, str, str]], place: str
) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "circle").symlink_to("circle")
    before = sorted(tmp_path.iterdir())
    for argv, suffix in ((("submit", evaluated.path), ".zip"), (("leaderboard", packed), ".html")):
        code, out, err = command(*argv, "--out", tmp_path / f"{place}{suffix}", "--quiet")
        assert (code, out) == (2, "") and err.startswith("error: ") and err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("key", "value"), [("seconds", 1e300), ("pair_digest", "x" * 1000)])
def test_calls_that_cannot_be_are_one_line(run: RunFolder, tmp_path: Path, key: str, value: object) -> None:
    (call,) = run.path.glob("evaluations/mine/smoke__unchanged/20000.json")
    call.write_text(json.dumps({**json.loads(call.read_text()), key: value}))
    with pytest.raises(InputError, match="smoke/unchanged 20000") as caught:
        pack_submission(run, "mine", tmp_path / "x.zip")
    assert "\n" not in str(caught.value) and not (tmp_path / "x.zip").exists()


def test_an_evaluation_that_cannot_be_is_one_line(run: RunFolder, tmp_path: Path) -> None:
    path = run.path / "evaluations" / "mine" / "evaluation.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "split": "x" * 1000}))
    with pytest.raises(InputError, match="split") as caught:
        pack_submission(run, "mine", tmp_path / "x.zip")
    assert "\n" not in str(caught.value) and not (tmp_path / "x.zip").exists()


def test_a_metric_of_the_organiser_is_no_forgery(
    evaluated: RunFolder, packed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scoring, "compute_plugin_columns", lambda *_: {"largest_object": 3.0})
    assert score_again(read_submission(packed), evaluated).n_checked == 2


@pytest.mark.parametrize(
    "name",
    ["tunnelcd", "tunnelcd ", "tunnelcd\u00a0", "tunnel\u200bcd", "\u3000tunnelcd", "\uff54unnelcd", "tunnelcd\ufe0f",
     "tunnelcd [a=1]", "oracle\u00ad-mine", "Tunnelcd\u3164"],
)  # fmt: skip
def test_no_submission_is_called_as_a_method_of_ours(packed: Path, name: str) -> None:
    def rename(document: dict[str, Any]) -> None:
        document["name"] = name
        for pair in document["pairs"]:
            pair["row"]["variant"] = name

    with pytest.raises(InputError, match="a preset or an oracle of tunnelcd is called "):
        read_submission(rewrite(packed, in_manifest(rename)))


def test_no_two_submissions_of_one_table_look_alike(packed: Path, tmp_path: Path) -> None:
    found = read_submission(packed)
    for name in ("mi\u2060ne ", "Mine", "m\ufe0fine"):
        with pytest.raises(InputError, match=r"two results of mine and .*, which look alike, on the same pairs"):
            write_leaderboard([found, renamed(found, name)], tmp_path / "board.html", None)
    with pytest.raises(InputError, match=r"two results of mine on the same pairs"):
        write_leaderboard([found, found], tmp_path / "board.html", None)
    others = [renamed(found, name) for name in ("\u0e01\u0e34 1", "\u0e01\u0e38 1")]
    write_leaderboard([found, *others], tmp_path / "board.html", None)


def test_a_reference_that_was_given_the_merge_is_told(packed: Path, evaluated: RunFolder, tmp_path: Path) -> None:
    other = renamed(read_submission(packed), "theirs")
    write_leaderboard([other], tmp_path / "b.html", evaluated.path)
    assert (tmp_path / "b.html").read_text().count("told the true one") == 2


def test_a_kind_of_pair_is_of_the_plan_and_not_of_the_row(packed: Path) -> None:
    claimed = read_submission(rewrite(packed, in_row(pair_kind="disjoint")))
    assert claimed.content.pairs[0].row["pair_kind"] == "disjoint"
    assert set(take_rows(claimed)["pair_kind"]) == {""}
