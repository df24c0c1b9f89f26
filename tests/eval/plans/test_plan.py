import textwrap
from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.names import path_part
from cdpipe.model.config import load_config
from eval.plans import plan as plan_module
from eval.plans.cells import expand_cells, explain_unread_settings, list_planned_cases
from eval.plans.changes import change_plan
from eval.plans.files import plan_names
from eval.plans.parts import require_valid_setting
from eval.plans.plan import Plan, load_plan
from eval.plans.seeds import parse_seeds
from eval.plans.targets import Targets
from eval.plans.variants import name_variant
from eval.plans.worlds import format_setting, require_draws, world_slug
from eval.running.runfolder import reported
from tests.eval.plans.shipped import cells_of, plan_of

PLAN = """\
name: two
scenarios: [smoke/one_box, smoke/unchanged]
seeds: "7:9"
variants:
  - preset: paper
    per_scenario: {smoke/unchanged: ["query.radius_m=10"]}
  - preset: tunnelcd
    set: ["extract.voxel_m=0.4"]
grid:
  - variant: tunnelcd
    scenarios: [smoke/one_box]
    keys: {extract.voxel_m: [0.2, 0.3], query.radius_m: [3, 4.5]}
"""


def written(folder: Path, text: str) -> str:
    path = folder / "plan.yaml"
    path.write_text(text)
    return str(path)


def read(folder: Path, text: str = PLAN) -> Plan:
    return load_plan(written(folder, text))


def mistakes(folder: Path, text: str) -> list[str]:
    with pytest.raises(InputError) as caught:
        read(folder, text)
    return [line.replace(f"{folder}/", "") for line in str(caught.value).splitlines()]


def test_cells_by_hand(tmp_path: Path) -> None:
    found = [(c.scenario, c.seed, c.preset, c.variant) for c in expand_cells(read(tmp_path))]
    grid = [
        "tunnelcd[extract.voxel_m=0.2,query.radius_m=3]",
        "tunnelcd[extract.voxel_m=0.2,query.radius_m=4.5]",
        "tunnelcd[extract.voxel_m=0.3,query.radius_m=3]",
        "tunnelcd[extract.voxel_m=0.3,query.radius_m=4.5]",
    ]
    plain = [("paper", "paper"), ("tunnelcd", "tunnelcd[extract.voxel_m=0.4]")]
    one_box = [*plain, *(("tunnelcd", name) for name in grid)]
    # 2 seeds x (2 variants + 2 x 2 grid points), then 2 seeds x 2 variants
    assert found == [
        *(("smoke/one_box", seed, *method) for seed in (7, 8) for method in one_box),
        *(("smoke/unchanged", seed, *method) for seed in (7, 8) for method in plain),
    ]


def test_settings_of_a_site_change_the_configuration_and_not_the_name(tmp_path: Path) -> None:
    paper = {c.scenario: c for c in expand_cells(read(tmp_path)) if c.preset == "paper"}
    assert {c.variant for c in paper.values()} == {"paper"}
    assert paper["smoke/one_box"].config.query.radius_m == 4.5
    assert paper["smoke/unchanged"].config.query.radius_m == 10


def test_wide_worlds_get_what_the_presets_say_of_them(tmp_path: Path) -> None:
    text = PLAN.replace('seeds: "7:9"', 'seeds: "7:9"\nwide: smoke/unchanged')
    text = text.replace("query.radius_m=10", "query.threshold=2").replace("[smoke/one_box]", "[smoke/unchanged]")
    found = {(c.scenario, c.variant): c.config.query for c in expand_cells(read(tmp_path, text))}
    wide = load_config("tunnelcd", site="wide").query
    assert found["smoke/unchanged", "tunnelcd[extract.voxel_m=0.4]"] == wide
    assert found["smoke/one_box", "tunnelcd[extract.voxel_m=0.4]"] == load_config("tunnelcd").query
    # what the plan says goes over it
    paper = found["smoke/unchanged", "paper"]
    assert (paper.radius_m, paper.threshold) == (10, 2)
    point = found["smoke/unchanged", "tunnelcd[extract.voxel_m=0.2,query.radius_m=3]"]
    assert (point.radius_m, point.threshold) == (3, wide.threshold)


