from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError, InputWarning, ScenarioError
from cdpipe.io.session import read_session
from scenarios.schema import (
    Aged,
    Mover,
    Place,
    Prop,
    Puddle,
    Scenario,
    Section,
    Shift,
    Stretch,
    SurfaceChange,
    SurfacePlace,
)
from sim.placement.placing import rectangles_overlap, standing_corners
from sim.scene import WALL_GEOM, Ground, build_world, lay_ground
from sim.session.labels import list_changes
from sim.session.surface import MovedRock, list_surface_changes
from sim.session.truth import PairTruth, read_chunk_surface, read_labels, read_pair_truth
from sim.story import PairMaker, SessionState, Story, read_story, simulate_story
from sim.story.pairs import plan_pair
from sim.story.schedule import draw_states, stands_in
from sim.story.state import dump_story
from sim.story.world import build_session_world, plan_session
from sim.view import view_folder

SEED, N = 1, 6


def rock(name: str, kind: str, fraction: float, **sizes: Any) -> SurfaceChange:
    return SurfaceChange(name=name, kind=kind, place=SurfacePlace(between=("a", "b"), fraction=fraction), **sizes)


@dataclass(frozen=True)
class Made:
    """A story on disk, its ground, and the pairs that were made of it."""

    folder: Path
    story: Story
    ground: Ground
    pairs: dict[tuple[int, int], Path]

    def truth(self, before: int, after: int) -> PairTruth:
        return read_pair_truth(self.pairs[before, after])


