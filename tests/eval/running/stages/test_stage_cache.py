"""What a pair's stages gave is found again by content, and gives the same answers wherever it was found."""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from torch import nn

from cdpipe.core.errors import InputError, MergeFailedError
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.network import make_untrained_network
from cdpipe.descriptors.sphere_network import make_untrained_sphere_network
from cdpipe.descriptors.weights_file import numbered_checkpoint_bytes
from cdpipe.methods import descriptor
from cdpipe.model.alignment import PathAlignment
from cdpipe.model.config import PipelineConfig, RegionsConfig, load_config
from cdpipe.model.report import ChangeRegions
from cdpipe.model.types import DescriptorSet, KeyframeViews, MergedMaps, PointMap
from cdpipe.pipeline import Hooks, Stage, detect_changes, detection, map_pair, mapping
from eval.plans.plan import load_plan
from eval.running.pair_run import Tools
from eval.running.runfolder import RunFolder, start_run_folder
from eval.running.runner import run_plan
from eval.running.stages import pair_stages, stage_cache, stage_results
from eval.running.stages.pair_stages import PairStages
from eval.running.stages.stage_cache import Kept, StageCache, open_cache, session_digest
from eval.running.stages.stage_results import is_kept, name_result, pack, unpack
from eval.truth.adapters import pipeline_input
from scenarios.library import load_scenario
from scenarios.schema import Scenario

SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")
STAGES = ("build_map", "describe_scans", "describe_map", "merge_maps", "find_regions")
VARIANTS = {
    "paper-paired": ["query.n_regions=3"],
    "tunnelcd": ["query.n_regions=2"],
    "tunnelcd voxel": ["query.n_regions=2", "extract.method=voxel"],
    "voxel-diff": ["query.n_regions=2"],
}


def config_of(variant: str, *settings: str) -> PipelineConfig:
    return load_config(variant.split(maxsplit=1)[0], [*VARIANTS[variant], *settings])


def assert_same(one: Any, other: Any) -> None:
    """Bit by bit, and of the same types; seconds apart."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for each in fields(one):
            if each.name != "seconds":
                assert_same(getattr(one, each.name), getattr(other, each.name))
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape, one.flags.f_contiguous) == (other.dtype, other.shape, other.flags.f_contiguous)
        assert one.tobytes("A") == other.tobytes("A")
    elif isinstance(one, Mapping):
        assert list(one) == list(other)
        assert_same(list(one.values()), list(other.values()))
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for mine, its in zip(one, other, strict=True):
            assert_same(mine, its)
    else:
        assert one == other or (one != one and other != other)


@pytest.fixture(scope="module")
def pair(simulated_once: Callable[[Scenario, int], Path]) -> Path:
    return simulated_once(load_scenario("smoke/one_box", 20000, SMALL), 20000)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts how often each stage runs."""
    counted: Counter[str] = Counter()

    def counting(where: ModuleType, name: str) -> Callable[..., Any]:
        usual = getattr(where, name)

        def call(*args: Any, **settings: Any) -> Any:
            counted[name] += 1
            return usual(*args, **settings)

        return call

    places = {"find_regions": descriptor, "merge_maps": detection}
    for name in STAGES:
        where = places.get(name, mapping)
        monkeypatch.setattr(where, name, counting(where, name))
    return counted


def stages_of(pair: Path, folder: Path | None = None, *, is_shared: bool = True) -> PairStages:
    """Stages as a new process would open them; among workers, so that nothing is repeated for the clock."""
    cache = StageCache() if folder is None else open_cache(folder, (pair / "before", pair / "after"))
    return PairStages(pipeline_input(pair, "before"), pipeline_input(pair, "after"), cache=cache, is_shared=is_shared)


def test_answers_are_equal_cold_from_memory_and_from_disk(pair: Path, tmp_path: Path, calls: Counter[str]) -> None:
    cold = {name: stages_of(pair).answer(config_of(name)) for name in ("paper-paired", "tunnelcd voxel")}
    assert all(report.objects for report in cold.values())
    calls.clear()
    storing = stages_of(pair, tmp_path)
    first = {name: storing.answer(config_of(name)) for name in VARIANTS}
    # both sessions, and one keyframe to warm up, as recorded and without dust; maps of raw and of consistent poses;
    # merges that are not refined and that are; two queries alike
    assert calls == {"build_map": 4, "describe_scans": 6, "describe_map": 3, "merge_maps": 2, "find_regions": 2}
    calls.clear()
    from_memory = {name: storing.answer(config_of(name)) for name in VARIANTS}
    later = stages_of(pair, tmp_path)
    from_disk = {name: later.answer(config_of(name)) for name in VARIANTS}
    assert not calls
    for again in (cold, from_memory, from_disk):
        for name, report in again.items():
            assert_same(report, first[name])


