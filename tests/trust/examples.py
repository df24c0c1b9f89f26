"""Examples for readers of worlds, weights, united runs, evaluations, stories, maps and pages; `readers` names them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import trimesh

from cdpipe.core.plugins import SEARCH_PATH
from cdpipe.descriptors.change_network import load_change_network
from cdpipe.descriptors.network import load_network
from cdpipe.descriptors.sphere_network import load_sphere_network
from cdpipe.descriptors.weights_file import read_weights
from cdpipe.io.out.answer_map import gather_answer_map
from cdpipe.io.ply import write_ply_points
from cdpipe.io.readers import open_session
from cdpipe.model.config import load_config
from eval.cli.listing import list_entries
from eval.core.tablefile import read_table
from eval.core.terminal.progress import Silent
from eval.leaderboard.calls import describe_calls, evaluation_folder, read_evaluation
from eval.leaderboard.packing import pack_submission
from eval.leaderboard.reference import find_reference
from eval.plans.plan import load_plan
from eval.release.content import load_release
from eval.report.answer.content import read_content
from eval.report.answer.page import render_answer_page
from eval.report.framing.catalogue import write_index
from eval.report.framing.kept import read_kept
from eval.running.runfolder import open_run_folder, write_json
from eval.running.scaling.merging import merge_runs
from eval.running.scaling.mirror import Mirror
from eval.stories.comparisons import Method, run_comparisons
from eval.studies.bench_tables import main as write_bench_tables
from scenarios.library import check_scenario, load_grafted, load_scenario
from scenarios.references import file_digests
from scenarios.schema import MeshFile
from sim.trace import draft_scenario, trace_mesh
from tests.eval.conftest import write_pair
from tests.eval.leaderboard.conftest import Evaluator

_ROOT = Path(__file__).parents[2]
_WORLDS = ("surface/mixed", "dust/haul", "dynamic/narrow", "water/narrow", "glare/narrow", "odometry/legged")
_RELEASE = 'description: Pairs\npublished: 2026-11-26\npairs: {smoke/one_box: "20000:20001"}\n'
_OWN = """tunnel: {mesh: {path: m.obj, units: m, up: z}}
props:
  - {name: own, kind: mesh, mesh: {path: m.obj}, place: {at: [5, 0, 0]}, change: added}
before: {trajectory: t.tum}
after: {trajectory: t.tum, odometry: {file: t.tum}}
"""


def make_worlds(folder: Path) -> None:
    """Write families with rock that moves, dust, movers, puddles, glare; and one whose walls and drives are files."""
    for name in _WORLDS:
        shutil.copy(_ROOT / "scenarios" / "families" / f"{name}.yaml", folder / f"{name.replace('/', '-')}.yaml")
    trimesh.creation.box((20.0, 4.0, 4.0)).export(folder / "m.obj")
    rows = [f"{0.1 * n:.1f} {0.5 * n:.1f} 0 1 0 0 0 1" for n in range(9)]
    (folder / "t.tum").write_text("".join(f"{row}\n" for row in rows))
    (folder / "own.yaml").write_text(_OWN)


def read_worlds(folder: Path) -> None:
    """Draw them; of the one with files, digest these."""
    for path in sorted(folder.glob("*.yaml")):
        scenario = load_scenario(str(path), 3)
        if path.name == "own.yaml":
            file_digests(scenario)


def make_objects(folder: Path) -> None:
    """Write props for a recording, and a world that names its recording."""
    (folder / "r").mkdir()
    (folder / "r" / "x").write_text("x")
    props = "props:\n  - {name: box, kind: box, size_m: [{uniform: [0.6, 0.9]}, 0.6, 0.7], change: added}\nsurface:\n"
    props += "  - {name: low, kind: heave, depth_m: 0.05, area_m2: 2.0, place: {at: [1.0, 0.0, -1.0]}}\n"
    props += "  - {name: lined, kind: shotcrete, thickness_m: {uniform: [0.03, 0.08]}, length_m: 3.0, width_m: 2.0}\n"
    (folder / "objects.yaml").write_text(props)
    (folder / "real.yaml").write_text("recording: {sessions: [r], split: halves}\n" + props)


def read_objects(folder: Path) -> None:
    """Draw both."""
    load_grafted(str(folder / "objects.yaml"), {"sessions": [str(folder / "r")]}, 3)
    check_scenario(str(folder / "real.yaml"))


def make_bench_tables(folder: Path) -> None:
    """Copy two tables of `bench`."""
    for name in ("bench-1", "growth"):
        shutil.copy(_ROOT / "reports" / "bench" / f"{name}.json", folder)


def read_bench_tables(folder: Path) -> None:
    """Write them as one page."""
    write_bench_tables([folder / "bench-1.json", folder / "growth.json"], folder / "tables.md")


def make_search_path(folder: Path) -> None:
    """Write a preset, a plan and a family of one's own."""
    copied = {
        "presets": "cdpipe/methods/presets/voxel-diff",
        "plans": "eval/plans/shipped/smoke",
        "families": "scenarios/families/smoke/one_box",
    }
    for kind, name in copied.items():
        (folder / kind).mkdir()
        shutil.copy(_ROOT / f"{name}.yaml", folder / kind / "my_own.yaml")