def test_wide_names_worlds_of_the_plan_and_acts_after_the_merge(tmp_path: Path) -> None:
    text = PLAN.replace('seeds: "7:9"', 'seeds: "7:9"\nwide: [narrow]')
    (line,) = mistakes(tmp_path, text)
    assert line.startswith("plan.yaml:4: wide.0 = 'narrow': ")
    text = "{name: m, until: merge, scenarios: [narrow, wide], wide: [wide], seeds: [7], variants: [{preset: paper}]}"
    (line,) = mistakes(tmp_path, text)
    assert line.startswith("plan.yaml:1: wide = 'wide': ")


def test_a_preset_that_says_nothing_of_wide_worlds_is_told(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("query: {radius_m: 3}\n")
    text = f"{{name: m, scenarios: [wide], wide: [wide], seeds: [7], variants: [{{preset: {tmp_path}/mine.yaml}}]}}"
    with pytest.raises(InputError, match=r"mine\.yaml: wide: missing"):
        expand_cells(read(tmp_path, text))


def test_grid_points_get_their_values(tmp_path: Path) -> None:
    config = {c.variant: c.config for c in expand_cells(read(tmp_path))}[
        "tunnelcd[extract.voxel_m=0.3,query.radius_m=3]"
    ]
    assert (config.extract.voxel_m, config.query.radius_m, config.regions.source) == (0.3, 3.0, "sphere")


def test_all_mistakes_of_a_plan_at_once_with_lines(tmp_path: Path) -> None:
    text = """\
name: bad
scenarios: [smoke/one_bx, smoke/unchanged]
seeds: 12
variants:
  - preset: papr
    set: ["query.radius=3", "extract.voxel_m=-1"]
  - presset: paper
grid:
  - variant: tunnelcd
    scenarios: [smoke/unchanged]
    keys: {extract.voxl_m: [0.2]}
speed: 3
"""
    lines = mistakes(tmp_path, text)
    expected = {
        2: ["smoke/one_bx", 'did you mean "smoke/one_box"?'],
        3: ["seeds = 12", '"A:B" in quotes'],
        5: ["'papr'", 'did you mean "paper"?'],
        6: ["query.radius", 'did you mean "query.radius_m"?'],
        7: ["presset", 'did you mean "preset"?'],
        11: ["extract.voxl_m", 'did you mean "extract.voxel_m"?'],
        12: ["speed = 3: unknown key"],
    }
    for line, words in expected.items():
        assert any(text.startswith(f"plan.yaml:{line}:") and all(w in text for w in words) for text in lines), (
            line,
            lines,
        )
    assert any("extract.voxel_m=-1" in line and "greater than" in line for line in lines)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[smoke/one_box, smoke/unchanged]", "[smoke/one_box, smoke/one_box, smoke/unchanged]", "twice"),
        ("{smoke/unchanged: [", "{unchanged/site1: [", "not in scenarios"),
        ("    scenarios: [smoke/one_box]", "    scenarios: [unchanged/site1]", "not in scenarios"),
        ("[0.2, 0.3]", "[0.2, 0.2]", "stands twice"),
        ("[0.2, 0.3]", "[]", "at least one is needed"),
    ],
)
def test_parts_that_do_not_fit(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in PLAN
    assert any(words in line for line in mistakes(tmp_path, PLAN.replace(old, new)))


def test_seeds_by_hand() -> None:
    assert parse_seeds("3:6") == (3, 4, 5)
    assert parse_seeds("7") == (7,)
    assert parse_seeds([900001, 0]) == (900001, 0)


@pytest.mark.parametrize(
    "value",
    ["6:6", "6:3", "-1:2", "a:b", "1:2:3", "", [], [1, 1], [-1], [1.5], [True], 12, None, f"0:{10**30}", "0:100001"],
)
def test_what_is_no_seeds(value: object) -> None:
    with pytest.raises(ValueError, match='expected "A:B"'):
        parse_seeds(value)


def test_names_and_slugs() -> None:
    assert name_variant("paper", ()) == "paper"
    assert name_variant("tunnelcd", ("a.b=0.3", "c=4")) == "tunnelcd[a.b=0.3,c=4]"
    assert path_part("tunnelcd[a.b=0.3,c=4]") == "tunnelcd_a.b=0.3,c=4_"
    assert name_variant("my/own.yaml", ()) == "own"
    assert world_slug("paper/site1") == "paper__site1"
    assert format_setting("query.n_regions", None) == "query.n_regions=null"
    assert format_setting("a.b", 4.5) == "a.b=4.5"


def test_command_line_replaces_seeds_and_sets_every_variant(tmp_path: Path) -> None:
    plan = change_plan(read(tmp_path), seeds="1:2", settings=["query.radius_m=6", "extract.voxel_m=0.5"])
    found = expand_cells(plan)
    assert {c.seed for c in found} == {1}
    # the command line wins over the plan's own set, over what it sets for a site, and over its grid
    assert {(c.config.query.radius_m, c.config.extract.voxel_m) for c in found} == {(6.0, 0.5)}
    assert {c.variant for c in found if c.scenario == "smoke/unchanged"} == {
        "paper[query.radius_m=6,extract.voxel_m=0.5]",
        "tunnelcd[query.radius_m=6,extract.voxel_m=0.5]",
    }


def test_presets_of_the_command_line_replace_the_plan_s_variants_and_grids(tmp_path: Path) -> None:
    plan = change_plan(read(tmp_path), presets=["c2c", "voxel-diff"], settings=["query.radius_m=6"])
    assert {c.variant for c in expand_cells(plan)} == {"c2c[query.radius_m=6]", "voxel-diff[query.radius_m=6]"}
    assert len(expand_cells(plan)) == 2 * 2 * 2
    # a preset alone keeps what the plan sets for it at a site; the plan's targets are about its own variants
    of_plan = {c.scenario: c.config for c in expand_cells(read(tmp_path)) if c.variant == "paper"}
    assert {c.scenario: c.config for c in expand_cells(change_plan(read(tmp_path), presets=["paper"]))} == of_plan
    assert change_plan(plan_of("main"), presets=["c2c"]).targets == Targets()
    with pytest.raises(InputError, match=r"voxel-dif.*voxel-diff"):
        change_plan(plan, presets=["voxel-dif"])


def test_every_wrong_value_of_a_grid_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"= 'x': input should be a valid number.*; extract\.voxel_m = -2: input should"
    ):
        change_plan(read(tmp_path), grid=["extract.voxel_m=0.3,x,-2"])


