"""Rock that moved on the page: the section is there where a run has its figures, and angles are those of the drift."""

from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose, yaw_pose
from cdpipe.surface import unroll
from eval.report.page import write_page
from eval.report.surface.surface import draw_surface
from eval.running.cell_file import cell_document
from eval.running.results.run_data import read_run
from eval.running.runfolder import RunFolder, write_json, write_tables
from eval.scoring.scoring import CaseScore
from tests.eval.scoring.surface.surface_worlds import score_field, true_field, wall_truth

PATCHES = {1: (5, 0.5, 4, 4, 0.05), 2: (15, 1, 2, 2, -0.2)}


def write_run(path: Path, *, subjects: list[str], family: str = "surface/heave", has_field: bool = True) -> Path:
    """A run of two methods on two walls: one answers the truth, the other nothing."""
    run = RunFolder(path)
    path.mkdir()
    plan = {"name": "surface", "report": subjects}
    write_json(path / "provenance.json", {"tool": "tunnelcd", "format_version": 1, "plan": plan})
    for seed in (1, 2):
        truth = wall_truth(PATCHES if has_field else {}, family=family)
        for place, name in enumerate(("ours", "silent")):
            field = true_field(truth) if has_field and name == "ours" else None
            score: CaseScore = score_field(truth, field)
            identity = {
                "scenario": family, "seed": seed, "variant": name, "preset": name, "pair_kind": "", "commit": None,
                "is_contended": False,
            }  # fmt: skip
            target = run.cell(family, seed, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            write_json(target, cell_document(score, identity, "key", (0, place)))
    write_tables(run)
    return path


def test_the_page_shows_tables_limits_and_what_could_not_be_drawn(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", subjects=["surface"])
    assert {"surface_table.csv", "detection_limits.csv", "surface_changes.csv", "surface_windows.csv"} <= {
        each.name for each in run.iterdir()
    }
    section = draw_surface(read_run(run))
    (table,) = section.tables
    assert [cells[0].text for _, cells in table.rows] == ["ours", "silent"]
    recall = table.headings.index("recall")
    assert [cells[recall].text for _, cells in table.rows] == ["1.00", "0.00"]
    assert [cells[recall].is_best for _, cells in table.rows] == [True, False]
    (chart,) = section.plots
    assert [panel.heading for panel in chart.drawing.rows[0]] == ["1 m²", "4 m²", "16 m²"]
    assert "is not in the run folder: its map is not drawn" in section.missing[0]
    page = write_page(run, "none", is_slim=True).read_text()
    assert "Measuring rock that moved" in page
    assert (run / f"{chart.name}.png").is_file()


def test_there_is_no_section_without_figures_or_without_a_plan_that_asks(tmp_path: Path) -> None:
    unasked = write_run(tmp_path / "unasked", subjects=[])
    assert draw_surface(read_run(unasked)) is None
    other = write_run(tmp_path / "other", subjects=["surface"], family="narrow", has_field=False)
    assert draw_surface(read_run(other)) is None
    assert not (other / "surface_windows.csv").exists()


@pytest.mark.parametrize("yaw_rad", [0.0, 1.1, -2.5])
def test_angles_turn_from_the_crown_to_the_left_wall(yaw_rad: float) -> None:
    # a square drift of 4 x 4 m, its axis 2 m above the floor; the robot drives 1 m to the right of it, 1 m up
    odom_T_world = yaw_pose(yaw_rad, (3.0, -7.0, 2.0))
    path = np.stack([odom_T_world @ make_pose(translation=(0.5 * k, -1.0, 1.0)) for k in range(41)])
    wanted = {(0.0, 4.0): 0.0, (2.0, 2.0): 90.0, (-2.0, 2.0): -90.0, (0.0, 0.0): 180.0, (2.0, 4.0): 45.0}
    ring = [(x, y, z) for x in np.arange(2.25, 17) for y, z in wanted]
    points = np.array(ring) @ odom_T_world[:3, :3].T + odom_T_world[:3, 3]
    chainage_m, angle_deg, _ = unroll(points, path)
    np.testing.assert_allclose(chainage_m, [x for x, _, _ in ring], atol=1e-9)
    np.testing.assert_allclose(np.abs(angle_deg), [abs(wanted[y, z]) for _, y, z in ring], atol=1e-6)
    is_aside = np.array([y != 0 for _, y, _ in ring])
    np.testing.assert_array_equal(np.sign(angle_deg[is_aside]), [np.sign(y) for _, y, _ in ring if y])
