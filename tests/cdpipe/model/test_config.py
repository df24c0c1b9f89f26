from pathlib import Path

import pytest

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.yamlfile import setting_lines
from cdpipe.model.config import (
    PipelineConfig,
    RegionsConfig,
    Site,
    list_idle_settings,
    list_unread_settings,
    load_config,
    preset_names,
    settings_table,
)
from cdpipe.pipeline import detect

WITHOUT_SITE = ("tunnelcd", "every-keyframe", "sphere-difference", "kiss-matcher", "frame")


def test_every_shipped_preset_is_valid() -> None:
    named = {"paper", "paper-topn", "paper-paired", "voxel-diff", "c2c", "random-regions", "tunnelcd", "frame"}
    assert named | {"kiss-matcher", "scan-context", "solid", "untrained", "sphere-difference"} <= set(preset_names())
    for name in preset_names():
        assert isinstance(load_config(name), PipelineConfig)


def test_every_shipped_preset_says_what_wide_drifts_need() -> None:
    for name in preset_names():
        narrow, wide = load_config(name), load_config(name, site="wide")
        if name in WITHOUT_SITE:
            assert narrow == wide and narrow.query.radius_m == "width"
            continue
        assert (narrow.query.radius_m, wide.query.radius_m) == (4.5, 10.0)
        scored = narrow.query.n_regions is None
        has_own = wide.query.threshold != narrow.query.threshold
        assert has_own == scored, (
            f"{name}: scores differ between narrow and wide drifts; calibrate a threshold for each"
        )
        same = {"radius_m": 4.5, "threshold": narrow.query.threshold}
        assert wide.model_copy(update={"query": wide.query.model_copy(update=same)}) == narrow


def test_settings_go_over_either_kind_of_site() -> None:
    for site in ("narrow", "wide"):
        assert load_config("tunnelcd", ["query.radius_m=7"], site).query.radius_m == 7


def test_mistakes_of_both_kinds_of_site_are_told_at_once(tmp_path: Path) -> None:
    preset = tmp_path / "mine.yaml"
    preset.write_text("query: {radius_m: -1}\nwide:\n  query: {radius_m: 10, treshold: 1}\n")
    with pytest.raises(InputError) as caught:
        load_config(str(preset))
    lines = str(caught.value).splitlines()
    assert [line.partition(":")[2].partition(" =")[0] for line in lines] == ["1: query.radius_m", "3: query.treshold"]
    assert 'did you mean "threshold"' in lines[1]
    # a setting goes over either kind of site: no line of the preset is to blame for a `wide` in it
    with pytest.raises(InputError, match=r"^--set: wide = .*: unknown key; known are seed, map, .*, options$"):
        load_config("tunnelcd", ["wide.query.threshold=1"])
    preset.write_text("wide: 10\n")
    with pytest.raises(InputError, match=r"mine\.yaml:1: wide = 10: "):
        load_config(str(preset))


def test_a_preset_without_wide_drifts_is_refused_there(tmp_path: Path) -> None:
    preset = tmp_path / "mine.yaml"
    preset.write_text("query: {radius_m: 3}\n")
    assert load_config(str(preset)).query.radius_m == 3
    with pytest.raises(InputError, match=r"mine\.yaml: wide: .*wide: \{query: \{radius_m: 10"):
        load_config(str(preset), site="wide")


def test_a_radius_that_follows_the_width_needs_no_site(tmp_path: Path) -> None:
    preset = tmp_path / "mine.yaml"
    preset.write_text("query: {radius_m: width, threshold: 0.5}\n")
    assert load_config(str(preset)) == load_config(str(preset), site="wide")
    fixed = load_config(str(preset), ["query.radius_m=6"], "wide").query
    assert (fixed.radius_m, fixed.threshold) == (6.0, 0.5)
    preset.write_text("query: {radius_m: 3}\n")
    assert load_config(str(preset), ["query.radius_m=width"], "wide").query.radius_m == "width"


