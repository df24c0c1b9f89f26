from __future__ import annotations

import numpy as np
import pytest

from scenarios.schema import Drift, Niche, Roughness, Section, Tunnel, Variation
from sim.geometry.raycast import Caster
from sim.rock.centreline import Centreline, build_centreline
from sim.rock.tunnel import mesh_tunnel
from sim.studies.contour import contour_roughness


def built(**override: object) -> tuple[Caster, Centreline]:
    settings: dict[str, object] = {
        "nodes": {"a": (0, 0, 0), "b": (120, 0, 1)},
        "drifts": (Drift(nodes=("a", "b")),),
        "section": Section(width_m=5.0, height_m=3.8),
    }
    tunnel = Tunnel.model_validate(settings | override)
    centreline = build_centreline(tunnel, 1)
    return Caster([mesh_tunnel(tunnel, centreline, 1)]), centreline


@pytest.mark.parametrize(("amplitude_m", "length_m"), [(0.12, 1.0), (0.08, 2.0)])
def test_known_roughness_is_found_again(amplitude_m: float, length_m: float) -> None:
    # 120 m of an outline of 9 m are some 85 (2 m) or 340 (1 m) independent patches: variance known to 15 % or 8 %.
    walls, centreline = built(
        roughness=(Roughness(amplitude_m=amplitude_m, length_m=length_m),),
        variation=Variation(share=0.05, length_m=15.0),
    )
    found = contour_roughness(walls, centreline)
    assert found.rms_m == pytest.approx(amplitude_m, rel=0.15)
    assert found.length_m == pytest.approx(length_m, rel=0.2)
    assert found.n_rays > 10_000
    # In a foreign mesh features longer than `fit_m` do not count.
    assert 0.7 * found.rms_m < contour_roughness(walls, centreline, fit_m=20.0).rms_m < found.rms_m


def test_octaves_add_up_in_squares() -> None:
    walls, centreline = built(
        roughness=(Roughness(amplitude_m=0.06, length_m=2.0), Roughness(amplitude_m=0.08, length_m=1.0))
    )
    assert contour_roughness(walls, centreline).rms_m == pytest.approx(0.1, rel=0.15)


def test_a_smooth_tunnel_has_none_whatever_its_drifts_do() -> None:
    walls, centreline = built(
        nodes={"a": (0, 0, 0), "b": (30, 4, 1), "c": (60, 0, 0), "d": (30, 30, 2)},
        drifts=(Drift(nodes=("a", "b", "c")), Drift(nodes=("b", "d"))),
        niches=(Niche(between=("b", "d"), fraction=0.5, side="left", width_m=3.0, depth_m=2.0, height_m=2.5),),
        variation=Variation(share=0.08, length_m=10.0),
        meander_m=0.8,
    )
    found = contour_roughness(walls, centreline)
    assert found.rms_m < 0.006
    assert found.n_rays > 3_000
    # sharp edges are bevelled by the mesh: a rectangle's roof corners are what is left of it
    walls, centreline = built(nodes={"a": (0, 0, 0), "b": (40, 0, 0)}, section=Section(shape="rectangle"))
    found = contour_roughness(walls, centreline)
    assert found.rms_m < 0.015


def test_mouths_niches_and_faces_are_left_out() -> None:
    # Two drifts of 60 m cross in the middle: half a width and 1.3 more to either side are the mouth, 11.5 m; a niche of
    # 3 m takes 3 + 5 m, and behind the last nodes is face. 48.5 + 40.5 m are left, 25 rays every 0.2 m.
    walls, centreline = built(
        nodes={"a": (-30, 0, 0), "o": (0, 0, 0), "b": (30, 0, 0), "c": (0, -30, 0), "d": (0, 30, 0)},
        drifts=(Drift(nodes=("a", "o", "b")), Drift(nodes=("c", "o", "d"))),
        niches=(Niche(between=("a", "o"), fraction=0.4, side="left", width_m=3.0, depth_m=2.0, height_m=2.5),),
    )
    assert contour_roughness(walls, centreline).n_rays == pytest.approx(25 * (48.5 + 40.5) / 0.2, rel=0.02)


def test_without_drifts_there_is_nothing_to_measure() -> None:
    walls, _ = built(nodes={"a": (0, 0, 0), "b": (10, 0, 0)})
    found = contour_roughness(walls, Centreline((), {}))
    assert np.isnan(found.rms_m) and np.isnan(found.length_m)
    assert found.n_rays == 0