@pytest.mark.parametrize(
    ("settings", "grid"),
    [(["extract.voxel_m=0.65"], ["extract.voxel_m=0.3,0.5"]), ([], ["extract.voxel_m=0.3", "extract.voxel_m=0.5"])],
)
def test_a_grid_that_something_else_writes_over_is_refused(
    tmp_path: Path, settings: list[str], grid: list[str]
) -> None:
    with pytest.raises(InputError, match=r"--grid extract\.voxel_m: set twice"):
        change_plan(read(tmp_path), settings=settings, grid=grid)


def test_command_line_grid_is_a_product_over_the_variants(tmp_path: Path) -> None:
    text = PLAN.partition("grid:")[0]
    plan = change_plan(read(tmp_path, text), grid=["extract.voxel_m=0.1,0.2", "query.radius_m=3,5"])
    variants = [c.variant for c in expand_cells(plan) if (c.scenario, c.seed) == ("smoke/one_box", 7)]
    assert variants == [
        f"{preset}[extract.voxel_m={voxel},query.radius_m={radius}]"
        for preset in ("paper", "tunnelcd")
        for voxel in ("0.1", "0.2")
        for radius in ("3", "5")
    ]


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"seeds": "5:5"}, "--seeds 5:5"),
        ({"settings": ["query.radius=3"]}, 'did you mean "query.radius_m"?'),
        ({"settings": ["query.radius_m"]}, "expected key=value"),
        ({"grid": ["query.radius_m=3,,4"]}, "--grid"),
        ({"grid": ["query.radius_m=3,x"]}, "query.radius_m = 'x'"),
    ],
)
def test_mistakes_of_the_command_line(tmp_path: Path, kwargs: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match="--") as caught:
        change_plan(read(tmp_path), **kwargs)  # type: ignore[arg-type]
    assert words in str(caught.value)