@pytest.mark.parametrize("value", ["-1", "0", "widht", "[4]", "null"])
def test_a_radius_is_a_length_or_the_word(value: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config("tunnelcd", [f"query.radius_m={value}"])
    (line,) = str(caught.value).splitlines()  # one rule, not one of each kind
    assert line.startswith("--set: query.radius_m = ")
    assert ('did you mean "width"' in line) == (value == "widht")


@pytest.mark.parametrize("key", ["method=c2c", "query.compare=sphere"])
def test_former_keys_name_those_that_replaced_them(key: str) -> None:
    former = key.partition("=")[0]
    with pytest.raises(InputError, match=rf"^--set: {former} = .*: unknown key; it is regions.source now: "):
        load_config("tunnelcd", [key])


@pytest.mark.parametrize("preset", ["tunnelcd", "paper", "every-keyframe", "sphere-difference", "random-regions"])
def test_clusters_need_a_source_that_compares_whole_maps(preset: str) -> None:
    with pytest.raises(InputError, match=r"extract\.method = clusters: regions\.source = .* surface, voxel or"):
        load_config(preset, ["extract.method=clusters"])
    for rule in ("surface", "voxel", "nearest"):
        assert load_config(preset, [f"extract.method={rule}"]).extract.method == rule
        assert load_config("c2c", [f"extract.method={rule}"]).extract.method == rule


def test_paper_preset_holds_the_published_settings() -> None:
    config = load_config("paper", site="wide")
    assert (config.query.reading, config.query.radius_m, config.extract.voxel_m) == ("nearest", 10.0, 0.65)


def test_presets_of_descriptors_differ_in_the_descriptor_alone() -> None:
    same = ["query.threshold=0", "merge.refine=local"]
    learned = load_config("paper-paired", same)
    for name in ("scan-context", "solid", "untrained"):
        config = load_config(name, same)
        assert config.descriptor.method == name
        assert config.model_copy(update={"descriptor": learned.descriptor}) == learned
        as_published = ["merge.refine=local", "merge.first_every=1"]
        assert load_config(name).merge == load_config("tunnelcd", as_published).merge


def test_mistakes_come_with_suggestions() -> None:
    with pytest.raises(InputError) as caught:
        load_config("paper", ["extract.voxel=0.4", "query.reading=pairs"])
    text = str(caught.value)
    assert '--set: extract.voxel = 0.4: unknown key; did you mean "extract.voxel_m"?' in text
    assert "query.reading = 'pairs'" in text
    assert 'did you mean "paired"?' in text
    with pytest.raises(InputError, match='did you mean "paper"'):
        load_config("papr")


def test_a_key_without_its_group_gets_the_whole_key() -> None:
    with pytest.raises(InputError, match=r"min_cells = 3: .*extract\.min_cells"):
        load_config("tunnelcd", ["min_cells=3"])
    with pytest.raises(InputError, match=r"map\.voxel_m.*merge\.voxel_m.*extract\.voxel_m"):
        load_config("tunnelcd", ["voxel_m=0.3"])


@pytest.mark.parametrize(
    "setting",
    [
        "extract.origin_m=.nan",
        "extract.origin_m=1e9",
        "query.threshold=.inf",
        "extract.voxel_m=1e-7",
        "extract.voxel_m=1e308",
    ],
)
def test_numbers_that_no_stage_could_use_are_refused(setting: str) -> None:
    with pytest.raises(InputError, match=f"--set: {setting.partition('=')[0]} = .*: input should be"):
        load_config("tunnelcd", [setting])


def test_every_setting_has_a_meaning() -> None:
    rows = settings_table()
    assert ("extract.voxel_m", "0.65") in [row[:2] for row in rows]
    assert ("map.consistency", "none; scan-to-map, graph") in [row[:2] for row in rows]
    assert all(meaning for _, _, meaning in rows)


def test_weights_of_a_preset_start_at_its_file_and_those_of_a_setting_at_the_working_folder(tmp_path: Path) -> None:
    preset = tmp_path / "presets" / "mine.yaml"
    preset.parent.mkdir()
    preset.write_text(
        "descriptor: &both {weights: a/3deg.safetensors}\n"
        "sphere: {weights: /b.safetensors}\n"
        "wide: {descriptor: *both}\n"
    )
    for site in ("narrow", "wide"):
        config = load_config(str(preset), site=site)
        assert config.descriptor.weights == str(preset.parent / "a/3deg.safetensors")
        assert config.sphere.weights == "/b.safetensors"
    config = load_config(str(preset), ["descriptor.weights=c.safetensors", "sphere.weights=''"])
    assert (config.descriptor.weights, config.sphere.weights) == ("c.safetensors", "")


def test_a_preset_on_the_search_path_has_its_weights_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets" / "mine.yaml").write_text("sphere: {weights: w.safetensors}\n")
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path))
    assert load_config("mine").sphere.weights == str(tmp_path / "presets" / "w.safetensors")


def test_settings_of_before_there_were_weights_and_frames_are_dumped_as_then() -> None:
    dumped = load_config("paper").model_dump(mode="json")
    assert "sphere" not in dumped and "weights" not in dumped["descriptor"]
    dumped = load_config("tunnelcd", ["sphere.weights=a"]).model_dump(mode="json")
    assert dumped["sphere"] == {"frames": "path", "weights": "a"}
    assert PipelineConfig.model_validate(dumped).sphere.weights == "a"


def test_a_dump_names_the_settings_of_one_rival_only_where_they_count() -> None:
    own = {"removert", "octomap", "m3c2_ep", "erasor", "range_net"}

    def named(preset: str, *settings: str) -> set[str]:
        return own & load_config(preset, settings).model_dump().keys()

    assert named("tunnelcd") == named("dufomap") == set()
    assert (named("m3c2-ep"), named("erasor")) == ({"m3c2_ep"}, {"erasor"})
    assert named("range-net") == {"range_net"}
    assert named("erasor", "removert.margin=0.3") == {"erasor", "removert"}
    for preset in ("tunnelcd", "erasor"):
        config = load_config(preset, ["removert.margin=0.3"])
        assert PipelineConfig.model_validate(config.model_dump()) == config


