"""Every reader of files that others may have made: a small right example, and how it is read.

A reader is called in a folder that holds its example, one file of which is damaged. It may read the file, or raise
`TunnelcdError` with one line (a YAML or JSON file with several mistakes: one line each). Anything else is a defect.
"""

from __future__ import annotations

import json
import lzma
import shutil
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cdpipe.core.geometry import invert, make_pose, yaw_pose
from cdpipe.core.yamlfile import apply_settings, read_yaml, setting_lines
from cdpipe.descriptors.describe import load_descriptors, save_descriptors
from cdpipe.io.answer import read_answer
from cdpipe.io.foreign.trajectory import read_poses, read_times
from cdpipe.io.known_merge import read_alignment, read_known_merge, write_alignment
from cdpipe.io.ply import read_ply_points
from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.io.tum import motion_along, read_tum
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import DescriptorConfig, MapConfig, load_config
from cdpipe.model.types import DescriptorSet
from cdpipe.sensor.ouster import load_profile
from cdpipe.training.data import ChangePairs, open_dataset, read_place_data
from cdpipe.training.fit import FitConfig, fit
from cdpipe.training.shard import FIELDS, FORMAT, FORMAT_VERSION, encode_shard, read_shard
from cdpipe.training.sphere_training import read_sphere_data
from eval.leaderboard.packing import pack_submission
from eval.leaderboard.page import write_leaderboard
from eval.leaderboard.submission import read_submission
from eval.plans.cells import expand_cells
from eval.plans.plan import load_plan
from eval.release.archive import pack, unpack_release, write_sums
from eval.report.comparing.page import compare_sides
from eval.report.page import write_page
from eval.running.cell_file import LAST, NO_KEY, cell_document
from eval.running.export import name_blindly
from eval.running.rescoring import foreign_identity
from eval.running.results.run_data import read_run
from eval.running.results.sides import read_side
from eval.running.runfolder import RunFolder, open_run_folder, write_json, write_tables
from eval.running.scaling.keeping import Dropped, dropped_file, list_dropped, read_dropped
from eval.running.stages.stage_cache import Kept, StageCache
from eval.scoring.scoring import score_stored
from eval.studies.calibrate import read_table
from eval.studies.descriptors.curves import read_rows
from eval.training.dataset import Recipe
from eval.training.dataset_card import COUNTS
from eval.training.dataset_run import make_dataset
from eval.truth.ground_truth import load_ground_truth
from scenarios.catalogue import read_prop
from scenarios.library import load_scenario
from scenarios.schema import MeshFile
from sim.placement.recorded import read_drive
from sim.rock.foreign import prop_mesh, tunnel_mesh
from sim.session.truth import (
    MoverTrack,
    MoverTruth,
    SurfaceChangeTruth,
    read_labels,
    read_pair_truth,
    write_mover_track,
    write_pair_truth,
    write_surface_labels,
)
from sim.story.state import SessionState, Story, dump_story, read_story
from tests.eval.conftest import N_SCANS, ODOM_T_WORLD, WIDTH, write_pair
from tests.eval.leaderboard.conftest import Evaluator
from tests.trust import examples

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class Reader:
    """One reader.

    Attributes:
        name: What it reads.
        make: Writes the example into an empty folder.
        read: Reads the folder; what it returns is not looked at.
        files: Patterns of the files that are damaged, below the folder.
        share: Share of the inputs, relative to 1.
        lines: Whether several mistakes may be several lines.
        extra: Module that the reader needs, "" for none.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    files: tuple[str, ...]
    share: float = 1.0
    lines: bool = False
    extra: str = ""


def _session(folder: Path) -> None:
    write_pair(folder / "pair")
    shutil.move(folder / "pair" / "before", folder / "s")
    shutil.rmtree(folder / "pair")
    shutil.rmtree(folder / "s" / "truth")


def _scans(folder: Path) -> None:
    points = np.random.default_rng(1).normal(0, 3, (40, 3))
    lines = []
    for number in range(3):
        _ply(folder / f"{number:06d}.ply", points + number, is_ascii=number == 1)
        lines.append(f"{number} {0.5 * number} 0 0 0 0 0 1")
    (folder / "trajectory.txt").write_text("# stamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")


def _ply(path: Path, points: np.ndarray, *, is_ascii: bool) -> None:
    kind = "ascii" if is_ascii else "binary_little_endian"
    head = f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex {len(points)}\nproperty float x\n"
    head += "property float y\nproperty float z\nproperty uchar intensity\nend_header\n"
    rows = [struct.pack("<fffB", *point, 7) for point in points]
    text = "".join(f"{x:.4f} {y:.4f} {z:.4f} 7\n" for x, y, z in points).encode()
    path.write_bytes(head.encode() + (text if is_ascii else b"".join(rows)))


def _tum(folder: Path) -> None:
    rows = [f"{100 + 0.1 * n:.6f} {0.05 * n:.4f} {0.1 * np.sin(n):.4f} 1.2 0 0 0 1" for n in range(30)]
    (folder / "t.tum").write_text("# stamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")


def _read_tum(folder: Path) -> None:
    read_tum(folder / "t.tum")
    read_drive(folder / "t.tum")
    motion_along(folder / "t.tum", 100_000_000_000, 102_000_000_000, 0.2).poses(np.linspace(0, 2, 5))


def _metadata(folder: Path) -> None:
    profiles = ROOT / "cdpipe" / "sensor" / "profiles"
    shutil.copy(profiles / "os1-32-g.json", folder / "flat.json")
    document = json.loads((profiles / "os1-32-u0.json").read_text())
    nested = {"sensor_info": {key: value for key, value in document.items() if key.startswith("prod")}}
    nested["config_params"] = {"lidar_mode": document["lidar_mode"]}
    nested["beam_intrinsics"] = {key: value for key, value in document.items() if key.startswith("beam")}
    (folder / "nested.json").write_text(json.dumps(nested))


def _answer(folder: Path, *, by_returns: bool = False) -> None:
    """Write an answer to the tiny pair; its objects are points, or returns of the things that changed."""
    merge = ODOM_T_WORLD["before"] @ invert(ODOM_T_WORLD["after"])
    folder.mkdir(exist_ok=True)
    points = np.random.default_rng(2).normal(0, 1, (20, 3))
    document = {
        "format": "tunnelcd-answer", "format_version": 1, "status": "ok", "error": "", "method": "mine",
        "before_T_after": merge.tolist(), **({"radius_m": 4.5} if by_returns else {}),
        "seconds": {"t_merge_s": 0.1, "t_cd_s": 0.2, "t_oe_s": 0.0, "t_descriptor_s": 0.0},
        "evidence": {"overlap": 0.9}, "config": {"a": {"b": 1}},
        "objects": [
            {"session": "after", "kind": "added", "score": 0.5, "region": 0},
            {"session": "before", "kind": "moved", "partner": 0, "displacement_map": [1.0, 0.0, 0.0],
             "shape": {"map_T_box": np.eye(4).tolist(), "box_m": [1.0, 1.0, 1.0], "volume_m3": 1.0}},
        ],
        "surface_regions": [{"centre_map": [0.0] * 3, "area_m2": 2, "volume_m3": 1, "mean_m": 0.1, "largest_m": 0.1}],
    }  # fmt: skip
    (folder / "answer.json").write_text(json.dumps(document, indent=1))
    offsets = np.array([0, 12, 20])
    objects = {"object_points_odom": points, "object_point_odom_offsets": offsets}
    objects |= {"object_points_map": points, "object_point_offsets": offsets, "region_radii_m": np.full(3, 4.5)}
    if by_returns:
        returns = [[scan, WIDTH + 4 + n] for scan in (2, 3) for n in range(6)] + [[9, WIDTH + 30 + n] for n in range(8)]
        objects = {"object_returns": np.array(returns, np.int32), "object_return_offsets": offsets}
    np.savez(
        folder / "answer.npz",
        region_centres_map=points[:3],
        region_scores=np.array([3.0, 2.0, 1.0]),
        region_is_reported=np.array([True, False, False]),
        region_is_withdrawn=np.array([False, True, False]),
        region_is_forced=np.array([False, False, True]),
        region_pairs=np.eye(3, 2, dtype=int),
        region_direction=np.array([0, 1, 0], np.uint8),
        region_proposed_centres_map=points[3:6],
        **objects,
        before_keyframe_scans=np.arange(0, 14, 2),
        after_keyframe_scans=np.arange(0, 14, 2),
        keyframe_scores=np.linspace(0, 1, 7),
        local_before_T_after=np.tile(merge, (7, 1, 1)),
        figure_x=np.zeros(3),
        surface_points_map=points,
        surface_normals_map=np.eye(3)[np.arange(20) % 3],
        surface_region=np.arange(20) % 3 // 2 - 1,
        **{f"surface_{name}": points[:, 0] for name in ("displacement_m", "chainage_m", "angle_deg")},
        surface_level_m=np.full(20, 0.1),
    )


def _pair(pair: Path) -> None:
    """Write the tiny pair; in its truth something moves, and the rock moved."""
    write_pair(pair)
    rock = SurfaceChangeTruth(1, "sinks", "heave", None, 2.0, 0.2, 0.1, 0.1, [0.0] * 3)
    mover = MoverTruth("man", "person", 9, "before", 2.0, 0.5, 10)
    write_pair_truth(pair, replace(read_pair_truth(pair), movers=(mover,), surface_changes=(rock,)))
    track = np.tile(np.eye(4), (1, N_SCANS, 1, 1)), np.ones((1, N_SCANS), np.int32), np.zeros((1, N_SCANS, 3))
    write_mover_track(pair / "before", MoverTrack(*track))
    for name in ("before", "after"):
        for index, (_, change) in enumerate(read_labels(pair / name, 3)):
            write_surface_labels(pair / name, index, np.full(change.shape, 0.1, np.float32), np.ones_like(change))


def _scored(folder: Path) -> None:
    _pair(folder / "pair")
    _answer(folder / "answer", by_returns=True)


def _truth(folder: Path) -> None:
    _pair(folder / "pair")
    load_ground_truth(folder / "pair")  # writes the caches of scoring points


def _read_truth(folder: Path) -> None:
    pair = folder / "pair"
    score_stored(load_ground_truth(pair), _right_answer(folder))
    list(read_labels(pair / "before", 3))


def _right_answer(folder: Path) -> Path:
    if not (folder / "right").is_dir():
        _answer(folder / "right", by_returns=True)
    return folder / "right"


def _copy(*paths: str) -> Callable[[Path], object]:
    def make(folder: Path) -> None:
        for path in paths:
            shutil.copy(ROOT / path, folder)

    return make


def _read_presets(folder: Path) -> None:
    for path in sorted(folder.glob("*.yaml")):
        load_config(str(path))
        load_config(str(path), site="wide")


def _read_plans(folder: Path) -> None:
    for path in sorted(folder.glob("*.yaml")):
        expand_cells(load_plan(str(path)))


def _read_families(folder: Path) -> None:
    for path in sorted(folder.glob("*.yaml")):
        load_scenario(str(path), 3)


def _settings(folder: Path) -> None:
    (folder / "settings.txt").write_text("extract.voxel_m=0.4\nmerge.refine=local\nextract.method=surface\n")
    (folder / "p.yaml").write_text("extract: {voxel_m: 0.2}\n")


def _read_settings(folder: Path) -> None:
    text = (folder / "settings.txt").read_bytes().decode("utf-8", errors="replace")
    lines = setting_lines(text.splitlines())
    apply_settings(read_yaml(folder / "p.yaml"), lines)
    load_config("tunnelcd", lines)


def _meshes(folder: Path) -> None:
    box = trimesh.creation.box((1.0, 0.6, 0.8))
    for suffix in ("obj", "stl", "ply", "glb"):
        box.export(folder / f"m.{suffix}")
    box.export(folder / "ascii.stl", file_type="stl_ascii")
    inverted = trimesh.creation.box((20.0, 4.0, 4.0))
    inverted.invert()
    inverted.export(folder / "tunnel.obj")


def _read_meshes(folder: Path) -> None:
    for name in ("m.obj", "m.stl", "m.ply", "m.glb", "ascii.stl"):
        prop_mesh(MeshFile(path=str(folder / name)), "x")
    tunnel_mesh(MeshFile(path=str(folder / "tunnel.obj"), flip=False))


def _props(folder: Path) -> None:
    (folder / "props").mkdir()
    trimesh.creation.box((1.0, 0.6, 0.8)).export(folder / "props" / "m.obj")
    (folder / "props" / "my_skip.yaml").write_text("mesh: {path: m.obj, units: m, up: z}\nreflectivity: 0.4\n")


def _read_props(folder: Path) -> None:
    with examples.on_search_path(folder):
        prop = read_prop("my_skip")
    prop_mesh(prop.mesh, "skip")


def _descriptors(folder: Path) -> None:
    _session(folder)
    session = read_session(folder / "s")
    q = np.eye(8, 64, dtype=np.float32)
    found = DescriptorSet(q, q, np.arange(8), "scan-context", "version 1")
    save_descriptors(folder / "s", found, session.odom_T_sensor, MapConfig())


def _read_descriptors(folder: Path) -> None:
    session = read_session(folder / "s")
    load_descriptors(folder / "s", DescriptorConfig(method="scan-context"), session.odom_T_sensor, MapConfig())


def _shards(folder: Path) -> None:
    sizes = {"K": 6, "J": 5, "C": 2, "D": 2, "R": 4, "W": 8, "I": 16, "V": 4, "U": 8}
    rng = np.random.default_rng(3)
    for seed in (1, 2):
        arrays: dict[str, Any] = {}
        for field in FIELDS:
            shape = tuple(sizes[axis] if axis in sizes else int(axis) for axis in field.shape.split(","))
            values = rng.integers(0, 2, shape) if field.dtype in ("uint8", "bool") else rng.random(shape)
            arrays[field.name] = values.astype(field.dtype)
        arrays["is_covered"][:] = True
        for name in ("before_world_T_keyframe", "after_world_T_keyframe"):
            arrays[name][:] = np.eye(4)
        arrays["change_ids"] = np.array([1, 2])
        about = {"family": "train/x", "seed": seed, "split": "train", "digest": "d", "score_radius_m": 3.0}
        about |= {"counts": dict.fromkeys(COUNTS, 6)}
        (folder / f"train__x-{seed}.safetensors").write_bytes(encode_shard(arrays, about))
    rows = [f"train/x,{seed},train,ok,train__x-{seed}.safetensors,6,5" for seed in (1, 2)]
    head = "family,seed,split,status,shard,n_before,n_after\n"
    (folder / "index.csv").write_text(head + "\n".join(rows) + "\n")


def _read_shards(folder: Path) -> None:
    tunnels = open_dataset(folder, "train")
    for tunnel in tunnels:
        read_shard(tunnel.path)
    read_place_data(tunnels)
    read_sphere_data(tunnels)
    pairs = ChangePairs(tunnels)
    pairs[0]


def _dataset(folder: Path) -> None:
    _shards(folder)
    (folder / "index.csv").unlink()
    about = {"family": "smoke/one_box", "seed": 3, "digest": "d", "reason": "too narrow"}
    (folder / "smoke__one_box-3.safetensors.refused.json").write_text(json.dumps(about))
    document = {"format": FORMAT, "format_version": FORMAT_VERSION, "recipe": Recipe().document(), "commands": ["c"]}
    (folder / "dataset.json").write_text(json.dumps(document))


def _read_dataset(folder: Path) -> None:
    make_dataset(["smoke/one_box"], "1:4", Recipe(), folder, limit=0, command="c")


def _state(folder: Path) -> None:
    fit(_Task(), FitConfig(steps=2, validate_every=1), folder, "run", _ignore, _ignore)


def _read_state(folder: Path) -> None:
    fit(_Task(), FitConfig(steps=2, validate_every=1), folder, "run", _ignore, _ignore)


def _ignore(*_: object) -> None:
    pass


class _Task:
    """A network of three weights, for `cdpipe.training.fit.fit`."""

    def __init__(self) -> None:
        import torch  # noqa: PLC0415 - slow to load

        torch.manual_seed(0)
        self.network = torch.nn.Linear(2, 1)

    def losses(self, step: int) -> dict[str, Any]:
        return {"a": self.network.weight.square().sum()}

    def scores(self) -> dict[str, float]:
        return {"s": float(self.network.weight.detach().sum())}

    def finish(self) -> dict[str, float]:
        return {}


def _run(folder: Path) -> None:
    run = RunFolder(folder / "run")
    pair = run.pair("test", 7)
    pair.parent.mkdir(parents=True)
    _pair(pair)
    plan = {
        "scenarios": [{"family": "test", "seeds": [7]}],
        "methods": ["voxel-diff"],
        "report": ["regions", "objects", "surface"],
    }
    provenance = {"tool": "tunnelcd", "version": "0.1.0", "git_commit": "abc", "plan": plan, "command": ["run"]}
    write_json(run.path / "provenance.json", provenance | {"machine": {"cpu": "x"}, "packages": {"numpy": "2"}})
    truth = load_ground_truth(pair)
    for name in ("mine", "voxel-diff"):
        _answer(folder / "answer", by_returns=True)
        shutil.copytree(folder / "answer", run.answer("test", 7, name))
        identity = foreign_identity(run, "test", "7", name)
        write_json(
            run.cell("test", 7, name), cell_document(score_stored(truth, folder / "answer"), identity, NO_KEY, LAST)
        )
    write_tables(run)
    points = np.random.default_rng(4).normal(0, 5, (50, 3)).astype(np.float32)
    (run.path / "maps" / "test").mkdir(parents=True)
    np.savez(run.maps("test", 7), before_points=points, after_points=points)
    write_json(
        run.path / "blind.json", {"format": "tunnelcd-blind", "format_version": 1, "salt": "0" * 64, "pairs": {}}
    )
    record = Dropped(world="test", seed=8, scenario={}, files={}, digest="0" * 16, n_bytes=1)
    write_json(dropped_file(RunFolder(folder / "rows"), "test", 8), record.model_dump())
    for name in ("changes", "keyframes"):
        table = run.path / f"{name}.csv"
        table.with_name(f"{name}.csv.xz").write_bytes(lzma.compress(table.read_bytes(), preset=0))
    (run.path / "changes.csv").unlink()


def _read_cells(folder: Path) -> None:
    for path in list_dropped(RunFolder(folder / "rows")):
        read_dropped(path)
    write_tables(open_run_folder(folder / "run"))
    name_blindly(RunFolder(folder / "run"))


def _read_run(folder: Path) -> None:
    read_run(folder / "run")


def _read_page(folder: Path) -> None:
    write_page(folder / "run")


def _read_sides(folder: Path) -> None:
    compare_sides(read_side(f"{folder / 'run'}:mine"), read_side(f"{folder / 'run'}:voxel-diff"))


def _stages(folder: Path) -> None:
    arrays = {"points": np.zeros((5, 3)), "n": np.array(3), "a.return_offsets": np.arange(6)}
    (folder / "stages").mkdir()
    StageCache(folder / "stages").keep("merge-x", Kept(arrays, {"t_merge_s": 0.5}))


def _read_stages(folder: Path) -> None:
    StageCache(folder / "stages").find("merge-x")


def _studies(folder: Path) -> None:
    (folder / "rows.csv").write_text("data,steps,x\nd,5,1.0\nd,5,2.0\n")


def _read_studies(folder: Path) -> None:
    read_rows(folder / "rows.csv", {"data": "d", "steps": 5})
    read_table(folder / "rows.csv", "main")


def _merges(folder: Path) -> None:
    known = make_pose(yaw_pose(0.3)[:3, :3], (1.0, -2.0, 0.5))
    np.savetxt(folder / "known.txt", known)
    (folder / "known.json").write_text(json.dumps(known.tolist()))
    (folder / "answer.json").write_text(json.dumps({"format": "tunnelcd-answer", "before_T_after": known.tolist()}))
    write_alignment(folder / "merge.json", known, PathAlignment(np.zeros((2, 3)), np.stack([known, known])), "truth")


def _read_merges(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        read_known_merge(path)
        read_alignment(path)


def _submission(folder: Path) -> None:
    evaluator = Evaluator(folder)
    evaluator.evaluate()
    pack_submission(evaluator.run, "mine", folder / "mine.zip")
    with zipfile.ZipFile(folder / "mine.zip") as archive:
        archive.extractall(folder / "unpacked")
    shutil.rmtree(evaluator.run.path)


def _read_submission(folder: Path) -> None:
    read_submission(folder / "mine.zip")
    with zipfile.ZipFile(folder / "again.zip", "w") as archive:
        for path in sorted(path for path in (folder / "unpacked").rglob("*") if path.is_file()):
            archive.write(path, path.relative_to(folder / "unpacked"))
    write_leaderboard([read_submission(folder / "again.zip")], folder / "board.html", None)


def _release(folder: Path) -> None:
    for name in ("sessions/0123456789abcdef/before/a.npz", "truth/0123456789abcdef/truth/changes.json", "README.md"):
        (folder / "unpacked" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "unpacked" / name).write_text(name * 20)
    write_sums(folder / "unpacked")
    pack(folder / "unpacked", folder / "r.zip")


def _read_release(folder: Path) -> None:
    unpack_release(folder / "r.zip", folder / "pairs", with_truth=True)
    pack(folder / "unpacked", folder / "again.zip")
    unpack_release(folder / "again.zip", folder / "more")


def _osf(folder: Path) -> None:
    from tests.cdpipe import recordings  # noqa: PLC0415 - only where the vendor's SDK is installed

    info = recordings.info_of(recordings.SENSOR)
    made = recordings.frames(info, 2)
    for frame in made:
        frame.field("RANGE")[:, 16:] = 5000
        frame.field("SIGNAL")[:, 16:] = 90
        frame.field("REFLECTIVITY")[:, 16:] = 9
    recordings.write_frames(folder / "r.osf", info, made)


def _pcap(folder: Path) -> None:
    from tests.cdpipe import recordings  # noqa: PLC0415

    info = recordings.info_of(recordings.SENSOR)
    recordings.record(folder / "r.pcap", info, recordings.frames(info, 1))


def _read_recording(folder: Path) -> None:
    from cdpipe.io.ouster.captures import open_recording  # noqa: PLC0415

    (path,) = (path for path in folder.iterdir() if path.suffix in (".osf", ".pcap"))
    for _ in open_recording(path).revolutions():
        pass


def _foreign(write: str, suffix: str = "", **options: Any) -> Callable[[Path], object]:
    """Return what writes a recording with somebody else's library."""

    def make(folder: Path) -> None:
        from tests.cdpipe.io import foreign_files  # noqa: PLC0415 - only where the extra is installed

        made = foreign_files.drive(3, 40)
        getattr(foreign_files, write)(folder / f"r{suffix}", made, **options)
        if suffix == "":
            foreign_files.write_trajectory(folder / "r" / "poses.txt", made.stamps_s)

    return make


