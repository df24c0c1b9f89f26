"""Names that would leave their folder or share one."""

from pathlib import Path

import pytest

from cdpipe.core.errors import InputError
from cdpipe.model.config import load_config, preset_names
from eval.plans.plan import load_plan
from eval.running.runfolder import RunFolder, start_run_folder, write_json
from eval.running.runner import run_plan
from scenarios.catalogue import family_files, scenario_names

PLAN = "name: hostile\nscenarios: [{worlds}]\nseeds: [10600]\nvariants: [{variants}]\n"


def write_plan(folder: Path, presets: tuple[str, ...], worlds: str = "smoke/one_box") -> Path:
    for name in presets:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("regions: {source: voxel-diff}\n")
    path = folder / "plan.yaml"
    variants = ", ".join(f'{{preset: "{folder / name}"}}' for name in presets)
    path.write_text(PLAN.format(worlds=worlds, variants=variants))
    return path


def test_every_shipped_name_keeps_its_folder_and_has_one_of_its_own() -> None:
    names = [*preset_names(), *scenario_names()]
    run = RunFolder(Path())
    folders = [run.answer(name, 0, "x").parts[1] for name in names]
    assert folders == [name.replace("/", "__") for name in names]
    assert len({folder.casefold() for folder in folders}) == len(set(names))


@pytest.mark.parametrize("name", ["...yaml", "....yaml", "_.yaml"])
def test_a_preset_file_without_a_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="expected a name with a letter or a digit"):
        load_plan(str(write_plan(tmp_path, (name,))))


@pytest.mark.parametrize("presets", [("a b.yaml", "a_b.yaml"), ("mine.yaml", "MINE.yaml")])
def test_two_presets_that_would_share_a_folder_are_refused(tmp_path: Path, presets: tuple[str, str]) -> None:
    first, second = (name.removesuffix(".yaml") for name in presets)
    with pytest.raises(InputError, match=f"variant {second} would share the folder of {first}"):
        load_plan(str(write_plan(tmp_path, presets)))


def test_two_worlds_that_would_share_a_folder_are_refused(tmp_path: Path) -> None:
    for name in ("a b.yaml", "a_b.yaml"):
        (tmp_path / name).write_text("extends: smoke/one_box\n")
    worlds = f'"{tmp_path}/a b.yaml", "{tmp_path}/a_b.yaml"'
    with pytest.raises(InputError, match=r"a_b.yaml would share the folder of .*a b.yaml"):
        load_plan(str(write_plan(tmp_path, ("mine.yaml",), worlds)))


@pytest.mark.parametrize("kind", ["presets", "families"])
@pytest.mark.parametrize(("name", "words"), [("...yaml", "expected a name"), ("a\x1bb.yaml", r"a\\x1bb")])
def test_a_file_on_the_search_path_needs_a_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, name: str, words: str
) -> None:
    (tmp_path / kind).mkdir()
    (tmp_path / kind / name).write_text("x: 1\n")
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path))
    with pytest.raises(InputError, match=words):
        family_files() if kind == "families" else load_config("tunnelcd")


@pytest.mark.parametrize(("kind", "name"), [("presets", "TUNNELCD"), ("families", "Smoke__one_box")])
def test_a_file_that_would_share_the_folder_of_a_shipped_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, name: str
) -> None:
    (tmp_path / kind).mkdir()
    (tmp_path / kind / f"{name}.yaml").write_text("x: 1\n")
    monkeypatch.setenv("TUNNELCD_PATH", str(tmp_path))
    with pytest.raises(InputError, match=r"there is (another|a scenario).*: rename"):
        family_files() if kind == "families" else load_config("tunnelcd")


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(("world", "variant"), [("smoke/one_box", "a b"), ("smoke__one_box", "other")])
def test_a_plan_does_not_replace_what_another_name_left_in_its_place(
    tmp_path: Path, world: str, variant: str, *, force: bool
) -> None:
    run = RunFolder(tmp_path / "run")
    write_json(run.path / "provenance.json", {"tool": "tunnelcd"})
    row = {"scenario": world, "seed": 10600, "variant": variant}
    items: dict[str, list[object]] = {"changes": [], "regions": [], "objects": [], "keyframes": []}
    write_json(run.cell(world, 10600, variant), {"key": "x", "order": [0, 0], "row": row, **items})
    answer = run.answer(world, 10600, variant)
    answer.mkdir(parents=True)
    (answer / "answer.json").write_text("precious")
    plan = load_plan(str(write_plan(tmp_path / "plan", ("a_b.yaml",))))
    with pytest.raises(InputError, match=r"holds .*: rename one, or name another run folder"):
        run_plan(plan, start_run_folder(run.path), force=force)
    assert (answer / "answer.json").read_text() == "precious"
    assert run.cell(world, 10600, variant).is_file()
