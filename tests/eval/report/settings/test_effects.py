"""What the page shows of worlds that repeat another one with something set otherwise."""

import html
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from eval.core.figures import picture
from eval.report.page import write_page
from eval.report.settings.effects import draw_effects, effect_chart, shorten
from eval.running.results.cases import first_seed, named_variants, scenarios
from eval.running.results.run_data import read_run

NAN = float("nan")
PLAIN, NOISE, BOTH = (
    "n[p.s=1]",
    "n[p.s=1][sensor.range_noise=false]",
    "n[p.s=1][sensor.range_noise=false,sensor.sub_rays=7]",
)
OTHER = "smoke/unchanged"
SEEDS = range(6)


def rows_of(world: str, variant: str, recalls: list[float], *, unchanged: bool = False) -> list[dict[str, object]]:
    return [
        {
            "scenario": world,
            "seed": seed,
            "variant": variant,
            "status": "ok",
            "region_recall": recall,
            "region_recall_at_k": recall,
            "object_iou_point": recall / 2,
            "merge_error_m": 0.01,
            "n_observable": 0 if unchanged else 3,
            "is_unchanged_pair": unchanged,
            "is_alarm": False,
        }
        for seed, recall in zip(SEEDS, recalls, strict=True)
    ]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Seven worlds' rows: six seeds, two variants on three worlds, one variant on an unchanged pair."""
    plain = [0.2, 0.4, 0.5, 0.2, 0.4, 0.5]
    rows = [
        *rows_of(PLAIN, "ours", plain),
        *rows_of(PLAIN, "theirs", plain),
        # every pair gains 0.25; three gain and three lose
        *rows_of(NOISE, "ours", [value + 0.25 for value in plain]),
        *rows_of(NOISE, "theirs", [value + 0.1 * (-1) ** seed for seed, value in enumerate(plain)]),
        *rows_of(BOTH, "ours", [value - 0.125 for value in plain]),
        *rows_of(OTHER, "ours", [NAN] * 6, unchanged=True),
        *rows_of(f"{OTHER}[frozen=true]", "ours", [NAN] * 6, unchanged=True),
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv", index=False)
    return tmp_path


def test_table_by_hand(run: Path) -> None:
    first, second = draw_effects(read_run(run))
    assert (first.reference, second.reference) == (PLAIN, OTHER)
    assert first.table.headings[:4] == ("setting", "pairs", "observable changes", "region recall")
    lines = {(group, cells[0].text): cells for group, cells in first.table.rows}
    assert [cell.text for cell in lines["ours", "as it is: mean"]] == [
        "as it is: mean",
        "6",
        "3",
        "0.37",
        "0.37",
        "0.18",
        "0.010",
    ]
    noise = lines["ours", "range_noise=false"]
    assert [cell.text for cell in noise[1:]] == ["6", "0", "+0.25", "+0.25", "+0.12", "0.000"]
    assert noise[3].interval == "+0.25 to +0.25"
    assert [cell.is_best for cell in noise] == [False, False, False, True, True, True, False]
    assert lines["ours", "range_noise=false, sub_rays=7"][3].text == "\u22120.12"
    undecided = lines["theirs", "range_noise=false"][3]
    assert (undecided.text, undecided.is_best) == ("0.00", False)
    # a variant that was not run there has no number, and no world is left out
    assert [cell.text for cell in lines["theirs", "range_noise=false, sub_rays=7"]][1:] == ["0", *["\u2013"] * 5]
    # nothing to recall where nothing changed
    assert second.table.headings == ("setting", "pairs", "observable changes", "merge error [m]")
    assert second.chart is None
    assert "its sensor" in first.table.caption


def test_a_mean_over_fewer_pairs_than_its_row_says_so(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    is_refused = results["scenario"].eq(NOISE) & results["seed"].gt(0)
    results.loc[is_refused, "merge_error_m"] = NAN
    results.to_csv(run / "results.csv", index=False)
    first, _ = draw_effects(read_run(run))
    (noise,) = (cells for group, cells in first.table.rows if (group, cells[0].text) == ("ours", "range_noise=false"))
    assert (noise[1].text, noise[-1].interval) == ("6", "1 of 6 pairs")
    assert noise[3].interval == "+0.25 to +0.25"


def test_five_pairs_that_agree_are_not_set_in_bold(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    results[results["seed"] < 5].to_csv(run / "results.csv", index=False)
    first, _ = draw_effects(read_run(run))
    assert not any(cell.is_best for _, cells in first.table.rows for cell in cells)
    assert "+0.25" in {cell.text for _, cells in first.table.rows for cell in cells}


def test_repeated_worlds_stand_under_their_own_heading_and_nowhere_else(run: Path) -> None:
    assert scenarios(read_run(run), unchanged=False) == [PLAIN]
    assert scenarios(read_run(run), unchanged=True) == [OTHER]
    page = html.unescape(write_page(run).read_text())
    groups = re.findall(r'<th class="group"[^>]*>(.*?)</th>', page.partition('id="paper"')[0])
    # the summary, then the results, then the effects
    assert groups[-5:] == [PLAIN, OTHER, "ours", "theirs", "ours"]
    assert not any(NOISE in group for group in groups)
    assert re.findall(r'id="site-\d+">\s*<summary><h2>(.*?)</h2>', page) == [PLAIN]
    assert '<details class="section" id="effects">' in page
    assert NOISE not in (run / "results.tex").read_text()


def test_a_page_without_such_worlds_has_no_such_heading(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    results[results["scenario"].isin([NOISE, OTHER])].to_csv(run / "results.csv", index=False)
    assert draw_effects(read_run(run)) == []
    # a world with settings is shown like any other where the one without them was not run
    assert scenarios(read_run(run), unchanged=False) == [NOISE]
    page = write_page(run).read_text()
    assert "effects" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)


def test_a_plain_scenario_of_other_seeds_in_the_same_folder_hides_nothing(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    plain = results[(results["scenario"] == PLAIN) & (results["seed"] == 0)].assign(scenario="n", seed=10000)
    only_here = plain.head(1).assign(scenario=NOISE, seed=2, variant="foreign")
    before = [(part.reference, part.table) for part in draw_effects(read_run(run))]
    pd.concat([results, plain, only_here]).to_csv(run / "results.csv", index=False)
    data = read_run(run)
    assert [(part.reference, part.table) for part in draw_effects(data)] == before
    # what no effect shows stands in the main tables
    assert scenarios(data, unchanged=False) == [PLAIN, "n", NOISE]
    assert named_variants(data, NOISE) == ["foreign"]
    assert first_seed(data, NOISE) == 2
    # at the same seeds it is one more thing to be held against, and the others stay with their own
    pd.concat([results, plain.assign(seed=0)]).to_csv(run / "results.csv", index=False)
    assert [part.reference for part in draw_effects(read_run(run))] == ["n", PLAIN, OTHER]


def test_one_is_not_written_as_many(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    is_one = results["scenario"].isin([PLAIN, NOISE]) & (results["seed"] == 0)
    results[is_one].to_csv(run / "results.csv", index=False)
    assert "1 session pair," in html.unescape(write_page(run).read_text())


def test_a_label_is_text_and_never_markup(run: Path) -> None:
    results = pd.read_csv(run / "results.csv")
    results["scenario"] = results["scenario"].str.replace("frozen=true", "<b>=&x")
    results.to_csv(run / "results.csv", index=False)
    page = write_page(run).read_text()
    assert "<b>=&x" not in page
    assert "&lt;b&gt;=&amp;x" in page


def test_settings_are_shortened_by_the_group_they_share() -> None:
    assert shorten(["sensor.a=1", "sensor.b=2,sensor.c=3"]) == ("sensor", ["a=1", "b=2, c=3"])
    assert shorten(["sensor.a=1", "platform.b=2"]) == ("", ["sensor.a=1", "platform.b=2"])


def test_a_row_for_each_setting_and_a_mark_with_its_interval_for_each_variant() -> None:
    rows = [("up", "ours", 0.2, 0.1, 0.3), ("down, too", "theirs", -0.2, -0.3, -0.1), ("up", "undefined", *[NAN] * 3)]
    effects = pd.DataFrame(rows, columns=["setting", "variant", "difference", "low", "high"])
    drawing = effect_chart({"recall": effects, "IoU": effects[:1]})
    first, second = drawing.rows[0]
    zero, ours, theirs, _ = first.series
    assert np.ravel(zero.x).tolist() == [0.0, 0.0]
    assert [(each.name, list(each.x), list(each.low), list(each.high)) for each in (ours, theirs)] == [
        ("ours", [0.2], [0.1], [0.3]), ("theirs", [-0.2], [-0.3], [-0.1]),
    ]  # fmt: skip
    assert list((first.y.ticks or {}).values()) == ["up", "down,\ntoo"]
    assert set((second.y.ticks or {}).values()) == {""}
    # from top to bottom
    assert ours.y[0] < theirs.y[0] < first.y.span[0]
    assert first.y.span[1] == 0.0
    assert picture(drawing).axes[0].get_ylim() == first.y.span


def test_a_family_with_movers_shows_false_regions_on_them_beside_its_clean_twin(tmp_path: Path) -> None:
    rows = [
        {**row, "n_false_regions_on_movers": n, "false_regions_per_100m": 0.5 * n}
        for world, numbers in (("unchanged/narrow", [0] * 6), ("dynamic/null", [2, 1, 1, 2, 1, 2]))
        for row, n in zip(rows_of(world, "ours", [NAN] * 6, unchanged=True), numbers, strict=True)
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv", index=False)
    data = read_run(tmp_path)
    (shown,) = draw_effects(data)
    assert shown.reference == "unchanged/narrow"
    at = shown.table.headings.index("false regions on movers")
    assert shown.table.headings[at - 1] == "false regions / 100 m"
    (_, plain), (_, moving) = shown.table.rows
    assert moving[0].text == "dynamic/null"
    assert (plain[at].text, moving[at].text, moving[at - 1].text) == ("0.00", "+1.50", "+0.75")
    # tables of regions have a row for each of both
    assert scenarios(data, unchanged=True) == ["unchanged/narrow", "dynamic/null"]