def _read_foreign(folder: Path) -> None:
    (path,) = folder.iterdir()
    for scan in open_session(path).scans():
        scan.points_sensor.sum()


def _trajectories(folder: Path) -> None:
    from tests.cdpipe.io import foreign_files  # noqa: PLC0415

    for kind in ("kitti", "csv"):
        foreign_files.write_trajectory(folder / f"t.{kind}", np.linspace(0.0, 2.0, 20), kind)
    (folder / "times.txt").write_text("".join(f"{0.1 * number:.3f}\n" for number in range(20)))


def _read_trajectories(folder: Path) -> None:
    for kind in ("kitti", "csv"):
        read_poses(folder / f"t.{kind}")
    read_times(folder / "times.txt")


def _read_sessions(folder: Path) -> None:
    for scan in open_session(folder / "s").scans():
        scan.points_sensor.sum()


def _read_plys(folder: Path) -> None:
    for path in sorted(folder.glob("*.ply")):
        read_ply_points(path)
    for scan in open_session(folder).scans():
        scan.points_sensor.sum()


_PRESETS = tuple(f"cdpipe/methods/presets/{name}.yaml" for name in ("tunnelcd", "paper", "voxel-diff"))
_PLANS = tuple(f"eval/plans/shipped/{name}.yaml" for name in ("smoke", "regions", "merge"))
_FAMILIES = tuple(f"scenarios/families/{name}.yaml" for name in ("smoke/one_box", "network", "paper/site1"))


