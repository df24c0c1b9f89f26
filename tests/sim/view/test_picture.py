from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from scenarios import load_scenario
from scenarios.schema import Air, Dust, Prop, Scenario, SurfaceChange, SurfacePlace
from sim.materials import REFLECTIVITY
from sim.scene import Scene, build_world
from sim.sensor.air import AirVolume
from sim.session.planning import plan_drives
from sim.view import gallery
from sim.view.picture import COLOURS, material_colour, part_colours, render
from sim.view.rock import face_tints

EYE, TARGET = (5.0, 0.0, 0.5), (8.0, 0.0, 0.3)


@pytest.fixture
def boxed(make_scenario: Callable[..., Scenario], make_prop: Callable[..., Prop]) -> Scenario:
    return make_scenario(props=(make_prop("box", 0.4, 0.0, change="added"),))


def with_orange_props(scene: Scene) -> Scene:
    parts = zip(scene.instance, scene.materials, strict=True)
    return replace(scene, materials=tuple("plastic" if number else material for number, material in parts))


def test_the_colour_of_a_prop_covers_the_prop_in_front_of_rock_and_nothing_else(boxed: Scenario) -> None:
    world = build_world(boxed, 0)
    scenes = (world.before, world.after, with_orange_props(world.after))
    empty, plain, red = (render(scene, EYE, TARGET, 120, 90).astype(int) for scene in scenes)
    assert plain.shape == (90, 120, 3)
    differs = (red != plain).any(axis=2)
    # The box, 0.6 m wide, stands 2.6 m before the lens, whose picture is 2 tan(35 deg) times its distance wide.
    width_px = 120 * 0.6 / (2 * np.tan(np.deg2rad(35)) * 2.6)
    assert abs(differs[45].sum() - width_px) <= 2
    # orange pixels are the box's own, and the box changes them against the empty tunnel
    assert ((plain != empty).any(axis=2) | ~differs).all()
    assert (red[differs, 0] > 1.8 * red[differs, 1]).all()
    np.testing.assert_array_equal(plain, render(world.after, EYE, TARGET, 120, 90).astype(int))


def test_a_box_throws_a_shadow_on_the_floor_left_of_it(boxed: Scenario) -> None:
    world = build_world(boxed, 0)
    above, floor = (6.0, 0.0, 2.0), (8.0, 0.0, 0.0)
    empty, full = (render(scene, above, floor, 120, 90).astype(int) for scene in (world.before, world.after))
    red = render(with_orange_props(world.after), above, floor, 120, 90).astype(int)
    is_box = (red != full).any(axis=2)
    darker = (full.sum(axis=2) < 0.75 * empty.sum(axis=2)) & ~is_box
    assert darker.sum() > 100
    # the lamp hangs to the right of the camera
    assert np.flatnonzero(darker.any(axis=0)).mean() < np.flatnonzero(is_box.any(axis=0)).mean()


def test_more_samples_make_the_same_picture_smoother(boxed: Scenario) -> None:
    scene = build_world(boxed, 0).before
    coarse, fine = (render(scene, EYE, TARGET, 60, 45, samples=samples).astype(float) for samples in (1, 4))
    assert fine.shape == coarse.shape
    assert abs(fine.mean() - coarse.mean()) < 3
    assert np.abs(np.diff(fine, axis=1)).mean() < np.abs(np.diff(coarse, axis=1)).mean()


def test_contrast_in_mist_falls_with_range_after_beer_and_lambert(boxed: Scenario) -> None:
    world = build_world(boxed, 0)
    scenes = world.after, with_orange_props(world.after)

    def contrast(mist_per_m: float) -> float:
        air = AirVolume(mist_per_m)
        plain, red = (render(scene, EYE, TARGET, 120, 90, air=air) / 255.0 for scene in scenes)
        return float((plain**2.2 - red**2.2)[40:50, 55:65, 2].mean())

    clear, thick = contrast(0.0), contrast(0.25)
    assert clear == pytest.approx(float(contrast(1e-9)))
    # the box, 0.6 m deep, stands 3 m before the lens
    assert np.log(clear / thick) / 0.25 == pytest.approx(2.7, abs=0.15)
    np.testing.assert_array_equal(
        render(world.after, EYE, TARGET, 60, 45), render(world.after, EYE, TARGET, 60, 45, air=AirVolume(0.0))
    )


def test_the_gallery_shows_the_dust_of_a_family(boxed: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gallery, "_FAMILY_PX", (160, 100))
    dusty = boxed.model_copy(update={"after": boxed.after.model_copy(update={"air": Air(dust=Dust(mg_per_m3=1500.0))})})
    clear, veiled = (gallery.family_picture(each, 0).astype(float) for each in (boxed, dusty))
    assert clear.shape == veiled.shape
    assert veiled.std() < 0.9 * clear.std()


def test_every_material_has_a_colour_and_parts_are_drawn_in_theirs(boxed: Scenario) -> None:
    assert COLOURS.keys() == {*REFLECTIVITY, "water"}  # a puddle is no geom
    scene = build_world(boxed, 0).after
    colours = part_colours(scene)
    assert colours.shape == (len(scene.meshes), 3)
    for row, part, material in zip(colours, scene.parts, scene.materials, strict=True):
        np.testing.assert_allclose(row ** (1 / 2.2), material_colour(part, material), atol=1e-12)
    painted = render(replace(scene, materials=("rock", *["rubber"] * (len(scene.parts) - 1))), EYE, TARGET, 60, 45)
    assert (painted != render(scene, EYE, TARGET, 60, 45)).any()