def test_unchanged_plan_stays_equal(tmp_path: Path) -> None:
    plan = read(tmp_path)
    assert change_plan(plan) == plan


@pytest.mark.parametrize("name", plan_names())
def test_shipped_plans_are_valid(name: str) -> None:
    assert cells_of(name)


def test_paper_plan_holds_what_the_page_shows() -> None:
    found = cells_of("paper")
    presets = ["paper", "paper-topn", "paper-paired", "voxel-diff", "untrained", "random-regions", "tunnelcd"]
    for scenario in ("paper/site1", "paper/site2", "unchanged/site1"):
        plain = [c for c in found if c.scenario == scenario and "[" not in c.variant]
        assert sorted(c.variant for c in plain) == sorted(presets)
        told = {c.config.query.radius_m for c in plain if c.variant != "tunnelcd"}
        assert told == {10.0 if scenario == "paper/site2" else 4.5}
    grid = [c for c in found if "[" in c.variant]
    assert len({(c.config.extract.voxel_m, c.config.query.radius_m) for c in grid}) == len(grid) == 9
    assert {(c.scenario, c.preset) for c in grid} == {("paper/site1", "paper-paired")}


def test_unknown_plan_names_the_nearest() -> None:
    with pytest.raises(InputError, match='did you mean "smoke"'):
        load_plan("smok")


def test_a_plan_file_that_is_named_without_its_suffix_is_suggested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text("name: tiny\n")
    with pytest.raises(InputError, match=r'did you mean the file "tiny\.yaml"'):
        load_plan("tiny")


def test_the_example_of_the_documentation_is_a_plan(tmp_path: Path) -> None:
    documentation = plan_module.__doc__ or ""
    plan = read(tmp_path, textwrap.dedent(documentation.partition("\n\n")[2]))
    assert set(Plan.model_fields) - {"split"} == plan.model_fields_set  # that is for --split to write
    assert plan.seeds == (20000, 20001)
    # of each seed: one variant on both sites and on two more worlds of one, another and eight grid points on the other;
    # the variant and the grid points in the world of an axis
    assert len(expand_cells(plan)) == 2 * ((2 + 2) + 1 + 8 + (1 + 8))
    assert {cell.variant for cell in expand_cells(plan) if cell.preset == "paper"} == {"paper[extract.voxel_m=0.4]"}


CROSSED = """\
name: crossed
scenarios: [smoke/one_box, smoke/unchanged]
seeds: [7]
set: [merge.refine=checked, query.radius_m=6, extract.voxel_m=0.8]
thresholds: {"paper[extract.method=surface]": 0.25, tunnelcd: -1}
variants:
  - {preset: tunnelcd, set: []}
  - {preset: tunnelcd, oracle_merge: {}, oracle_regions: true}
grid:
  - variant: [paper, voxel-diff]
    each: [extract.method=surface, [extract.method=voxel, extract.voxel_m=0.3]]
"""


def test_presets_crossed_with_lists_of_settings(tmp_path: Path) -> None:
    cells = expand_cells(read(tmp_path, CROSSED))
    found = {cell.variant: cell.config for cell in cells}
    assert len(cells) == 2 * len(found)  # a grid without scenarios runs in all worlds
    assert list(found) == [
        "tunnelcd",
        "oracle-merge+oracle-regions",
        "paper[extract.method=surface]",
        "paper[extract.method=voxel,extract.voxel_m=0.3]",
        "voxel-diff[extract.method=surface]",
        "voxel-diff[extract.method=voxel,extract.voxel_m=0.3]",
    ]
    # settings of the plan go over the preset's, and under the variant's own
    assert {config.query.radius_m for config in found.values()} == {6.0}
    assert [config.extract.voxel_m for config in found.values()] == [0.8, 0.8, 0.8, 0.3, 0.8, 0.3]
    assert found["paper[extract.method=surface]"].merge.refine == "checked"
    # a threshold belongs to its own method alone
    assert found["paper[extract.method=surface]"].query.threshold == 0.25
    assert found["tunnelcd"].query.threshold == -1
    assert found["voxel-diff[extract.method=surface]"].query.threshold == load_config("voxel-diff").query.threshold
    # the truth needs no merge
    assert found["oracle-merge+oracle-regions"].merge.refine == load_config("tunnelcd").merge.refine