def _read_metadata(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        load_profile(str(path))


def _read_scored(folder: Path) -> None:
    score_stored(load_ground_truth(folder / "pair"), folder / "answer")


def _union(folder: Path) -> None:
    _run(folder)
    shutil.rmtree(folder / "answer")
    examples.add_twin(folder)


def _story(folder: Path) -> None:
    """Write the story of a scenario with a moved prop and two kinds of rock."""
    shutil.copy(ROOT / "scenarios" / "families" / "smoke" / "one_box.yaml", folder / "base.yaml")
    settings = ["surface=[{name: sinks, kind: heave}, {name: falls, kind: scar}]"]
    scenario = load_scenario(str(folder / "base.yaml"), 1, settings)
    (folder / "base.yaml").unlink()
    states = [
        SessionState(name=f"session-{number:02d}", plan="after", places={"box": where}, shares=shares)
        for number, where, shares in (
            (1, "absent", {"sinks": 0.0, "falls": 0.0}),
            (2, "after", {"sinks": 0.4, "falls": 1.0}),
            (3, "after", {"sinks": 1.0, "falls": 1.0}),
        )
    ]
    story = Story(scenario=scenario, seed=1, sessions=states, files={}, digests={}, versions={"numpy": "2.2"})
    (folder / "story.json").write_text(json.dumps(dump_story(story), indent=1))


_SESSION = ("s/session.json", "s/odometry.npz", "s/chunks/00000.npz")
_TRUTH = ("pair/truth/*", "pair/before/truth/*", "pair/before/truth/surface/*", "pair/*/session.json")
_CELLS = ("run/cells/*/*/*.json", "run/provenance.json", "run/blind.json", "rows/*/*/*")
_TABLES = ("run/results.csv", "run/*.csv.xz", "run/regions.csv", "run/provenance.json")
_PAGE = ("run/*.csv", "run/*.csv.xz", "run/provenance.json", "run/maps/test/7.npz", "run/answers/*/*/*/*")
_UNION = ("twin/cells/*/*/*.json", "twin/answers/*/*/*/*", "twin/provenance.json")
_EVALUATED = ("run/evaluations/*/*.json", "run/evaluations/*/*/*.json", "run/cells/*/*/*.json", "run/results.csv")
_STORY = ("out/*", "out/*/*/answer.*")
_SHARDS = ("*.safetensors", "index.csv")
# The shares follow the time that a reader takes: 0.5 ms to 3 s an input.
READERS: tuple[Reader, ...] = (
    Reader("session folder", _session, _read_sessions, _SESSION, 3.0, lines=True),
    Reader("PLY scans and trajectory", _scans, _read_plys, ("*.ply", "*.txt"), 2.0),
    Reader("TUM trajectory", _tum, _read_tum, ("t.tum",), 1.5),
    Reader("sensor metadata", _metadata, _read_metadata, ("*.json",), 1.5),
    Reader("truth of a pair", _truth, _read_truth, _TRUTH, 0.7, lines=True),
    Reader("story", _story, read_story, ("story.json",), 1.0, lines=True),
    Reader("compared sessions", examples.make_comparisons, examples.read_comparisons, _STORY, 0.5, lines=True),
    Reader("answer", _answer, read_answer, ("answer.json", "answer.npz"), 4.0, lines=True),
    Reader("answer, scored", _scored, _read_scored, ("answer/*",), 1.5, lines=True),
    Reader("known merge", _merges, _read_merges, ("*",), 0.7, lines=True),
    Reader("submission", _submission, _read_submission, ("mine.zip", "unpacked/submission.json"), 0.05, lines=True),
    Reader("release", _release, _read_release, ("r.zip", "unpacked/SHA256SUMS"), 0.4, lines=True),
    Reader("preset", _copy(*_PRESETS), _read_presets, ("*.yaml",), 2.0, lines=True),
    Reader("plan", _copy(*_PLANS), _read_plans, ("*.yaml",), 0.3, lines=True),
    Reader("scenario", _copy(*_FAMILIES), _read_families, ("*.yaml",), 0.4, lines=True),
    Reader("settings of --set", _settings, _read_settings, ("settings.txt",), 1.0, lines=True),
    Reader("foreign mesh", _meshes, _read_meshes, ("*",), 1.5),
    Reader("prop on the search path", _props, _read_props, ("props/my_skip.yaml", "props/m.obj"), 1.0, lines=True),
    Reader("descriptors", _descriptors, _read_descriptors, ("s/descriptors/*.npz",), 1.5),
    Reader("training shards and index", _shards, _read_shards, _SHARDS, 2.0),
    Reader("dataset folder", _dataset, _read_dataset, ("*.json", "*.safetensors"), 0.4),
    Reader("training state", _state, _read_state, ("state.safetensors",), 1.5),
    Reader("cells and provenance", _run, _read_cells, _CELLS, 0.1, lines=True),
    Reader("tables of a run", _run, _read_run, _TABLES, 0.4),
    Reader("page of a run", _run, _read_page, _PAGE, 0.02, lines=True),
    Reader("compared runs", _run, _read_sides, ("run/results.csv", "run/*.xz"), 0.05),
    Reader("stored stages", _stages, _read_stages, ("stages/*.npz",), 1.5),
    Reader("tables of studies", _studies, _read_studies, ("rows.csv",), 1.5),
    Reader("KITTI and CSV trajectories", _trajectories, _read_trajectories, ("*",), 1.0),
    Reader("KITTI scans", _foreign("write_kitti", "k"), _read_foreign, ("rk/velodyne/*", "rk/*.txt"), 1.0),
    Reader("PCD scans", _foreign("write_pcds"), _read_foreign, ("r/*",), 0.1, extra="pypcd4"),
    Reader("LAZ scans", _foreign("write_lases"), _read_foreign, ("r/*",), 0.1, extra="laspy"),
    Reader("E57", _foreign("write_e57", ".e57"), _read_foreign, ("r.e57",), 0.1, extra="pye57"),
    Reader("ROS 1 bag", _foreign("write_bag", ".bag"), _read_foreign, ("r.bag",), 0.1, extra="rosbags"),
    Reader("ROS 2 bag", _foreign("write_bag", "2"), _read_foreign, ("r2/*",), 0.1, extra="rosbags"),
    Reader("MCAP", _foreign("write_bag", ".mcap", compression=None), _read_foreign, ("r.mcap",), 0.1, extra="mcap"),
    Reader("worlds that move", examples.make_worlds, examples.read_worlds, ("*.yaml",), 0.2, lines=True),
    Reader("props to graft", examples.make_objects, examples.read_objects, ("*.yaml",), 0.5, lines=True),
    Reader("files on the search path", examples.make_search_path, examples.read_search_path, ("*/*",), 0.3, lines=True),
    Reader("tables of bench", examples.make_bench_tables, examples.read_bench_tables, ("*.json",), 1.0),
    Reader("weights", examples.make_weights, examples.read_all_weights, ("*",), 0.3),
    Reader("united runs", _union, examples.read_union, _UNION, 0.1, lines=True),
    Reader("evaluated method", examples.make_evaluation, examples.read_evaluated, _EVALUATED, 0.3, lines=True),
    Reader("answer on its maps", _scored, examples.read_answer_page, ("answer/*",), 0.1, lines=True),
    Reader("whole map", examples.make_map, examples.read_map, ("m.ply",), 0.2),
    Reader("mesh to trace", examples.make_drift, examples.read_drift, ("*",), 0.02),
    Reader("pages and index of reports", examples.make_pages, examples.read_pages, ("reports/*", "reports/*/*"), 0.5),
    Reader(
        "content of a release", examples.make_release_content, examples.read_release_content, ("*",), 0.3, lines=True
    ),
    Reader("table in Parquet", examples.make_parquet, examples.read_parquet_table, ("*/*",), 0.02, extra="pyarrow"),
    Reader("OSF", _osf, _read_recording, ("r.osf",), 0.2, extra="ouster"),
    Reader("PCAP and metadata", _pcap, _read_recording, ("r.pcap", "r.json"), 0.15, extra="ouster"),
)