def test_a_radius_that_is_no_number_is_told_of_both_kinds_of_value() -> None:
    with pytest.raises(InputError, match=r"radius_m = 'abc': input should be a length in metres, above 0, or 'width'"):
        load_config("tunnelcd", ["query.radius_m=abc"])
    assert load_config("tunnelcd", ["query.radius_m=width"]).query.radius_m == "width"


def test_no_merge_can_be_more_distinct_than_10() -> None:
    assert load_config("tunnelcd", {"merge.min_distinctness": 10}).merge.min_distinctness == 10
    with pytest.raises(InputError, match=r"^--set: merge\.min_distinctness = 10\.1: .*less than or equal to 10$"):
        load_config("tunnelcd", {"merge.min_distinctness": 10.1})


def test_an_empty_preset_with_settings_is_refused_in_one_line(tmp_path: Path) -> None:
    for text in ("", "# nothing\n", "- a\n"):
        (tmp_path / "p.yaml").write_text(text)
        for settings in ([], ["seed=1"], ["query.radius_m=6"]):
            with pytest.raises(InputError, match=r"^[^\n]*p\.yaml: expected keys and values, got [^\n]*$"):
                load_config(str(tmp_path / "p.yaml"), settings)


@pytest.mark.parametrize("setting", ["voxel_diff.voxel_m=0.3", "m3c2.cylinder_m=1", "range_net.threshold=0.9"])
def test_a_setting_of_another_source_of_regions_is_not_read(setting: str) -> None:
    section = setting.partition(".")[0]
    with pytest.raises(
        InputError, match=rf"^{setting}: regions\.source = sphere does not read the section {section}: "
    ):
        detect("before", "after", settings=[setting])
    own = load_config(section.replace("_", "-"), [setting])
    assert list_idle_settings(own, [setting]) == []


@pytest.mark.parametrize(
    ("preset", "setting", "ways"),
    [
        ("tunnelcd", "extract.voxel_m=0.3", "extract.method=voxel"),
        ("tunnelcd", "extract.distance_m=0.2", "extract.method=nearest"),
        ("tunnelcd", "cluster.min_points=8", "extract.method=voxel or extract.method=nearest"),
        ("tunnelcd", "outlier.sigmas=3", "extract.method=voxel or extract.method=nearest"),
        ("paper", "extract.min_cells=20", "extract.method=surface"),
        ("paper", "extract.distance_m=0.2", "extract.method=nearest"),
        ("m3c2", "cluster.min_points=8", "extract.method=voxel or extract.method=nearest"),
    ],
)
def test_a_setting_of_another_extraction_is_warned_of(preset: str, setting: str, ways: str) -> None:
    method = load_config(preset).extract.method
    expected = f"{setting} changes nothing: extract.method = {method} does not read it; set {ways} as well"
    with pytest.warns(InputWarning) as told, pytest.raises(InputError, match="no such"):
        detect("gone-before", "gone-after", preset, [setting])
    assert [str(each.message) for each in told] == [expected]
    for way in ways.split(" or "):
        assert list_unread_settings(load_config("tunnelcd", [way, setting]), [way, setting]) == []


def test_filter_and_clusters_are_read_by_sources_that_compare_whole_maps() -> None:
    assert load_config("m3c2").extract.method == "clusters"
    for setting in ("cluster.radius_m=0.4", "outlier.neighbours=6", "outlier.sigmas=3"):
        assert list_unread_settings(load_config("m3c2", [setting]), [setting]) == []


@pytest.mark.parametrize("preset", preset_names())
def test_no_preset_states_a_setting_that_its_extraction_does_not_read(preset: str) -> None:
    sites: tuple[Site, ...] = ("narrow", "wide")
    for site in sites:
        config = load_config(preset, site=site)
        assert list_unread_settings(config, setting_lines(config.model_dump())) == []


def test_sections_that_two_methods_read_and_those_that_an_answer_states() -> None:
    setting = "m3c2.cylinder_m=1"
    for more in ("regions.source=m3c2-ep", "surface.method=m3c2", "surface.method=m3c2-ep"):
        settings = [more, setting, "extract.method=surface"]
        assert list_idle_settings(load_config("tunnelcd", settings), settings) == []
    settings = ["surface.method=c2c", "c2c.distance_m=0.5"]
    assert list_idle_settings(load_config("tunnelcd", settings), settings) == ["c2c.distance_m=0.5"]
    stated = setting_lines(load_config("tunnelcd").model_dump())
    assert any(line.startswith("m3c2.") for line in stated)
    assert list_idle_settings(load_config("tunnelcd", stated), stated) == []
    plugin = load_config("tunnelcd").model_copy(update={"regions": RegionsConfig.model_construct(source="own")})
    assert list_idle_settings(plugin, [setting]) == []