@pytest.fixture(scope="module", name="scenario")
def scenario_fixture(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    far = Place(between=("a", "b"), fraction=0.85, lateral=-0.9)
    return make_scenario(
        surface=(
            rock("squeezed", "convergence", 0.5, depth_m=0.08, length_m=2.0, sector_deg=(50, 120)),
            rock("heaved", "heave", 0.22, depth_m=0.1, length_m=3.0),
            rock("fallen", "scar", 0.68, depth_m=0.2, length_m=0.9, sector_deg=(-55, -30)),
        ),
        props=(
            make_prop("stays", 0.22, 0.7, size_m=(0.4, 0.4, 0.4)),
            make_prop("comes", 0.9, 0.9, size_m=(0.5, 0.5, 0.5), change="added"),
            make_prop("goes", 0.4, -0.9, size_m=(0.5, 0.5, 0.5), change="removed"),
            make_prop("walks", 0.55, -0.9, size_m=(0.4, 0.5, 0.6), change="moved", to=far),
        ),
    )


@pytest.fixture(scope="module", name="made")
def made_fixture(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("story")
    story = simulate_story(scenario, SEED, N, folder)
    maker = PairMaker(folder)
    first, second = find_return(story, "comes")
    pairs = {}
    for before, after in {(1, N), (N, 1), (first, second)}:
        pairs[before, after] = tmp_path_factory.mktemp("pair")
        maker.make(before, after, pairs[before, after])
    return Made(folder, story, maker._ground, pairs)


def find_return(story: Story, name: str) -> tuple[int, int]:
    """Return two sessions in which a prop stands at one place, though it was away in between."""
    places = [state.places[name] for state in story.sessions]
    for first, place in enumerate(places):
        for second in range(first + 2, len(places)):
            if place == places[second] != "absent" and "absent" in places[first:second]:
                return first + 1, second + 1
    raise AssertionError(f"{name} never returns: {places}")


def test_first_and_last_session_differ_as_the_two_sessions_of_the_scenario(scenario: Scenario, made: Made) -> None:
    world = build_world(scenario, SEED)
    told = [(each.change.name, each.change.kind, each.change.session) for each in list_changes(scenario, world)]
    truth = made.truth(1, N)
    assert [(each.name, each.kind, each.session) for each in truth.changes] == told
    assert world.displacement is not None
    expected = list_surface_changes(world, world.displacement, MovedRock(world, world.displacement, "before"))
    assert [(each.id, each.name, each.kind, each.partner) for each in truth.surface_changes] == [
        (each.id, each.name, each.kind, each.partner) for each in expected
    ]
    for own, two in zip(truth.surface_changes, expected, strict=True):
        for name in ("area_m2", "volume_m3", "largest_m", "mean_m"):
            assert getattr(own, name) == pytest.approx(getattr(two, name), rel=1e-9)


def test_a_pair_in_reverse_has_opposite_signs_and_swapped_kinds(made: Made) -> None:
    forward, reverse = made.truth(1, N), made.truth(N, 1)
    swapped = {"added": "removed", "removed": "added", "moved": "moved"}
    other = {"before": "after", "after": "before"}
    assert sorted((swapped[each.kind], other[each.session], each.name) for each in forward.changes) == sorted(
        (each.kind, each.session, each.name) for each in reverse.changes
    )
    for one, two in zip(forward.surface_changes, reverse.surface_changes, strict=True):
        assert two.volume_m3 == pytest.approx(-one.volume_m3, rel=1e-9)
        assert np.sign([two.largest_m, two.mean_m]).tolist() == [-np.sign(one.largest_m)] * 2
    creep, backward = forward.surface_changes[0], reverse.surface_changes[0]
    assert backward.largest_m == pytest.approx(-creep.largest_m, abs=5e-4)


def test_displacements_of_returns_have_the_sign_of_their_change(made: Made) -> None:
    for before, after, sign in ((1, N, 1), (N, 1, -1)):
        pair = made.pairs[before, after]
        signs = {
            each.id: sign * (-1 if each.kind == "scar" else 1) for each in made.truth(before, after).surface_changes
        }
        n_found = 0
        for session in ("before", "after"):
            for index in range(read_session(pair / session).n_chunks):
                labels = read_chunk_surface(pair / session, index)
                assert labels is not None
                moved_m, change = labels
                for number, way in signs.items():
                    own = moved_m[(change == number) & (np.abs(moved_m) > 0.005)]
                    assert (np.sign(own) == way).mean() > 0.98 if len(own) else True
                    n_found += len(own)
        assert n_found > 1000


def test_a_session_has_the_same_files_in_the_story_and_in_every_pair(made: Made) -> None:
    for (before, after), pair in made.pairs.items():
        for role, number in (("before", before), ("after", after)):
            session = made.folder / f"session-{number:02d}"
            for name in made.story.digests[session.name]:
                assert (pair / role / name).samefile(session / name)


def test_a_prop_that_came_went_and_returned_is_no_change_between(made: Made) -> None:
    first, second = find_return(made.story, "comes")
    pair, truth = made.pairs[first, second], made.truth(first, second)
    assert "comes" not in {each.name for each in truth.changes}
    number = [prop["name"] for prop in truth.scenario["props"]].index("comes") + 1
    for session in ("before", "after"):
        labels = list(read_labels(pair / session, read_session(pair / session).n_chunks))
        of_prop = np.concatenate([change[instance == number] for instance, change in labels])
        assert len(of_prop) > 50
        assert (of_prop == 0).all()
    assert next(prop for prop in truth.scenario["props"] if prop["name"] == "comes")["change"] == "none"


def test_displacement_grows_from_session_to_session(scenario: Scenario, made: Made) -> None:
    states, patches = made.story.sessions, ("squeezed", "heaved")
    assert made.ground.displacement is not None
    numbers = {patch.name: patch.number for patch in made.ground.displacement.patches}
    moved_m = []
    for after in states[1:]:
        _, world, _ = plan_pair(scenario, SEED, made.ground, (states[0], after))
        assert world.displacement is not None
        wall, before = world.before.meshes[WALL_GEOM], MovedRock(world, world.displacement, "before")
        owner = made.ground.displacement.walls.owner[made.ground.displacement.walls.faces].max(axis=1)
        largest_m = []
        for name in patches:
            shift_m = np.linalg.norm(made.ground.displacement.shift(), axis=1)
            faces = np.flatnonzero(owner == numbers[name])
            deepest = faces[np.argsort(-shift_m[made.ground.displacement.walls.faces[faces]].mean(axis=1))[:20]]
            largest_m.append(before.measure(wall.vertices[wall.faces[deepest]].mean(axis=1), deepest))
        moved_m.append(np.concatenate(largest_m))
    steps_m = np.diff(np.array(moved_m), axis=0, prepend=0.0)
    assert (steps_m > 0.002).all()
    last = np.abs(moved_m[-1])
    assert last.max() == pytest.approx(0.1, abs=0.002)


def test_a_prop_on_a_floor_that_heaves_rises_and_is_no_change(scenario: Scenario, made: Made) -> None:
    heights_m = []
    for state in made.story.sessions:
        world = build_session_world(scenario, made.ground, state)
        (item,) = [item for item in world.standing if item.prop.name == "stays"]
        heights_m.append(item.world_T_object[2, 3])
    assert (np.diff(heights_m) > 0.001).all()
    for before, after in made.pairs:
        assert "stays" not in {each.name for each in made.truth(before, after).changes}


def test_a_view_shows_what_changed_between_the_two_sessions(made: Made) -> None:
    first, second = find_return(made.story, "comes")
    changes = {(each.kind, each.name) for each in made.truth(first, second).changes}
    shown = [surface.name.split("/") for surface in view_folder(made.pairs[first, second]).surfaces]
    assert {(parts[1], parts[2].split(" ")[0]) for parts in shown if parts[0] == "changes"} == changes
    assert "comes" in {parts[1] for parts in shown if parts[0] == "props"}


def test_the_same_seed_gives_the_same_bytes_and_another_number_of_sessions_another_story(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    walker = Mover(
        name="walker", kind="person", sessions="before", path=Stretch(between=("a", "b"), fractions=(0.3, 0.6))
    )
    puddle = Puddle(name="wet", place={"between": ("a", "b"), "fraction": 0.7})
    small = make_scenario(props=(make_prop("comes", change="added"),), movers=(walker,), puddles=(puddle,))
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        simulate_story(small, 5, 3, tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) > 15
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    story = read_story(tmp_path / "one")
    with_walker = {"before": True, "after": False}
    for state in story.sessions:
        assert (tmp_path / "one" / state.name / "truth" / "movers.npz").is_file() == with_walker[state.plan]
    (tmp_path / "pair").mkdir()
    truth = PairMaker(tmp_path / "one").make(3, 1, tmp_path / "pair")
    assert [(each.name, each.session, each.instance) for each in truth.movers] == [("walker", "after", 2)]
    assert [(each.name, each.kind) for each in truth.changes] == [("comes", "removed")]


def test_props_that_take_turns_at_one_place_never_stand_there_together(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    turns = (
        make_prop("first", change="removed"),
        make_prop("second", 0.41, change="added"),
        make_prop("free", 0.7, change="added"),
    )
    scenario = make_scenario(props=turns)
    ground = lay_ground(scenario, 2)
    seen = set()
    for seed in range(12):
        for state in draw_states(scenario, ground, seed, 6):
            here = [item for item in ground.standing if stands_in(item, state)]
            corners = [standing_corners(item) for item in here]
            assert not any(
                rectangles_overlap(one, other) for index, one in enumerate(corners) for other in corners[:index]
            )
            seen.add(frozenset(item.prop.name for item in here))
    assert len(seen) == 6  # every mixture that has room


def narrow_scenario(make_scenario: Callable[..., Scenario], width_m: float, *props: Prop) -> Scenario:
    section = Section(width_m=width_m, height_m=3.2)
    return make_scenario(tunnel=make_scenario().tunnel.model_copy(update={"section": section}), props=props)


def test_props_at_given_places_come_and_go_wherever_the_two_sessions_of_the_scenario_get_by(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    scenario = narrow_scenario(
        make_scenario,
        2.4,  # a box at a wall closes the lane in which props are drawn, and the robot gets by
        make_prop("goes", 0.3, change="removed"),
        make_prop("comes", 0.3, -0.9, change="added"),
        make_prop("pushed", 0.55, -0.9, change="moved", shift=Shift(distance_m=0.3)),
        make_prop("later", 0.8, change="added"),
    )
    ground = lay_ground(scenario, SEED)
    seen, together = set(), set()
    for seed in range(6):
        states = draw_states(scenario, ground, seed, 6)
        for state in states[1:-1]:
            seen |= {(state.plan, *each) for each in state.places.items()}
            together.add((state.places["goes"], state.places["comes"]))
        world = build_session_world(scenario, ground, states[2])
        plan_session(scenario, ground, world, states[2], SEED)  # which refuses a drive that props bar
    assert len(seen) == 2 * (2 + 2 + 3 + 2)  # every prop at each of its places, in either drive
    assert together == {("absent", "absent"), ("before", "absent"), ("absent", "after")}  # both would bar the way


def test_a_session_without_room_for_its_props_is_told(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]
) -> None:
    aged = Aged(shift_m=0.2, heading_deg=-90.0)
    old, beside = make_prop("old", 0.5, 0.9, aged=aged), make_prop("beside", 0.5, -0.9, aged=aged)
    scenario = narrow_scenario(make_scenario, 3.6, old, beside)  # "old" is to the middle before "beside" makes room
    ground = lay_ground(scenario, SEED)
    with pytest.warns(InputWarning, match=r"^session-0\d: "):
        draw_states(scenario, ground, 3, 12)


def pile_story(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Story:
    pile = make_prop("pile", kind="muck_pile", size_m=(1.5, 1.0, 0.5), change="reshaped", loaded_share=0.5)
    scenario = make_scenario(props=(pile,), surface=(rock("fallen", "scar", 0.7),))
    states = [
        SessionState(
            name=f"session-{number:02d}", plan="before", places={"pile": where}, shares={"fallen": float(number > 1)}
        )
        for number, where in enumerate(("before", "before", "after"), start=1)
    ]
    return Story(scenario=scenario, seed=1, sessions=states, files={}, digests={}, versions={})


def write(folder: Path, document: dict[str, Any]) -> Path:
    (folder / "story.json").write_text(json.dumps(document))
    return folder


def test_a_pile_that_grows_is_refused(
    make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop], tmp_path: Path
) -> None:
    maker = PairMaker(write(tmp_path, dump_story(pile_story(make_scenario, make_prop))))
    with pytest.raises(InputError, match=r"^sessions 3 and 2: pile 'pile' was loaded away .*: give 2 3$"):
        maker.make(3, 2, tmp_path / "pair")


@pytest.mark.parametrize(
    ("numbers", "why"),
    [((1, 1), "two different sessions"), ((0, 1), "session 0: .* has sessions 1 to 6"), ((1, 7), "session 7: ")],
)
def test_pairs_that_do_not_exist_are_refused(made: Made, tmp_path: Path, numbers: tuple[int, int], why: str) -> None:
    with pytest.raises(InputError, match=why):
        PairMaker(made.folder).make(*numbers, tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        (("format",), "other", "format other 1: this version reads tunnelcd-story"),
        (("format_version",), 2, "update tunnelcd"),
        (("seed",), -1, "seed"),
        (("sessions", 1, "name"), "../session", r"damaged: sessions\.1\.name"),
        (("sessions", 1, "name"), "session-07", "expected session-02"),
        (("sessions", 1, "places"), {}, r"sessions\.1\.places: expected pile"),
        (("sessions", 1, "places", "pile"), "absent", r"sessions\.1\.places\.pile = absent: its change is reshaped"),
        (("sessions", 1, "shares"), {"fallen": 0.5}, "a scar happens at once: expected 0 or 1"),
        (("sessions", 1, "shares"), {"fallen": 1.5}, r"sessions\.1\.shares\.fallen"),
        (("scenario", "props"), 3, r"scenario\.props"),
    ],
)
def test_a_damaged_story_is_one_line(
    make_scenario: Callable[..., Scenario],
    make_prop: Callable[..., Prop],
    tmp_path: Path,
    key: tuple[Any, ...],
    value: Any,
    why: str,
) -> None:
    document: Any = json.loads(json.dumps(dump_story(pile_story(make_scenario, make_prop))))
    place = document
    for part in key[:-1]:
        place = place[part]
    place[key[-1]] = value
    with pytest.raises(InputError, match=why) as caught:
        read_story(write(tmp_path, document))
    assert "\n" not in str(caught.value)


def test_a_session_of_other_bytes_is_refused(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    (tmp_path / "story").mkdir()
    (tmp_path / "pair").mkdir()
    simulate_story(make_scenario(), 5, 3, tmp_path / "story")
    chunk = next((tmp_path / "story" / "session-02" / "chunks").iterdir())
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(InputError, match=r"session-02/chunks/\S+: is not what this version of tunnelcd simulates"):
        PairMaker(tmp_path / "story").make(1, 2, tmp_path / "pair")


def test_what_cannot_be_a_story_is_refused(make_scenario: Callable[..., Scenario], tmp_path: Path) -> None:
    plain = make_scenario()
    with pytest.raises(InputError, match=r"^n_sessions = 13: a story has 3 to 12 sessions$"):
        simulate_story(plain, 1, 13, tmp_path)
    recorded = plain.before.model_copy(update={"odometry": plain.before.odometry.model_copy(update={"file": "a.tum"})})
    with pytest.raises(ScenarioError, match=r"^before\.odometry\.file = a\.tum: the poses of one drive"):
        simulate_story(plain.model_copy(update={"before": recorded}), 1, 3, tmp_path)
    assert not any(tmp_path.iterdir())
