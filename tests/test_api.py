"""The pipeline from Python: what the shell can do, with paths and with opened sessions."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cdpipe
from eval import plot, score
from scenarios.library import load_scenario
from sim.session.simulate import simulate_pair

SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")
SETTINGS = {"query": {"n_regions": 2}, "extract.min_cells": 20}


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api") / "pair"
    simulate_pair(load_scenario("smoke/one_box", 11, SMALL), 11, path)
    return path


@pytest.fixture(scope="module")
def report(pair: Path) -> cdpipe.ChangeReport:
    return cdpipe.detect(pair / "before", str(pair / "after"), settings=SETTINGS)


def test_paths_and_opened_sessions_give_the_same(pair: Path, report: cdpipe.ChangeReport) -> None:
    before, after = cdpipe.open_session(pair / "before"), cdpipe.open_session(str(pair / "after"))
    again = cdpipe.detect(before, after, settings=["query.n_regions=2", "extract.min_cells=20"])
    np.testing.assert_array_equal(again.regions.centres_map, report.regions.centres_map)
    assert [item.returns.tobytes() for item in again.objects] == [item.returns.tobytes() for item in report.objects]
    assert again.config == report.config


def test_mapped_sessions_are_compared_by_the_source_of_the_settings(pair: Path) -> None:
    config = cdpipe.load_config("c2c", {"query.threshold": 5})
    mapped = [cdpipe.map_session(cdpipe.open_session(pair / name), config) for name in ("before", "after")]
    by_method = cdpipe.detect_changes(*mapped, config)
    assert by_method.config["regions"]["source"] == "c2c"
    # a whole-map method scores a region by its number of points
    assert len(by_method.regions.scores) > 0
    assert (by_method.regions.scores % 1 == 0).all()
    by_share = cdpipe.detect_changes(*mapped, cdpipe.load_config("sphere-difference"))
    assert by_share.regions.scores.max() <= 1


def test_tables_hold_what_the_report_does(report: cdpipe.ChangeReport) -> None:
    objects, regions = report.to_pandas(), report.to_pandas("regions")
    assert len(objects) == len(report.objects) > 0
    assert objects["n_returns"].tolist() == [len(item.returns) for item in report.objects]
    assert len(regions) == report.regions.is_proposed.sum()
    assert regions["radius_m"].tolist() == report.regions.radii_m[report.regions.is_proposed].tolist()
    with pytest.raises(ValueError, match="objects"):
        report.to_pandas("object")  # type: ignore[arg-type]


def test_a_saved_report_scores_like_the_one_in_memory(pair: Path, report: cdpipe.ChangeReport, tmp_path: Path) -> None:
    cdpipe.save_report(report, tmp_path / "answer", "mine")
    stored, held = score(tmp_path / "answer", pair), score(report, pair)
    assert held["object_iou_point"] > 0.5
    assert cdpipe.read_answer(str(tmp_path / "answer")).method == "mine"
    for row in (stored, held):
        del row["variant"], row["preset"]
    np.testing.assert_equal(stored, held)


def test_the_plot_shows_objects_and_truth(pair: Path, report: cdpipe.ChangeReport) -> None:
    (axes,) = plot(report, pair).axes
    lines = {str(line.get_label()): np.column_stack(line.get_data()) for line in axes.lines}
    kinds = {item.kind for item in report.objects}
    assert kinds <= lines.keys()
    found = np.concatenate([lines[kind] for kind in kinds])
    assert np.linalg.norm(found - lines["true change"][0], axis=1).min() < 1.0


def test_a_mistaken_setting_is_told_with_its_name() -> None:
    with pytest.raises(cdpipe.InputError, match=r"query\.radius"):
        cdpipe.detect("a", "b", settings={"query.radius": 3})


def test_importing_the_packages_loads_nothing_heavy() -> None:
    heavy = "{'numpy', 'scipy', 'pandas', 'torch', 'mujoco', 'pydantic', 'matplotlib'}"
    program = f"import sys, cdpipe, sim, eval as _; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_merge_and_the_extraction_need_no_torch() -> None:
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "import cdpipe.merge.merge, cdpipe.extract.extract, cdpipe.extract.surface_rule\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