def read_search_path(folder: Path) -> None:
    """List them, and read each by its name."""
    with on_search_path(folder):
        for kind in ("presets", "plans"):  # of scenarios there are 150
            list_entries(kind)
        load_config("my_own")
        load_plan("my_own")
        load_scenario("my_own", 3)


@contextmanager
def on_search_path(folder: Path) -> Iterator[None]:
    """Have a folder on the search path."""
    os.environ[SEARCH_PATH] = str(folder)
    try:
        yield
    finally:
        del os.environ[SEARCH_PATH]


def make_weights(folder: Path) -> None:
    """Copy the shipped weights."""
    for name in ("3deg", "sphere", "range-net"):
        shutil.copy(_ROOT / "cdpipe" / "descriptors" / "weights" / f"{name}.safetensors", folder)


def read_all_weights(folder: Path) -> None:
    """Read each as the network that it is of."""
    loads = {"3deg": load_network, "sphere": load_sphere_network, "range-net": load_change_network}
    for name, load in loads.items():
        load(read_weights(str(folder / f"{name}.safetensors")), name)


def add_twin(folder: Path) -> None:
    """Copy a run, as a second part of one plan."""
    shutil.copytree(folder / "run", folder / "twin")


def read_union(folder: Path) -> None:
    """Unite both, one of them as rows at a URL."""
    with TemporaryDirectory() as place:
        rows = Path(place) / "rows"
        rows.mkdir()
        Mirror(f"file://{folder / 'twin'}").fetch_all(rows)
        merge_runs([folder / "run", rows], Path(place) / "union", keep="answers")
        merge_runs([folder / "run", folder / "twin"], Path(place) / "whole")


def make_evaluation(folder: Path) -> None:
    """Evaluate a script on two tiny pairs."""
    Evaluator(folder).evaluate()


def read_evaluated(folder: Path) -> None:
    """Read how it was called, pack it, and read the reference rows."""
    run = open_run_folder(folder / "run")
    describe_calls(run, read_evaluation(run, "mine"))
    assert evaluation_folder(run, "mine").is_dir()
    pack_submission(run, "mine", folder / "mine.zip")
    find_reference("smoke", folder / "run")


def read_answer_page(folder: Path) -> None:
    """Show an answer on the maps of its sessions, and write both as one map."""
    pair = folder / "pair"
    render_answer_page(read_content(pair / "before", pair / "after", folder / "answer", _ignore))
    sessions = open_session(pair / "before"), open_session(pair / "after")
    gather_answer_map(sessions, folder / "answer", 0.2, _ignore)