def test_thresholds_belong_to_methods_that_the_plan_runs_as_they_are(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, CROSSED.replace('"paper[extract.method=surface]": 0.25', '"papr": 1'))
    assert line.startswith("plan.yaml:5: thresholds.papr = '1.0': ") and "is called papr" in line
    (line,) = mistakes(tmp_path, CROSSED.replace("tunnelcd: -1", "oracle-merge+oracle-regions: 1"))
    assert "is called oracle-merge+oracle-regions" in line
    own = CROSSED.replace("set: []", "set: query.threshold=5").replace(
        "tunnelcd: -1", '"tunnelcd[query.threshold=5]": 3'
    )
    (line,) = mistakes(tmp_path, own)
    assert "tunnelcd[query.threshold=5] has a threshold of its own" in line
    for options in ({"settings": ["map.voxel_m=0.3"]}, {"grid": ["map.voxel_m=0.1,0.2"]}):
        with pytest.raises(InputError, match=r"plan crossed holds a threshold for each of its methods"):
            change_plan(read(tmp_path, CROSSED), **options)  # type: ignore[arg-type]
    changed = change_plan(read(tmp_path, CROSSED), presets=["c2c"])
    assert {cell.variant for cell in expand_cells(changed)} == {"c2c"}


def test_settings_of_the_command_line_replace_those_of_each(tmp_path: Path) -> None:
    text = CROSSED.replace('thresholds: {"paper[extract.method=surface]": 0.25, tunnelcd: -1}\n', "")
    cells = expand_cells(change_plan(read(tmp_path, text), settings=["extract.method=nearest"]))
    of_grid = [cell.variant for cell in cells if cell.preset == "paper" and cell.scenario == "smoke/unchanged"]
    assert of_grid == ["paper[extract.method=nearest]", "paper[extract.voxel_m=0.3,extract.method=nearest]"]
    (line,) = mistakes(tmp_path, text + "    keys: {extract.voxel_m: [0.2]}\n")
    assert "extract.voxel_m stands in keys and in each" in line


def test_a_plan_that_was_written_down_is_the_same_plan(tmp_path: Path) -> None:
    plan = read(tmp_path, CROSSED)
    assert Plan.model_validate(plan.model_dump(mode="json")) == plan
    assert expand_cells(Plan.model_validate(plan.model_dump(mode="json")))[2].config == expand_cells(plan)[2].config


def test_a_grid_of_nothing_is_refused(tmp_path: Path) -> None:
    (line,) = mistakes(tmp_path, CROSSED[: CROSSED.index("    each:")])
    assert line.startswith("plan.yaml:10: grid.0") and "expected keys, each or both" in line


ORACLES = """\
name: merges
scenarios: [smoke/one_box]
seeds: [7]
until: merge
variants:
  - {preset: tunnelcd}
  - {preset: tunnelcd, oracle_merge: {}}
  - {preset: tunnelcd, oracle_merge: {noise_m: 0.1, noise_deg: 0.2}}
  - {preset: tunnelcd, oracle_merge: {noise_m: 0.05}, set: ["map.voxel_m=0.3"]}
  - {preset: paper, oracle_merge: {}}
"""


