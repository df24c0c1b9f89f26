import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError, ScenarioError
from cdpipe.io.answer import read_answer
from eval.running.rescoring import rescore
from eval.running.runfolder import RunFolder
from scenarios.schema import Scenario
from tests.eval.running.runs import MAPLESS, ONE_BOX, UNCHANGED, Runner, Told, plan_of, table

MERGES = ", ".join(
    (
        "{preset: tunnelcd}",
        '{preset: tunnelcd, set: ["merge.min_hessian_ratio=1"]}',
        MAPLESS,
        "{preset: tunnelcd, oracle_merge: {}}",
        "{preset: tunnelcd, oracle_merge: {noise_m: 0.3, noise_deg: 1}}",
    )
)
UNMAPPED = "tunnelcd[map.max_range_m=0.1]"
REFUSED = "tunnelcd[merge.min_hessian_ratio=1]"
NOISY = "oracle-merge[noise_m=0.3,noise_deg=1]"
ONE_CLEAN = f"{{name: {ONE_BOX}, pair_kind: clean}}"


@pytest.fixture(scope="module")
def merges(pairs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A plan that ends at the merge; one of its variants cannot map the sessions."""
    folder, told = tmp_path_factory.mktemp("merges"), Told()
    plan = plan_of(folder, scenarios=f"{ONE_CLEAN}, {UNCHANGED}", variants=MERGES, rest="until: merge")
    run, _ = Runner(pairs).run(folder / "run", plan, progress=told)
    assert "merge" in told.stages and "query" not in told.stages
    return run


@pytest.fixture
def merges_copy(merges: RunFolder, tmp_path: Path) -> RunFolder:
    shutil.copytree(merges.path, tmp_path / "run")
    return RunFolder(tmp_path / "run")


def test_a_plan_that_ends_at_the_merge_has_every_case_and_no_more_than_the_merge(merges: RunFolder) -> None:
    results = table(merges).set_index(["scenario", "variant"])
    assert results["status"].tolist() == ["ok", "merge_refused", "failed", "ok", "ok"] * 2
    assert "map.max_range_m = 0.1" in results.loc[(ONE_BOX, UNMAPPED), "error"]
    later = [name for name in results.columns if name.startswith(("region_", "object_", "t_cd", "t_oe", "t_total"))]
    assert len(later) > 15
    assert results[[*later, "n_regions", "n_objects", "is_alarm"]].isna().all(axis=None)
    assert results["overlap_true"].notna().all()
    merged = results[results["status"] == "ok"]
    assert merged[["merge_error_m", "t_index_s", "t_merge_s", "t_refine_s", "t_descriptor_s"]].notna().all(axis=None)
    assert (merged["merge_error_m"].loc[:, ["tunnelcd", "oracle-merge"]] < 0.1).all()
    refused = results.loc[(ONE_BOX, REFUSED)]
    assert np.isfinite(refused["evidence_hessian_ratio"])
    for name in ("changes", "regions", "objects", "keyframes"):
        assert len(table(merges, name)) == 0
    assert merges.provenance()["plan"]["until"] == "merge"
    assert read_answer(merges.answer(ONE_BOX, 20000, "tunnelcd")).until == "merge"
    assert read_answer(merges.answer(ONE_BOX, 20000, UNMAPPED)).until == "merge"


def test_only_a_merge_that_asks_the_descriptors_is_charged_for_them(merges: RunFolder) -> None:
    seconds = table(merges).set_index(["scenario", "variant"])["t_descriptor_s"]
    assert seconds[ONE_BOX, "tunnelcd"] > 0
    assert seconds[ONE_BOX, "oracle-merge"] == 0


def test_the_kind_of_a_pair_is_a_column(merges: RunFolder) -> None:
    results = table(merges)
    assert list(results.columns)[:4] == ["scenario", "family", "pair_kind", "seed"]
    kinds = results.fillna({"pair_kind": ""}).groupby("scenario")["pair_kind"].unique().map(list).to_dict()
    assert kinds == {ONE_BOX: ["clean"], UNCHANGED: [""]}
    assert "pair_kind" not in set(table(merges, "summary")["metric"])


def test_scoring_again_keeps_the_kind_and_the_end(merges_copy: RunFolder) -> None:
    before = table(merges_copy)
    shutil.copytree(merges_copy.answer(ONE_BOX, 20000, "tunnelcd"), merges_copy.answer(ONE_BOX, 20000, "theirs"))
    foreign = merges_copy.answer(ONE_BOX, 20000, "theirs") / "answer.json"
    with pytest.raises(InputError, match=r"theirs/answer\.json: until = 'merge': a plan alone"):
        rescore(merges_copy)
    foreign.write_text(foreign.read_text().replace('"until": "merge"', '"until": null'))
    rescore(merges_copy)
    after = table(merges_copy)
    theirs = after[after["variant"] == "theirs"]
    assert (theirs["pair_kind"].tolist(), theirs["scenario"].tolist()) == (["clean"], [ONE_BOX])
    pd.testing.assert_frame_equal(after[after["variant"] != "theirs"], before)


def test_an_error_of_an_oracle_is_its_noise(merges: RunFolder) -> None:
    results = table(merges).set_index(["scenario", "variant"])
    for scenario in (ONE_BOX, UNCHANGED):
        exact, noisy = results.loc[(scenario, "oracle-merge")], results.loc[(scenario, NOISY)]
        # the odometry of these pairs drifts, and between keyframes the alignment is blended
        assert exact["merge_error_m"] < 0.002
        assert noisy["merge_error_m"] == pytest.approx(0.3, abs=0.01)
        assert noisy["merge_error_deg"] == pytest.approx(1.0, abs=0.02)
        assert noisy[["t_index_s", "t_merge_s", "t_refine_s", "evidence_n_hypotheses"]].tolist() == [0, 0, 0, 0]


def test_the_page_of_a_run_that_ends_at_the_merge(
    merges_copy: RunFolder, command: Callable[..., tuple[int, str, str]]
) -> None:
    code, _, err = command("report", merges_copy.path)
    assert (code, err) == (0, "")
    page = (merges_copy.path / "index.html").read_text()
    for words in ("merge refused", "map.max_range_m = 0.1", "oracle-merge"):
        assert words in page


def test_what_is_printed_of_a_run_that_ends_at_the_merge(
    merges_copy: RunFolder, command: Callable[..., tuple[int, str, str]]
) -> None:
    code, out, _ = command("score", merges_copy.path)
    assert code == 0
    assert "merge [m]" in out and "recall" not in out
    lines = out.splitlines()
    assert len(lines) <= 25 and "summary.csv" in out
    assert max(len(line) for line in lines if str(merges_copy.path) not in line) <= 80
    code, out, _ = command("score", merges_copy.path, "--wide")
    assert code == 0 and "merge_error_m" in out and "region_recall" not in out


def test_a_world_that_cannot_be_made_keeps_its_kind(tmp_path: Path, runner: Runner) -> None:
    def fails(*_: object) -> Scenario:
        raise ScenarioError("props stand in each other")

    plan = plan_of(tmp_path, scenarios=ONE_CLEAN, variants=MERGES, rest="until: merge")
    run, _ = runner.run(tmp_path / "run", plan, tools=replace(runner.tools, draw=fails))
    results = table(run)
    assert results["status"].tolist() == ["failed"] * 5
    assert set(results["pair_kind"]) == {"clean"}