def make_map(folder: Path) -> None:
    """Write a drift of 12 m as one cloud."""
    rng = np.random.default_rng(6)
    points = rng.uniform((0.0, -2.0, 0.0), (12.0, 2.0, 3.0), (3000, 3))
    points[:1500, 2] = np.where(points[:1500, 2] > 1.5, 3.0, 0.0)
    points[1500:, 1] = np.where(points[1500:, 1] > 0.0, 2.0, -2.0)
    write_ply_points(folder / "m.ply", points)


def read_map(folder: Path) -> None:
    """Read it from the stations that are found."""
    for scan in open_session(folder / "m.ply").scans():
        scan.points_sensor.sum()


def make_drift(folder: Path) -> None:
    """Write the walls of a drift of 20 m."""
    solid = trimesh.creation.box((20.0, 4.0, 3.0)).subdivide_to_size(2.0)
    solid.invert()
    for suffix in ("obj", "stl"):
        solid.export(folder / f"m.{suffix}")


def read_drift(folder: Path) -> None:
    """Trace it."""
    for path in sorted(folder.glob("m.*")):
        draft_scenario(trace_mesh(MeshFile(path=str(path))))


def make_pages(folder: Path) -> None:
    """Write a page of a run as an earlier report left it, and a folder of two reports."""
    page = '<h2 id="regions">R</h2><table><caption>c</caption><tr><th>a</th></tr><tr><td class="best">1<small>x</small>'
    page += '</td></tr></table><figure><p class="title">t</p><img src="data:image/png;base64,iVBORw0KGgoAAAANSUhEUgAAA'
    page += (
        'AEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="><figcaption>f</figcaption></figure>'
    )
    for name in ("one", "two"):
        (folder / "reports" / name / "notes").mkdir(parents=True)
        (folder / "reports" / name / "index.html").write_text(f'<p class="answer">yes &lt;b&gt;</p>{page}')
        (folder / "reports" / name / "notes" / "n.md").write_text("# N")
        about = {"plan": {"name": name, "description": "What? This."}, "finished": "2026-11-26T10:00:00"}
        write_json(folder / "reports" / name / "provenance.json", about)
    (folder / "reports" / "README.md").write_text("| [one](one) | What does `one` do? | x |\n")


def read_pages(folder: Path) -> None:
    """Keep what the page shows, and write the index of both."""
    read_kept(folder / "reports" / "one" / "index.html")
    write_index(folder / "reports")


def make_parquet(folder: Path) -> None:
    """Write a table as Parquet alone."""
    (folder / "t.parquet").mkdir()
    frame = pd.DataFrame({"scenario": ["a"] * 40, "seed": range(40), "x": np.linspace(0.0, 1.0, 40)})
    frame.to_parquet(folder / "t.parquet" / "00000-a.parquet", index=False)


def read_parquet_table(folder: Path) -> None:
    """Read it."""
    read_table(folder / "t.parquet")


def make_comparisons(folder: Path) -> None:
    """Write a story of two sessions, and compare them."""
    write_pair(folder / "pair")
    (folder / "story").mkdir()
    for number, name in enumerate(("before", "after"), 1):
        (folder / "pair" / name).rename(folder / "story" / f"session-0{number}")
    read_comparisons(folder)


def read_comparisons(folder: Path) -> None:
    """Go on with the comparisons."""
    run_comparisons(folder / "story", folder / "out", Method("voxel-diff", "narrow", ()), Silent())


def make_release_content(folder: Path) -> None:
    """Write what a release is to hold."""
    (folder / "own.yaml").write_text(_RELEASE + "settings: [sensor.mode=512x10]\n")


def read_release_content(folder: Path) -> None:
    """Draw its pairs."""
    load_release(str(folder / "own.yaml"))


def _ignore(*_: object) -> None:
    pass