def test_the_query_and_the_extraction_apart_are_the_comparison_of_the_pipeline(pair: Path) -> None:
    config = config_of("tunnelcd")
    here = stages_of(pair)
    sources = [pipeline_input(pair, name) for name in ("before", "after")]
    whole = detect_changes(*map_pair(sources, config, Hooks()).value, config)
    parts = here.answer(config)
    assert_same(whole.regions, parts.regions)
    assert_same(whole.objects, parts.objects)
    assert_same(whole.figures, parts.figures)


@pytest.mark.parametrize(
    ("setting", "run_again"),
    [
        ("extract.voxel_m=0.3", set()),
        ("extract.method=voxel", set()),
        ("cluster.min_points=8", set()),
        ("query.radius_m=3", {"find_regions"}),
        ("query.threshold=0.5", {"find_regions"}),
        ("merge.refine=none", {"merge_maps", "find_regions"}),
        ("descriptor.precision=int8", {"describe_map", "find_regions"}),
        ("map.voxel_m=0.3", {"build_map", "describe_map", "merge_maps", "find_regions"}),
        ("map.keyframe_spacing_m=2", set(STAGES)),
    ],
)
def test_a_later_process_runs_what_reads_the_setting(
    pair: Path, kept: Path, calls: Counter[str], setting: str, run_again: set[str]
) -> None:
    stages_of(pair, kept).answer(config_of("tunnelcd", setting))
    assert set(calls) == run_again


@pytest.fixture
def kept(pair: Path, lasting: Path, tmp_path: Path) -> Path:
    """A folder in which `tunnelcd` was run."""
    shutil.copytree(lasting, tmp_path / "kept")
    return tmp_path / "kept"


