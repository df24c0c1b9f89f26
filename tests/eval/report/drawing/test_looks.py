"""The look of a method belongs to its name, and no two known methods are mistaken for one another."""

import itertools

import numpy as np
import pytest

from cdpipe.model.config import preset_files
from eval.core.charts import DASHES, SYMBOLS
from eval.plans.plan import load_plan
from eval.plans.variants import name_variant
from eval.report.drawing.looks import COLOURS, GREY, KNOWN, line_of, look_of
from eval.tables.rows import is_told_the_truth

# Machado, Oliveira and Fernandes (2009), severity 1: what linear red, green and blue become for the colour-blind
SEEN = {
    "all colours": np.eye(3),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                            [-0.003882, -0.048116, 1.051998]]),
    "deuteranopia": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                              [-0.011820, 0.042940, 0.968881]]),
    "tritanopia": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                            [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip
XYZ_OF_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.9505, 1.0, 1.089])


def lab(colour: str, seen: np.ndarray) -> np.ndarray:
    """CIE Lab of a colour as somebody sees it."""
    share = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    xyz = XYZ_OF_RGB @ np.clip(seen @ linear, 0.0, 1.0) / WHITE
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_every_shipped_method_has_a_look_of_its_own() -> None:
    assert set(KNOWN) == {name for name, file in preset_files().items() if "methods" in str(file)}
    assert len({(look.colour, look.dash) for look in KNOWN.values()}) == len(KNOWN)
    assert len({(look.colour, look.marker) for look in KNOWN.values()}) == len(KNOWN), "charts of points have no dash"
    assert all(look.marker in SYMBOLS and look.dash in DASHES and look.colour != GREY for look in KNOWN.values())


@pytest.mark.parametrize("sight", SEEN)
def test_methods_of_one_dash_differ_for_everybody(sight: str) -> None:
    for (a, one), (b, other) in itertools.combinations(KNOWN.items(), 2):
        if one.dash == other.dash:
            difference = np.linalg.norm(lab(one.colour, SEEN[sight]) - lab(other.colour, SEEN[sight]))
            # a difference of 2.3 is just seen
            assert difference > 15 and one.marker != other.marker, (a, b)


def test_oracles_are_grey_and_differ() -> None:
    oracles = [look_of(name) for name in ("oracle-merge", "oracle-regions", "oracle-merge+oracle-regions")]
    assert {look.colour for look in oracles} == {GREY}
    assert len({(look.dash, look.marker) for look in oracles}) == 3
    assert look_of("oracle-merge[merge.noise_m=0.1]").colour == GREY


def test_a_name_has_one_look_whatever_stands_beside_it() -> None:
    names = [f"tunnelcd[extract.voxel_m=0.{place}]" for place in range(30)] + ["mine", "yours", "\udc80"]
    looks = [look_of(name) for name in names]
    assert looks == [look_of(name) for name in reversed(names)][::-1]
    taken = {(look.colour, look.dash) for look in KNOWN.values()}
    assert all((look.colour, look.dash) not in taken and look.colour in COLOURS for look in looks)
    marked = {(look.colour, look.marker) for look in KNOWN.values()}
    assert all((look.colour, look.marker) not in marked for look in looks), "charts of points have no dash"
    assert KNOWN["tunnelcd"].colour not in {look.colour for look in looks}
    assert len({(look.colour, look.dash, look.marker) for look in looks}) > 25
    assert line_of("mine").marker == "" and line_of("mine").colour == look_of("mine").colour


def test_what_measures_the_rock_looks_like_the_method_of_its_name_and_unlike_the_others() -> None:
    named = [name_variant(each.preset, each.set, each.oracle_merge) for each in load_plan("surface").variants]
    variants = [name for name in named if not is_told_the_truth(name)]
    looks = [look_of(name) for name in variants]
    assert len(variants) == 6
    assert len({(look.colour, look.dash) for look in looks}) == len({(look.colour, look.marker) for look in looks}) == 6
    assert look_of("tunnelcd[surface.method=m3c2-ep,m3c2.normal_m=0.5]") == KNOWN["m3c2-ep"]
    assert look_of("tunnelcd[extract.method=surface,surface.method=planes]") == KNOWN["tunnelcd"]
    new = {(look.colour, look.dash) for look in looks} - {(look.colour, look.dash) for look in KNOWN.values()}
    assert len(new) == 2, "c2m and unrolled propose no regions elsewhere"
