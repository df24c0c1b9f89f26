"""What the page shows of sources of regions crossed with extractions."""

from pathlib import Path

import pandas as pd
import pytest

from eval.core.figures import picture
from eval.report.page import write_page
from eval.report.settings.factorial import draw_factorial, factorial_table
from eval.running.results.run_data import RunData, read_run

SURFACE, VOXEL = "[extract.method=surface]", "[extract.method=voxel,extract.voxel_m=0.3]"


def rows_of(variant: str, recall: float, n_false: int, status: str = "ok") -> list[dict[str, object]]:
    return [
        {
            "scenario": scenario, "family": scenario, "seed": seed, "variant": variant,
            "preset": variant.partition("[")[0],
            "status": status if seed == 0 else "ok", "region_recall": recall if status == "ok" or seed else 0.0,
            "region_recall_at_k": recall, "object_f1_50": recall / 2, "object_iou_point": recall / 4, "object_pq": 0.0,
            "n_observable": 2, "n_false_regions": n_false, "after_path_m": 100.0 * (1 + seed),
            "t_total_paper_s": 3.0 + seed, "is_unchanged_pair": False, "is_alarm": False,
        }
        for scenario in ("narrow", "cave")
        for seed in (0, 1)
    ]  # fmt: skip


def run_of(folder: Path, *rows: list[dict[str, object]]) -> RunData:
    pd.DataFrame([each for own in rows for each in own]).to_csv(folder / "results.csv", index=False)
    return read_run(folder)


@pytest.fixture
def data(tmp_path: Path) -> RunData:
    return run_of(
        tmp_path,
        rows_of(f"oracle-regions{SURFACE}", 1.0, 0),
        rows_of(f"oracle-regions{VOXEL}", 0.8, 0),
        rows_of(f"c2c{SURFACE}", 0.6, 3),
        rows_of(f"c2c{VOXEL}", 0.4, 1, "merge_refused"),
        rows_of("c2c[extract.method=clusters]", 0.5, 2),
        rows_of("c2c", 0.7, 2),
    )


def test_table_by_hand(data: RunData) -> None:
    table = factorial_table(data)
    assert list(dict.fromkeys(zip(table["source"], table["extraction"], strict=True))) == [
        ("oracle-regions", "surface"), ("oracle-regions", "voxel"), ("c2c", "surface"), ("c2c", "voxel"),
        ("c2c", "clusters"),
    ]  # fmt: skip
    assert set(table["domain"]) == {"in", "out", "all"}
    whole = table[table["domain"] == "all"].set_index(["source", "extraction"])
    assert whole["n_pairs"].tolist() == [4] * 5
    assert whole.loc[("c2c", "surface"), "region_recall"] == pytest.approx(0.6)
    # 12 false regions on 600 m
    assert whole.loc[("c2c", "surface"), "false_regions_per_100m"] == pytest.approx(2.0)
    assert whole.loc[("c2c", "surface"), "t_total_paper_s"] == pytest.approx(3.5)
    # a refused pair has found nothing, and its way does not count
    assert whole.loc[("c2c", "voxel"), "n_failed"] == 2
    assert whole.loc[("c2c", "voxel"), "region_recall"] == pytest.approx(0.2)
    assert whole.loc[("c2c", "voxel"), "false_regions_per_100m"] == pytest.approx(0.5)


def test_the_page_shows_the_combinations(data: RunData) -> None:
    page = write_page(data.folder.path).read_text()
    assert '<details class="section" id="factorial">' in page
    assert len(pd.read_csv(data.folder.path / "factorial.csv")) == 15
    charts = draw_factorial(factorial_table(data))
    assert [chart.name for chart in charts] == ["factorial_in", "factorial_out", "factorial_all"]
    first = charts[0].drawing.rows[0][0]
    assert first.heat is not None
    # truth has no clusters of its own: an empty cell
    assert [list(row) for row in first.heat.texts] == [["1.00", "0.80", "\u2013"], ["0.60", "0.20", "0.50"]]
    assert picture(charts[0].drawing)


def test_combinations_that_would_share_a_cell_are_not_crossed(tmp_path: Path) -> None:
    twice = "c2c[extract.method=voxel,extract.voxel_m=0.4]"
    data = run_of(
        tmp_path,
        *(rows_of(f"{name}{rule}", 0.6, 3) for name in ("c2c", "m3c2") for rule in (SURFACE, VOXEL)),
        rows_of(twice, 0.9, 0),
    )
    assert len(factorial_table(data)) == 0


def test_one_source_with_several_extractions_is_no_factorial(tmp_path: Path) -> None:
    data = run_of(tmp_path, rows_of(f"c2c{SURFACE}", 0.6, 3), rows_of(f"c2c{VOXEL}", 0.4, 1), rows_of("m3c2", 1.0, 0))
    assert len(factorial_table(data)) == 0
    assert '<details class="section" id="factorial">' not in write_page(tmp_path).read_text()
    assert not (tmp_path / "factorial.csv").exists()