@pytest.fixture(scope="module")
def lasting(pair: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lasting") / "stages"
    stages_of(pair, folder).answer(config_of("tunnelcd"))
    return folder


def test_a_damaged_file_is_computed_again(pair: Path, kept: Path, calls: Counter[str]) -> None:
    whole = stages_of(pair, kept).answer(config_of("tunnelcd"))
    (merge,) = kept.glob("*/merge-*.npz")
    (regions,) = kept.glob("*/regions-*.npz")
    (maps,) = kept.glob("*/maps-*.npz")
    merge.write_bytes(merge.read_bytes()[:-40])
    content = bytearray(regions.read_bytes())
    middle = slice(len(content) // 2, len(content) // 2 + 64)  # longer than a header without a checksum
    content[middle] = bytes(byte ^ 1 for byte in content[middle])
    regions.write_bytes(content)
    maps.write_bytes(b"")
    calls.clear()
    assert_same(stages_of(pair, kept).answer(config_of("tunnelcd")), whole)
    assert set(calls) == {"build_map", "merge_maps", "find_regions"}
    calls.clear()
    stages_of(pair, kept).answer(config_of("tunnelcd"))
    assert not calls


def test_what_is_of_other_sessions_or_other_code_is_not_found(
    pair: Path, kept: Path, tmp_path: Path, calls: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    shutil.copytree(pair, other)
    (other / "after" / "truth" / "poses.npz").write_bytes(b"the stages do not read the truth")
    stages_of(other, kept).answer(config_of("tunnelcd"))
    assert not calls
    chunk = next((other / "after" / "chunks").iterdir())
    shutil.copy(next((other / "before" / "chunks").iterdir()), chunk)
    before = set(kept.glob("*/*"))
    open_cache(kept, (other / "before", other / "after")).keep("merge-0", Kept({}))
    assert len(before) == 5
    assert [path.name for path in kept.glob("*/*")] == ["merge-0.npz"]
    monkeypatch.setattr(stage_cache, "CODE", "newer")
    assert open_cache(kept, (other / "before", other / "after")).find("merge-0") is None
    assert not list(kept.glob("*/*"))


def test_times_and_whether_they_were_shared_belong_to_the_stage(pair: Path, tmp_path: Path) -> None:
    paired, alone = config_of("paper-paired"), config_of("paper-paired", "merge.refine=local")
    shared = stages_of(pair, tmp_path, is_shared=True)
    of_worker = shared.answer(paired)
    assert shared.is_contended
    later = stages_of(pair, tmp_path, is_shared=False)
    again = later.answer(config_of("paper-paired", "extract.voxel_m=0.3"))
    measured = ("t_cd_s", "t_descriptor_s", "t_index_s", "t_merge_s", "t_refine_s")
    assert [again.seconds[name] for name in measured] == [of_worker.seconds[name] for name in measured]
    assert again.seconds["t_oe_s"] != of_worker.seconds["t_oe_s"]
    assert later.is_contended
    # its descriptors' seconds are a worker's, and these are no part of what a rival took
    later.answer(alone)
    assert later.is_contended
    later.answer(config_of("voxel-diff"))
    assert not later.is_contended
    with pytest.raises(MergeFailedError):
        later.answer(config_of("paper-paired", "merge.min_agreement=1", "merge.fallback=false"))
    assert not later.is_contended


@pytest.mark.parametrize(("is_shared", "n_calls"), [(True, 1), (False, 1 + pair_stages.REPEATS)])
def test_workers_call_a_stage_once_and_a_run_alone_repeats_it(
    pair: Path, calls: Counter[str], monkeypatch: pytest.MonkeyPatch, is_shared: bool, n_calls: int
) -> None:
    monkeypatch.setattr(pair_stages, "REPEAT_BELOW_S", np.inf)  # as if no stage took a second
    stages = stages_of(pair, is_shared=is_shared)
    for voxel_m in (0.3, 0.4, 0.5):  # settings that both stages do not read
        stages.answer(config_of("tunnelcd voxel", f"extract.voxel_m={voxel_m}"))
    assert (calls["merge_maps"], calls["find_regions"]) == (n_calls, n_calls)


@pytest.fixture
def run(pair: Path, tmp_path: Path) -> Callable[..., RunFolder]:
    """Run `tunnelcd` with a voxel on a copy of the pair, as the command does."""

    def copy(scenario: Scenario, seed: int, out: Path, on_stage: object) -> None:
        shutil.copytree(pair, out)

    tools = Tools(draw=lambda name, seed, settings: load_scenario(name, seed, SMALL), simulate=copy)

    def start(voxel_m: float, **options: Any) -> RunFolder:
        plan = tmp_path / "plan.yaml"
        of_variant = f"{{preset: tunnelcd, set: [query.n_regions=2, extract.method=voxel, extract.voxel_m={voxel_m}]}}"
        plan.write_text(f"name: test\nscenarios: [smoke/one_box]\nseeds: [20000]\nvariants: [{of_variant}]\n")
        folder = start_run_folder(tmp_path / "run")
        run_plan(load_plan(str(plan)), folder, tools=tools, **options)
        return folder

    return start


def test_a_finished_folder_run_with_another_voxel(run: Callable[..., RunFolder], calls: Counter[str]) -> None:
    folder = run(0.65)
    assert set(calls) == set(STAGES)
    calls.clear()
    run(0.4)
    assert not calls
    rows = [json.loads(path.read_text())["row"] for path in sorted(folder.path.glob("cells/*/*/*.json"))]
    assert len(rows) == 2
    assert rows[0]["t_cd_s"] == rows[1]["t_cd_s"]
    assert [row["is_contended"] for row in rows] == [False, False]
    run(0.4, force=True)
    assert set(calls) == set(STAGES)


def some_map(draw: np.random.Generator, **options: Any) -> PointMap:
    n_scans, n_points, n_returns = 3, 5, 40
    pixels = np.concatenate([np.sort(draw.choice(65536, n, replace=False)) for n in (10, 0, 30)])
    return PointMap(
        points=draw.normal(size=(n_points, 3)),
        nearest_m=draw.random(n_points, dtype=np.float32),
        voxel_m=0.2,
        odom_T_sensor=np.stack([np.eye(4)] * n_scans),
        keyframe_scans=np.array([0, 2]),
        return_points=draw.integers(0, n_points, n_returns, dtype=np.int32),
        return_pixels=pixels.astype(np.int32),
        scan_offsets=np.array([0, 10, 10, 40]),
        **options,
    )


def test_results_come_back_as_they_went(tmp_path: Path) -> None:
    folder = tmp_path / "world" / "0" / "root"
    draw = np.random.default_rng(0)
    views = KeyframeViews(draw.random((2, 4, 6)).astype(np.float16), np.stack([np.eye(4)] * 2))
    full = some_map(
        draw,
        seen_from=draw.random((5, 3), dtype=np.float32),
        return_offsets=draw.integers(0, 256, (40, 3), dtype=np.uint8),
        views=views,
    )
    maps = full, some_map(draw)
    described = tuple(
        DescriptorSet(draw.random((2, 3), dtype=np.float32), w, np.array([0, 2]), "3deg", "a digest")
        for w in (None, draw.random((2, 3), dtype=np.float32))
    )
    spheres = draw.random((2, 3), dtype=np.float32), draw.integers(-9, 9, (2, 3), dtype=np.int8)
    local = PathAlignment(np.zeros((2, 3)), np.stack([np.eye(4)] * 2))
    merges = [
        MergedMaps(*maps, np.eye(4), {"overlap": 0.5, "agreement": float("nan")}, True, "", local, {"t_merge_s": 2.0}),
        MergedMaps(*maps, np.eye(4), {}, False, "too few places", None, {"t_merge_s": 2.0}),
    ]
    regions = [
        ChangeRegions(np.ones((2, 3)), 4.5, np.array([2.0, 1.0]), np.ones((2, 2), int), np.ones(2, bool), np.ones(1)),
        ChangeRegions(np.ones((0, 3)), 4.5, np.ones(0), np.ones((0, 2), int), np.ones(0, bool), np.full(2, np.nan)),
        ChangeRegions(
            np.ones((2, 3)), np.array([10.0, 4.5]), np.ones(2), np.ones((2, 2), int), np.ones(2, bool), np.ones(1)
        ),
    ]
    StageCache(folder).keep("maps-0", Kept(pack("maps", maps), {"t_merge_s": 2.0}, True))
    given = {
        "descriptors": pack("descriptors", described),
        "spheres": pack("spheres", spheres),
        **{f"merge-{i}": pack("merge", merged) for i, merged in enumerate(merges)},
        **{f"regions-{i}": pack("regions", each) for i, each in enumerate(regions)},
    }
    for name, arrays in given.items():
        StageCache(folder).keep(name, Kept(arrays))
    later = StageCache(folder)
    found = later.find("maps-0")
    assert found is not None
    assert (found.seconds, found.is_contended) == ({"t_merge_s": 2.0}, True)
    assert_same(unpack("maps", found.arrays), maps)
    back = {name: each.arrays for name in given if (each := later.find(name)) is not None}
    assert_same(unpack("descriptors", back["descriptors"]), described)
    assert_same(unpack("spheres", back["spheres"]), spheres)
    for i in (0, 1):
        assert_same(unpack("merge", back[f"merge-{i}"], maps), replace(merges[i], seconds={}))
        assert_same(unpack("regions", back[f"regions-{i}"]), regions[i])


def test_no_damage_goes_unnoticed(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    arrays = {"q": draw.random((4, 3)), "before.return_offsets": draw.integers(0, 255, 60, dtype=np.uint8)}
    StageCache(tmp_path).keep("merge-0", Kept(arrays, {"t_merge_s": 1.5}))
    (path,) = tmp_path.iterdir()
    content = path.read_bytes()
    places = range(len(content))
    flipped = [content[:i] + bytes([content[i] ^ bit]) + content[i + 1 :] for i in places for bit in (1, 64)]
    damaged = [*flipped, *(content[:end] for end in places[::9])]
    n_found = 0
    for each in damaged:
        path.write_bytes(each)
        found = StageCache(tmp_path).find("merge-0")
        if found is not None:  # a bit of a date, or of an attribute, says nothing
            n_found += 1
            assert_same(dict(found.arrays), arrays)
            assert (dict(found.seconds), found.is_contended) == ({"t_merge_s": 1.5}, False)
    assert n_found < len(damaged) / 3


def test_a_disk_that_takes_nothing_costs_only_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    cache = StageCache(tmp_path)
    cache.keep("merge-0", Kept({"q": np.ones(3)}))
    assert cache.find("merge-0") is not None
    assert list(tmp_path.iterdir()) == []


def test_a_run_stores_maps_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_cache, "MAPS_BYTES", 5000)
    noise = {"before.return_offsets": np.random.default_rng(0).integers(0, 255, 3000, dtype=np.uint8)}
    for seed in range(4):
        cache = StageCache(tmp_path / "world" / str(seed) / "root")
        cache.keep("maps-0", Kept(noise))
        cache.keep("merge-0", Kept(noise))
        # what fills gigabytes is not held twice
        assert cache.find("maps-0") is None or cache.find("maps-0") is not cache.find("maps-0")
    assert sorted(path.parts[-3] for path in tmp_path.rglob("maps-*")) == ["0", "1"]
    assert len(list(tmp_path.rglob("merge-*"))) == 4


def test_maps_that_another_process_removes_meanwhile_do_not_count(tmp_path: Path) -> None:
    beside = tmp_path / "world" / "0" / "root"
    beside.mkdir(parents=True)
    (beside / "maps-0.npz").symlink_to("removed")
    cache = StageCache(tmp_path / "world" / "1" / "root")
    cache.keep("maps-0", Kept({"points": np.zeros((2, 3))}))
    assert cache.find("maps-0") is not None


def test_weights_are_part_of_what_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_of("tunnelcd")

    def names() -> list[str]:
        stages: tuple[Stage, ...] = ("descriptors", "spheres", "merge", "regions")
        return [name_result(stage, config) for stage in stages]

    usual = names()
    monkeypatch.setattr(stage_results, "sphere_digest", lambda *_: "other")
    of_spheres = names()
    assert [mine == its for mine, its in zip(usual, of_spheres, strict=True)] == [True, False, True, False]
    monkeypatch.setattr(stage_results, "checkpoint_digest", lambda _: "other")
    assert not set(names()) & set(usual)


def test_files_of_weights_are_told_apart_by_what_they_hold(tmp_path: Path) -> None:
    make: dict[str, Callable[[int], nn.Module]] = {
        "descriptor": make_untrained_network,
        "sphere": make_untrained_sphere_network,
        "range_net": make_untrained_change_network,
    }

    def name(stage: Stage, key: str, seed: int, file: str) -> str:
        (tmp_path / file).write_bytes(numbered_checkpoint_bytes(make[key](seed)))
        return name_result(stage, load_config(preset_of(key), [f"{key}.weights={tmp_path / file}"]))

    def preset_of(key: str) -> str:
        return "range-net" if key == "range_net" else "tunnelcd"

    read: tuple[tuple[Stage, str], ...] = (
        ("descriptors", "descriptor"),
        ("merge", "descriptor"),
        ("spheres", "sphere"),
        ("regions", "sphere"),
        ("regions", "range_net"),
    )
    for stage, key in read:
        one, other, moved = name(stage, key, 1, "a"), name(stage, key, 2, "a"), name(stage, key, 1, "b")
        assert one == moved != other
        assert name_result(stage, load_config(preset_of(key))) not in (one, other)


@pytest.mark.parametrize(
    ("preset", "setting", "is_read"),
    [
        ("m3c2", "m3c2.distance_m=0.2", True),
        ("m3c2", "m3c2.normal_m=2", True),
        ("dufomap", "dufomap.every_scan=2", True),
        ("removert", "removert.margin=0.07", True),
        ("octomap", "octomap.voxel_m=0.4", True),
        ("m3c2-ep", "m3c2_ep.range_m=0.1", True),
        ("m3c2-ep", "m3c2.normal_m=2.2", True),
        ("erasor", "erasor.scan_ratio=0.3", True),
        ("voxel-diff", "voxel_diff.voxel_m=0.4", True),
        ("range-net", "range_net.threshold=0.6", True),
        ("range-net", "range_net.depth_m=0.4", True),
        ("voxel-diff", "outlier.sigmas=3", True),
        ("c2c", "c2c.distance_m=0.4", True),
        ("c2c", "regions.min_points=9", True),
        ("c2c", "cluster.radius_m=0.4", True),
        # the rules read these, so all rules have the same regions
        ("c2c", "cluster.min_points=9", False),
        ("voxel-diff", "extract.voxel_m=0.4", False),
        ("c2c", "extract.method=voxel", False),
        ("c2c", "extract.withdraw=false", False),
        ("c2c", "regions.source=m3c2", True),
        ("tunnelcd", "extract.voxel_m=0.4", False),
        ("tunnelcd", "regions.source=every-keyframe", True),
    ],
)
def test_regions_are_named_by_what_their_source_reads(preset: str, setting: str, is_read: bool) -> None:
    names = {name_result("regions", load_config(preset, settings)) for settings in ((), (setting,))}
    assert len(names) == 1 + is_read


def test_regions_of_plugins_are_not_kept() -> None:
    config = load_config("c2c")
    assert is_kept("regions", config)
    of_others = config.model_copy(update={"regions": RegionsConfig.model_construct(source="higher")})
    assert not is_kept("regions", of_others)
    assert is_kept("merge", of_others)


def test_a_huge_file_without_content_is_not_read(tmp_path: Path) -> None:
    (chunk := tmp_path / "chunks" / "00000.npz").parent.mkdir()
    with chunk.open("wb") as file:
        file.truncate(1 << 40)  # an hour
    with pytest.raises(InputError, match=r"00000\.npz: 1099512 MB, more than the 2147 MB it may have"):
        session_digest(tmp_path)