def test_the_gallery_shows_a_family_and_a_prop_from_two_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, boxed: Scenario
) -> None:
    monkeypatch.setattr(gallery, "_SHEET_PX", (96, 72))
    monkeypatch.setattr(gallery, "_FAMILY_PX", (160, 100))
    monkeypatch.setattr(gallery, "load_scenario", lambda name, seed: boxed)
    shots: list[tuple[Any, ...]] = []
    usual = gallery.render

    def noted(scene: Any, eye: Any, target: Any, *size: int, **settings: Any) -> Any:
        shots.append((scene, eye, target))
        return usual(scene, eye, target, *size, **(settings | {"samples": 1}))

    monkeypatch.setattr(gallery, "render", noted)
    paths = gallery.draw_gallery(tmp_path / "new", ["narrow", "barrel"])
    assert [path.name for path in paths] == ["family-narrow.jpg", "prop-barrel.jpg"]
    family, barrel = (matplotlib.image.imread(path) for path in paths)
    # one view of a family, three of a prop side by side
    assert family.shape[0] < family.shape[1] < barrel.shape[1]
    assert barrel.shape[1] % 3 == 0
    # the box, 0.8 x 0.6 x 0.7 m, is in sight and near
    scene, eye, target = shots[0]
    assert np.linalg.norm(target - eye) < 9
    ray = target - (0, 0, 0.6) - eye  # the camera points a little above it
    assert scene.instance[scene.caster.cast(eye[None], ray[None] / np.linalg.norm(ray))[1][0]] == 1
    for scene, eye, target in shots[1:]:
        ray = (target - eye) / np.linalg.norm(target - eye)
        ranges_m, geom, _ = scene.caster.cast(eye[None], ray[None])
        assert scene.instance[geom[0]] == 1
        assert 1.5 < ranges_m[0] < 2.9


def test_rock_that_came_in_is_red_and_rock_that_fell_out_blue_in_the_picture(
    make_scenario: Callable[..., Scenario], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gallery, "_FAMILY_PX", (160, 100))
    place = SurfacePlace(between=("a", "b"), fraction=0.6)
    for kind, sign in (("convergence", 1), ("scar", -1)):
        change = SurfaceChange(name=kind, kind=kind, depth_m=0.3, sector_deg=(-40, 40), place=place)
        scenario = make_scenario(surface=(change,))
        world = build_world(scenario, 0)
        tints = face_tints(world)
        (own, *_) = (patch.number for patch in world.displacement.patches)  # type: ignore[union-attr]
        is_own = world.displacement.label == own  # type: ignore[union-attr]
        assert np.isfinite(tints[is_own]).all()
        assert np.isnan(tints[world.displacement.label == 0]).all()  # type: ignore[union-attr]
        eye, roof = (8.0, 0.0, 1.0), (12.0, 0.0, 3.0)
        plain, tinted = (render(world.after, eye, roof, 120, 90, tints=each).astype(int) for each in (None, tints))
        is_tinted = (plain != tinted).any(axis=2)
        redness = sign * (tinted[..., 0] - tinted[..., 2])[is_tinted]
        assert is_tinted.sum() > 500 and (redness > 20).mean() > 0.5 and (redness > -20).all()
        pixels, caption = gallery._captioned(scenario, 0)
        # of a scar the picture shows the rubble, which is red
        redness = pixels[..., 0].astype(int) - pixels[..., 2]
        assert (redness > 60).mean() > 0.01 and "red into the void" in caption
    assert gallery._captioned(make_scenario(), 0)[1] == ""


def test_a_picture_of_a_family_shows_its_movers_and_puddles() -> None:
    walker = "movers=[{name: walker, kind: person, path: {length_m: 6}}]"
    puddle = "puddles=[{name: p, place: {between: [start, bend], fraction: 0.5}, radius_m: 1}]"
    scene, places = gallery._with_guests(plan_drives(load_scenario("smoke/unchanged", 3, [walker, puddle]), 3)[1])
    plain = build_world(load_scenario("smoke/unchanged", 3), 3).after
    added = len(scene.meshes) - len(plain.meshes)
    assert len(places) == 2 and added > 10
    assert scene.parts[-added:] == ("guest-0", *["guest-1"] * (added - 1))
    assert scene.materials[-added] == "water" and set(scene.materials[1 - added :]) > {"fabric", "reflector"}
    # a ray down at the puddle meets it, one at the walker's chest meets the walker
    down = scene.caster.cast(places[0][None] + (0.0, 0.0, 1.0), np.array([[0.0, 0.0, -1.0]]))[1]
    assert scene.instance[down].tolist() == [gallery._FIRST_GUEST]
    level = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
    chest = places[1] + (0.0, 0.0, 0.6)
    met = scene.caster.cast(chest + 1.0 * level, -level)[1]
    assert (scene.instance[met] == gallery._FIRST_GUEST + 1).mean() > 0.7