def test_oracles_are_variants_of_their_own(tmp_path: Path) -> None:
    found = expand_cells(read(tmp_path, ORACLES))
    assert [(c.preset, c.variant) for c in found] == [
        ("tunnelcd", "tunnelcd"),
        ("tunnelcd", "oracle-merge"),
        ("tunnelcd", "oracle-merge[noise_m=0.1,noise_deg=0.2]"),
        ("tunnelcd", "oracle-merge[noise_m=0.05,noise_deg=0,map.voxel_m=0.3]"),
        ("paper", "oracle-merge[preset=paper]"),
    ]
    noises = [None if c.oracle is None else (c.oracle.noise_m, c.oracle.noise_deg) for c in found]
    assert noises == [None, (0, 0), (0.1, 0.2), (0.05, 0), (0, 0)]
    # the later stages are the preset's
    assert found[1].config == found[0].config
    assert found[3].config.map.voxel_m == 0.3


def test_a_plan_may_end_at_the_merge(tmp_path: Path) -> None:
    assert {c.until for c in expand_cells(read(tmp_path, ORACLES))} == {"merge"}
    assert {c.until for c in expand_cells(read(tmp_path))} == {None}


def test_the_command_line_keeps_oracles_and_the_end(tmp_path: Path) -> None:
    plan = read(tmp_path, ORACLES)
    assert change_plan(plan) == plan
    found = expand_cells(change_plan(plan, settings=["map.keyframe_spacing_m=2"], grid=["map.voxel_m=0.1,0.4"]))
    assert len(found) == 10
    assert {c.until for c in found} == {"merge"}
    assert "oracle-merge[noise_m=0.1,noise_deg=0.2,map.voxel_m=0.4,map.keyframe_spacing_m=2]" in {
        c.variant for c in found
    }
    # a provenance holds no key that the plan does not say
    variants = plan.model_dump(mode="json")["variants"]
    assert ["oracle_merge" in variant for variant in variants] == [False, True, True, True, True]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("until: merge", "until: merg", ["plan.yaml:4:", "until = 'merg'", 'did you mean "merge"?']),
        ("noise_deg: 0.2", "noise_dg: 0.2", ["plan.yaml:8:", "noise_dg", 'did you mean "noise_deg"?']),
        ("noise_m: 0.1", "noise_m: -0.1", ["plan.yaml:8:", "noise_m = -0.1", "greater than or equal to 0"]),
        ("noise_deg: 0.2", "noise_deg: .nan", ["plan.yaml:8:", "noise_deg"]),
        # a bare key would be no oracle, and nothing would tell
        ("oracle_merge: {noise_m: 0.1, noise_deg: 0.2}", "oracle_merge: ", ["plan.yaml:8:", "{} is without noise"]),
        ("{noise_m: 0.1, noise_deg: 0.2}", "0.1", ["plan.yaml:8:", "expected {noise_m: ..., noise_deg: ...}"]),
        ("{noise_m: 0.1, noise_deg: 0.2}", "{noise_m: 0}", ["variant oracle-merge stands twice"]),
        ("oracle_merge: {noise_m: 0.05}", "oracle_merg: {}", ["plan.yaml:9:", 'did you mean "oracle_merge"?']),
    ],
)
def test_mistakes_of_oracles_and_of_the_end(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in ORACLES
    (line,) = mistakes(tmp_path, ORACLES.replace(old, new))
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("map.voxel_m=0.3", "merge.inlier_m=0.2", ["plan.yaml:9:", "merge.inlier_m=0.2 does nothing", "by the truth"]),
        ("map.voxel_m=0.3", "query.radius_m=3", ["query.radius_m=3 of tunnelcd does nothing", "ends at the merge"]),
        (
            "{preset: paper,",
            "{preset: paper, per_scenario: {smoke/one_box: cluster.min_points=9},",
            ["cluster.min_points"],
        ),
        (
            "  - {preset: paper, oracle_merge: {}}",
            "grid: [{variant: paper, scenarios: [smoke/one_box], keys: {extract.voxel_m: [0.2]}}]",
            ["extract.voxel_m of the grid of paper does nothing"],
        ),
    ],
)
def test_settings_that_nothing_reads(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in ORACLES
    (line,) = mistakes(tmp_path, ORACLES.replace(old, new))
    assert all(word in line for word in words), line


def test_the_same_settings_are_welcome_where_they_are_read(tmp_path: Path) -> None:
    text = ORACLES.replace("until: merge\n", "").replace("map.voxel_m=0.3", "query.radius_m=3")
    assert expand_cells(read(tmp_path, text))[3].config.query.radius_m == 3
    with pytest.raises(InputError, match=r"query.radius_m=3 of tunnelcd does nothing"):
        change_plan(read(tmp_path, ORACLES), settings=["query.radius_m=3"])


def test_settings_of_the_merge_on_the_command_line_pass_by_the_oracles(tmp_path: Path) -> None:
    plan = change_plan(read(tmp_path, ORACLES), settings=["merge.refine=none"], grid=["merge.inlier_m=0.1,0.2"])
    assert [c.variant for c in expand_cells(plan)] == [
        "tunnelcd[merge.inlier_m=0.1,merge.refine=none]",
        "tunnelcd[merge.inlier_m=0.2,merge.refine=none]",
        "oracle-merge",
        "oracle-merge[noise_m=0.1,noise_deg=0.2]",
        "oracle-merge[noise_m=0.05,noise_deg=0,map.voxel_m=0.3]",
        "oracle-merge[preset=paper]",
    ]
    assert list_planned_cases(plan) == {(c.scenario, c.seed, c.variant) for c in expand_cells(plan)}


def test_a_variant_may_be_for_some_scenarios_alone(tmp_path: Path) -> None:
    text = PLAN.replace("  - preset: tunnelcd\n", "  - preset: tunnelcd\n    scenarios: smoke/unchanged\n")
    plan = read(tmp_path, text)
    found = {(cell.scenario, cell.variant) for cell in expand_cells(plan)}
    assert ("smoke/unchanged", "tunnelcd[extract.voxel_m=0.4]") in found
    assert ("smoke/one_box", "tunnelcd[extract.voxel_m=0.4]") not in found
    assert {(scenario, variant) for scenario, _, variant in list_planned_cases(plan)} == found
    assert expand_cells(change_plan(plan)) != [] and change_plan(plan) == plan
    assert mistakes(
        tmp_path, text.replace("scenarios: smoke/unchanged", "scenarios: [smoke/unchanged, paper/site1]")
    ) == [
        "plan.yaml:8: variants.1.scenarios.1 = 'paper/site1': scenarios of tunnelcd names 'paper/site1', which is no "
        "world of the plan"
    ]


def test_all_mistakes_between_parts_are_told_at_once_with_their_lines(tmp_path: Path) -> None:
    text = PLAN.replace("{smoke/unchanged: [", "{unchanged/site1: [").replace("[0.2, 0.3]", "[0.2, 0.2]")
    found = mistakes(tmp_path, text.replace("    scenarios: [smoke/one_box]", "    scenarios: [unchanged/smooth]"))
    assert [line.partition(": ")[0] for line in found] == ["plan.yaml:6", "plan.yaml:11"]
    found = mistakes(tmp_path, text)
    assert [line.partition(": ")[0] for line in found] == ["plan.yaml:6", "plan.yaml:4", "plan.yaml:4"]


def test_a_report_may_be_about_both(tmp_path: Path) -> None:
    for written_as, subjects in (("regions", ("regions",)), ("[regions, objects]", ("regions", "objects")), ("", ())):
        plan = read(tmp_path, f"{PLAN}report: {written_as}\n")
        assert plan.report == subjects
        assert reported({"plan": plan.model_dump(mode="json")}) == subjects
    assert reported({"plan": {"report": "objects"}}) == ("objects",)  # as runs of before wrote it
    (told,) = mistakes(tmp_path, f"{PLAN}report: [regions, object]\n")
    assert 'did you mean "objects"?' in told


def test_every_option_of_the_command_line_is_checked_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        change_plan(
            read(tmp_path), seeds="a", settings=["query.radus_m=3", "x"], grid=["extract.voxel=1", "extract.voxel_m"]
        )
    lines = str(caught.value).splitlines()
    assert [line.partition(": ")[0] for line in lines] == [
        "--seeds a", "--set query.radus_m=3", "--set x", "--grid extract.voxel=1", "--grid extract.voxel_m",
    ]  # fmt: skip
    assert [line.count("did you mean") for line in lines] == [0, 1, 0, 1, 0]


def test_weights_of_a_plan_start_at_its_file(tmp_path: Path) -> None:
    text = """
name: mine
scenarios: [smoke/one_box]
seeds: [1]
variants:
  - {preset: tunnelcd, set: "sphere.weights=w/a.safetensors"}
  - {preset: tunnelcd, per_scenario: {smoke/one_box: ["descriptor.weights=/b.safetensors"]}}
grid:
  - {variant: tunnelcd, scenarios: [smoke/one_box], keys: {sphere.weights: [c.safetensors, ""]}}
"""
    plan = read(tmp_path, text)
    configs = [cell.config for cell in expand_cells(change_plan(plan, settings=["descriptor.weights=d.safetensors"]))]
    assert [config.sphere.weights for config in configs] == [
        str(tmp_path / "w/a.safetensors"), "", str(tmp_path / "c.safetensors"), "",
    ]  # fmt: skip
    assert {config.descriptor.weights for config in configs} == {"d.safetensors"}
    assert expand_cells(plan)[1].config.descriptor.weights == "/b.safetensors"


def test_surface_is_a_section_of_the_method_and_a_list_of_the_world() -> None:
    assert {cell.config.surface.method for cell in cells_of("surface")} == {
        "planes", "m3c2", "m3c2-ep", "c2c", "c2m", "unrolled",
    }  # fmt: skip
    with pytest.raises(ValueError, match="surface"):
        require_draws("narrow", ("surface.method=planes",))
    with pytest.raises(ValueError, match="belongs to the world"):
        require_valid_setting("tunnel.meander_m=1")


def test_a_plan_file_that_is_not_there_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.yaml: no such file: expected a plan, or a name of `tunnelcd list"):
        load_plan(str(tmp_path / "gone.yaml"))


def test_a_setting_that_no_method_of_the_plan_reads_is_refused(tmp_path: Path) -> None:
    start = "{name: m, scenarios: [narrow], seeds: [7], "
    rule = r"^voxel_diff\.voxel_m=0\.3: regions\.source = sphere does not read the section voxel_diff: leave it out, "
    with pytest.raises(InputError, match=rule):
        expand_cells(read(tmp_path, start + "set: [voxel_diff.voxel_m=0.3], variants: [{preset: tunnelcd}]}"))
    with pytest.raises(InputError, match=r"^c2c\.distance_m=0\.3: .*\nc2c\.distance_m=0\.4: "):
        grid = "grid: [{variant: tunnelcd, keys: {c2c.distance_m: [0.3, 0.4]}}]}"
        expand_cells(read(tmp_path, start + "variants: [{preset: tunnelcd}, {preset: c2c}], " + grid))
    # one set is for all variants: it is enough that one of them reads it
    shared = "set: [voxel_diff.voxel_m=0.3], variants: [{preset: tunnelcd}, {preset: voxel-diff}]}"
    assert len(expand_cells(read(tmp_path, start + shared))) == 2


def test_a_setting_that_no_extraction_of_the_plan_reads_is_told(tmp_path: Path) -> None:
    start = "{name: m, scenarios: [narrow], seeds: [7], "
    grid = "grid: [{variant: tunnelcd, keys: {extract.voxel_m: [0.3, 0.65], extract.min_cells: [20]}}]}"
    plan = read(tmp_path, start + "variants: [{preset: tunnelcd}, {preset: paper}], " + grid)
    assert explain_unread_settings(plan) == [  # that of 0.65 is the default
        "extract.voxel_m=0.3 changes nothing: extract.method = surface does not read it; set extract.method=voxel "
        "as well"
    ]
    # one set is for all variants: it is enough that one of them reads it
    shared = "set: [extract.voxel_m=0.3], variants: [{preset: tunnelcd}, {preset: paper}]}"
    assert explain_unread_settings(read(tmp_path, start + shared)) == []


@pytest.mark.parametrize("name", plan_names())
def test_all_settings_of_a_shipped_plan_are_read(name: str) -> None:
    assert explain_unread_settings(plan_of(name)) == []
