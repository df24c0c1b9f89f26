"""The table of regions and its targets, worked out by hand."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from cdpipe.model.config import load_config
from cdpipe.model.types import DescriptorSet, MappedSession, PointMap
from eval.core.statistics import wilson_interval
from eval.plans.targets import Target, Targets
from eval.running.stages.pair_stages import kept_bytes
from eval.tables.regions.table import FILES, region_overview, region_tables

NAN = float("nan")
TARGETS = Targets(
    method="tunnelcd",
    regions=(
        Target(column="region_auroc", name="AUROC", domain="in", at_least=0.9),
        Target(column="region_recall_at_k", name="recall", domain="out", at_least=0.5),
        Target(column="recall_at_0.1", name="less c2c", less="c2c", domain="in", at_least=0),
        Target(column="recall_at_0.1_proposed", name="proposals less c2c", less="c2c", domain="in", at_least=0),
        Target(column="region_auroc", name="AUROC less c2c", less="c2c", domain="in", at_least=0),
        Target(column="silent_share", name="silent", at_least=0.95, least_km=5),
        Target(column="false_regions_per_100m_unchanged", name="false", at_most=0.1, least_km=5),
        Target(column="bytes_ratio", name="bytes", site="site1", at_least=10),
        Target(column="bytes_ratio", name="bytes", site="site2", at_least=35),
        Target(column="t_cd_per_region_s", name="t_cd", site="site1", method="paper", at_most=0.016),
        Target(column="t_cd_per_region_s", name="t_cd", site="site2", method="paper", at_most=0.109),
    ),
)
PER_PAIR = {
    "region_auroc": NAN, "region_recall_at_k": NAN, "region_recall": NAN, "region_precision": NAN, "n_false_regions": 0,
    "n_found_changes": 0, "bytes_map_before": 1000.0, "bytes_regions_before": 100.0, "after_path_m": 1000.0,
    "region_recall_at_k_proposed": NAN, "region_recall_proposed": NAN,
    "t_descriptor_per_keyframe_s": 0.01, "t_cd_per_region_s": NAN, "is_unchanged_pair": False, "is_alarm": NAN,
    "score_radius_m": 4.5, "n_observable": 0, "status": "ok",
}  # fmt: skip


def case(family: str, seed: int, variant: str = "tunnelcd", **columns: object) -> dict[str, object]:
    return {"scenario": family, "family": family, "seed": seed, "variant": variant, **PER_PAIR, **columns}


def changed(family: str, seed: int, variant: str = "tunnelcd", **columns: object) -> dict[str, object]:
    return case(
        family, seed, variant, **{"n_observable": 1, "region_recall": 0.0, "region_recall_at_k": 0.0, **columns}
    )


def unchanged(family: str, seed: int, *, alarm: float = 0.0, **columns: object) -> dict[str, object]:
    return case(family, seed, **{"is_unchanged_pair": True, "is_alarm": alarm, **columns})


def tables(
    rows: list[dict[str, object]], *, is_whole: bool = True, **items: list[dict[str, object]]
) -> dict[str, pd.DataFrame]:
    """Every changed pair has one change, found by the only candidate of `tunnelcd` and by none of another method."""
    truth = [row for row in rows if row["n_observable"]]
    identity = [{name: row[name] for name in ("scenario", "seed", "variant")} for row in truth]
    change = {"id": 1, "is_observable": True, "n_truth_cells": 20, "is_found": True, "hull_volume_m3": 0.2}
    found = [
        {**names, "score": 1.0, "found_changes": "1", "is_withdrawn": False}
        for names, row in zip(identity, truth, strict=True)
        if row["status"] == "ok" and row["variant"] == "tunnelcd"
    ]
    every = {
        "changes": [{**names, **change} for names in identity], "regions": found, "keyframes": [], **items,
    }  # fmt: skip
    return region_tables(
        pd.DataFrame(rows), {name: pd.DataFrame(each) for name, each in every.items()}, TARGETS, is_whole=is_whole
    )


def the_row(table: pd.DataFrame, domain: str, variant: str = "tunnelcd") -> dict[str, object]:
    found = table[(table["domain"] == domain) & (table["variant"] == variant)]
    assert len(found) == 1
    return found.iloc[0].to_dict()


def the_target(targets: pd.DataFrame, name: str, domain: str) -> dict[str, object]:
    found = targets[(targets["target"] == name) & (targets["domain"] == domain)]
    assert len(found) == 1
    return found.iloc[0].to_dict()


def test_a_row_by_hand() -> None:
    rows = [
        changed("regions/narrow", 1, region_auroc=0.9, region_recall=1.0, region_recall_at_k=1.0, n_false_regions=2),
        changed("regions/narrow", 2, region_auroc=0.7, region_recall=1.0, region_recall_at_k=0.0, after_path_m=500.0),
        changed("regions/narrow", 3, status="merge_refused", bytes_regions_before=NAN),
        unchanged("regions/narrow", 4),
        unchanged("regions/narrow", 5, alarm=1.0, n_false_regions=3),
        unchanged("regions/narrow", 6, alarm=NAN, status="merge_refused"),
    ]
    row = the_row(tables(rows)["regions_table"], "in")
    assert (row["n_pairs"], row["n_refused"], row["n_failed"], row["n_auroc"], row["n_changed"]) == (6, 2, 2, 2, 3)
    assert row["region_auroc"] == pytest.approx(0.8)
    assert row["region_recall"] == pytest.approx(2 / 3)  # the refused pair is a 0
    assert row["region_recall_at_k"] == pytest.approx(1 / 3)
    # five false regions on 3.5 km of answered pairs, three of them on the 2 km where nothing changed
    assert row["false_regions_per_100m"] == pytest.approx(100 * 5 / 3500)
    assert row["false_regions_per_100m_unchanged"] == pytest.approx(100 * 3 / 2000)
    assert (row["km"], row["km_unchanged"]) == (3.5, 2.0)
    # one of three silent: a refusal is neither silent nor an alarm, but it is a pair
    assert (row["n_silent"], row["n_unchanged"], row["silent_share"]) == (1, 3, pytest.approx(1 / 3))
    assert (row["silent_low"], row["silent_high"]) == wilson_interval(1, 3)
    # objects without regions break the silence, too
    loud = the_row(tables([{**each, "n_objects": 1} for each in rows])["regions_table"], "in")
    assert (loud["n_silent"], loud["n_unchanged"], loud["km_unchanged"]) == (0, 3, 2.0)
    assert (loud["silent_low"], loud["silent_high"]) == wilson_interval(0, 3)
    assert (row["bytes_map_before"], row["bytes_regions_before"], row["bytes_ratio"]) == (1000.0, 100.0, 10.0)
    # two refusals of six pairs of 1 km each count as 10 false regions at 0.1 per 100 m, and as 50 at 0.5
    assert (row["recall_at_0.1"], row["recall_at_0.5"]) == (0.0, 0.0)
    answered = the_row(tables([each for each in rows if each["status"] == "ok"])["regions_table"], "in")
    assert answered["recall_at_0.1"] == 1.0
    assert row["t_descriptor_per_keyframe_s"] == 0.01
    # nobody keeps less than a byte
    fraction = the_row(tables([changed("regions/narrow", 1, bytes_regions_before=5e-324)])["regions_table"], "in")
    assert np.isnan(fraction["bytes_ratio"])


def test_bytes_that_some_answers_lack_have_no_mean() -> None:
    rows = [changed("regions/narrow", seed, bytes_regions_before=n) for seed, n in ((1, 10.0), (2, NAN))]
    row = the_row(tables(rows)["regions_table"], "in")
    assert row["bytes_map_before"] == 1000.0
    assert np.isnan([row["bytes_regions_before"], row["bytes_ratio"]]).all()


def test_domains_are_apart_and_all_is_both() -> None:
    rows = [
        changed("regions/wide", 1, region_auroc=1.0),
        changed("cave", 1, region_auroc=0.5),
        changed("paper/site1", 1),
    ]
    found = tables(rows)
    assert found["regions_table"][["domain", "n_pairs"]].to_numpy().tolist() == [["in", 1], ["out", 2], ["all", 3]]
    assert the_row(found["regions_table"], "all")["region_auroc"] == 0.75
    assert set(found) == set(FILES)
    # a single domain is not told twice
    assert tables(rows[:1])["regions_table"]["domain"].tolist() == ["in"]
    assert region_overview(found["regions_table"])["n"].tolist() == [1, 2, 3]


def test_pooled_auroc_and_curves_are_of_labelled_keyframes_alone() -> None:
    keyframes = [
        {"scenario": "narrow", "seed": seed, "variant": "tunnelcd", "score": score, "label": label}
        for seed, score, label in [(1, 3.0, 1), (1, 2.0, 0), (2, 2.0, 1), (2, 1.0, 0), (2, 99.0, -1)]
    ]
    found = tables([changed("narrow", 1), changed("narrow", 2)], keyframes=keyframes)
    assert the_row(found["regions_table"], "in")["region_auroc_pooled"] == 0.875
    roc = found["roc"][["false_positive_rate", "true_positive_rate"]].to_numpy()
    assert roc.tolist() == [[0, 0], [0, 0.5], [0.5, 1], [1, 1]]


@pytest.mark.parametrize(("auroc", "is_met"), [(0.9, True), (0.899, False)])
def test_a_bound_is_met_from_its_value_on_and_not_judged_before_all_is_run(auroc: float, is_met: bool) -> None:
    rows = [changed("narrow", seed, region_auroc=auroc) for seed in range(3)]
    found = the_target(tables(rows)["regions_targets"], "AUROC", "in")
    assert (found["is_met"], found["value"], found["asked"]) == (is_met, pytest.approx(auroc), "at least 0.9")
    assert set(tables(rows, is_whole=False)["regions_targets"]["is_met"]) == {None}


def test_a_target_of_one_domain_is_not_asked_of_the_other() -> None:
    found = tables([changed("cave", seed, region_auroc=0.1, region_recall_at_k=0.4) for seed in range(3)])
    targets = found["regions_targets"]
    assert the_target(targets, "recall", "out")["is_met"] is False
    assert "AUROC" not in set(targets["target"])


def test_a_rival_that_finds_more_makes_the_target_missed() -> None:
    ours = [changed("narrow", seed) for seed in range(4)]
    theirs = [{**row, "variant": "c2c"} for row in ours]
    found = tables([*ours, *theirs])["regions_targets"]
    target = the_target(found, "less c2c", "in")
    assert (target["value"], target["low"], target["high"], target["is_met"]) == (1.0, 1.0, 1.0, True)
    swapped = [
        {**row, "variant": {"tunnelcd": "c2c", "c2c": "tunnelcd"}[str(row["variant"])]} for row in [*ours, *theirs]
    ]
    regions = [
        {"scenario": "narrow", "seed": s, "variant": "c2c", "score": 1.0, "found_changes": "1", "is_withdrawn": False}
        for s in range(4)
    ]
    target = the_target(tables(swapped, regions=regions)["regions_targets"], str(target["target"]), "in")
    assert (target["value"], target["is_met"]) == (-1.0, False)


@pytest.mark.parametrize(("theirs", "is_met"), [(0.9, True), (1.0, False)])
def test_a_mean_is_held_against_that_of_a_rival(theirs: float, is_met: bool) -> None:
    rows = [changed("narrow", seed, region_auroc=auroc) for seed, auroc in enumerate((0.9, 1.0))]
    rows += [{**row, "variant": "c2c", "region_auroc": theirs} for row in rows]
    rows += [changed("cave", seed, name, region_auroc=0.5) for seed in range(2) for name in ("tunnelcd", "c2c")]
    target = the_target(tables(rows)["regions_targets"], "AUROC less c2c", "in")
    assert target["value"] == pytest.approx(0.95 - theirs)
    assert target["is_met"] is is_met


def test_proposals_are_held_against_a_rival_before_any_is_withdrawn() -> None:
    ours = [changed("narrow", seed) for seed in range(4)]
    theirs = [{**row, "variant": "c2c"} for row in ours]
    ranks = [
        ("tunnelcd", 3.0, "", True),
        ("tunnelcd", 2.0, "", True),
        ("tunnelcd", 1.0, "1", False),
        ("c2c", 1.0, "1", False),
    ]
    regions = [
        {"scenario": "narrow", "seed": s, "variant": name, "score": score, "found_changes": found, "is_withdrawn": gone}
        for s in range(4)
        for name, score, found, gone in ranks
    ]
    found = tables([*ours, *theirs], regions=regions)["regions_targets"]
    # two false candidates rank first, and were withdrawn
    assert the_target(found, "less c2c", "in")["value"] == 0.0
    target = the_target(found, "proposals less c2c", "in")
    assert (target["value"], target["is_met"], target["n"]) == (-1.0, False, 4)


def test_silence_is_judged_over_five_kilometres_and_more() -> None:
    name = "silent"
    four_km = [unchanged("null/narrow", seed) for seed in range(4)]
    assert the_target(tables(four_km)["regions_targets"], name, "in")["is_met"] is None
    twenty = [unchanged("null/narrow", seed) for seed in range(20)]
    assert the_target(tables(twenty)["regions_targets"], name, "in")["is_met"] is True
    one_loud = [*twenty[1:], unchanged("null/cave", 0, alarm=1.0, n_false_regions=21)]
    found = tables(one_loud)["regions_targets"]
    assert the_target(found, name, "all")["is_met"] is True  # 19 of 20
    rate = the_target(found, "false", "all")
    assert (rate["value"], rate["is_met"]) == (pytest.approx(0.105), False)
    refused = [*twenty[2:], *(unchanged("null/narrow", s, alarm=NAN, status="merge_refused") for s in (30, 31))]
    assert the_target(tables(refused)["regions_targets"], name, "in")["is_met"] is False


def test_bytes_and_the_papers_seconds_are_judged_on_the_papers_sites() -> None:
    rows = [
        changed("regions/site1", 1, bytes_map_before=1100.0),
        changed("regions/site2", 1, bytes_map_before=3400.0),
        changed("regions/site1", 1, "paper", t_cd_per_region_s=0.016),
        changed("regions/site2", 1, "paper", t_cd_per_region_s=0.110),
    ]
    found = tables(rows)["regions_targets"]
    verdicts = {
        (name, site): the_target(found, name, site)["is_met"]
        for name in ("bytes", "t_cd")
        for site in ("site1", "site2")
    }
    assert list(verdicts.values()) == [True, False, True, False]


def mapped(n_points: int, n_keyframes: int, has_spheres: bool) -> MappedSession:
    scans = np.arange(n_keyframes)
    points = np.zeros((n_points, 3))
    empty = np.zeros(0, dtype=np.int32)
    pointmap = PointMap(points, np.zeros(n_points, np.float32), 0.2, np.tile(np.eye(4), (n_keyframes, 1, 1)), scans,
                        empty, empty, np.zeros(n_keyframes + 1, np.int64))  # fmt: skip
    spheres = np.zeros((n_keyframes, 64), np.float32) if has_spheres else None
    q = np.zeros((n_keyframes, 32), np.float32)
    return MappedSession(pointmap, DescriptorSet(q, None, scans, "test", "", spheres))


FIXED = "query.radius_m=4.5"


@pytest.mark.parametrize(
    ("settings", "per_keyframe", "per_point"),
    [
        (["regions.source=scan", FIXED], 4 * 32 + 28, 0),
        (["regions.source=sphere", FIXED], 4 * 64 + 28, 0),
        (["regions.source=sphere"], 4 * 64 + 28 + 4, 0),  # and the width of the drift
        (["regions.source=sphere-difference"], 0, 12),
        (["regions.source=voxel-diff"], 0, 12),
        (["regions.source=c2c"], 0, 12),
        (["regions.source=random-regions", FIXED], 28, 0),
        (["regions.source=every-keyframe"], 28 + 4, 0),
    ],
)
def test_bytes_kept_by_hand(settings: list[str], per_keyframe: int, per_point: int) -> None:
    found = kept_bytes(mapped(1000, 10, has_spheres=True), load_config("tunnelcd", settings))
    assert found == {"bytes_map_before": 12000.0, "bytes_regions_before": 10.0 * per_keyframe + 1000.0 * per_point}


def test_a_survey_keeps_its_map_where_the_robot_asks() -> None:
    survey = mapped(1000, 10, has_spheres=True)
    found = kept_bytes(survey, load_config("tunnelcd", ["regions.source=sphere"]), is_asked_after=True)
    assert found["bytes_regions_before"] == 12000.0


PLAN = {
    "name": "tiny", "scenarios": ["smoke/one_box"], "seeds": [10300], "report": "regions",
    "variants": [{"preset": "voxel-diff"}, {"preset": "random-regions"}],
}  # fmt: skip


def test_the_run_prints_and_writes_the_tables_only_where_the_plan_asks(
    tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    out = tmp_path / "out"
    (tmp_path / "with.yaml").write_text(yaml.safe_dump(PLAN))
    code, told, _ = command("run", tmp_path / "with.yaml", "--out", out)
    assert code == 0
    assert "recall@0.1" in told
    assert all((out / f"{name}.csv").is_file() for name in ("regions_table", "regions_by_size", "roc", "froc"))
    assert pd.read_csv(out / "regions_table.csv")["variant"].tolist() == ["voxel-diff", "random-regions"]
    assert pd.read_csv(out / "changes.csv")["range_m"].between(0.5, 10.0).all()
    kept = pd.read_csv(out / "results.csv").set_index("variant")["bytes_regions_before"]
    assert kept["voxel-diff"] > 10 * kept["random-regions"] > 0
    code, _, _ = command("report", out)
    assert 'id="regions"' in (out / "index.html").read_text()
    (tmp_path / "without.yaml").write_text(yaml.safe_dump({**PLAN, "report": None}))
    code, told, _ = command("run", tmp_path / "without.yaml", "--out", out)
    assert "recall@0.1" not in told
    assert not any((out / f"{name}.csv").exists() for name in FILES)
    command("report", out)
    assert 'id="regions"' not in (out / "index.html").read_text()


def test_who_proposes_nothing_has_no_recall_at_k() -> None:
    rows = [changed("regions/narrow", seed, "c2c") for seed in (1, 2)]
    by_size = tables(rows)["regions_by_size"]
    assert len(by_size) and (by_size["recall_at_k"] == 0).all()
