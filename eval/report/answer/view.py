"""One answer as a view for the browser (viser): maps, objects, regions, rock that moved, and where the sensors were."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from cdpipe.core.geometry import Float64Array
from eval.report.answer.content import AnswerContent
from eval.report.answer.layers import ELSEWHERE, MOVED_ROCK, OBJECT_POINT_M, Layer, list_layers
from eval.report.answer.shapes import AFTER_RGB, BEFORE_RGB
from eval.report.answer.tables import object_place
from sim.geometry.mesh import Mesh, cylinder_mesh
from sim.view.returns import CHANGE_RGB, Cloud, Rgb
from sim.view.view import Label, Line, Play, Surface, View

_SENSOR_M = 0.12
_ASIDE = np.array([-7.0, -7.0, 9.0])
_SHARE = 0.5  # of a point's edge on the page: here points are square


def view_answer(content: AnswerContent) -> View:
    """Return the view of an answer; its slider moves both sensors along their paths."""
    layers = [layer for layer in list_layers(content) if layer.group != ELSEWHERE]
    clouds = [_cloud(each) for each in layers if each.kind == "points" and each.group not in CHANGE_RGB]
    labels, path, play = tuple(_labels(content)), content.paths[0], _play(content)
    target = labels[0].position if labels else path[len(path) // 2]
    lines, shown = tuple(_lines(layers)), (*clouds, *_objects(content))
    view = View(str(content.report), (), (), lines, shown, labels, target + _ASIDE, target)
    return replace(view, play=play, legend=tuple(_legend(layers)))


def _legend(layers: Sequence[Layer]) -> Iterator[tuple[Rgb, str]]:
    """Yield the colours of what is visible at first, maps and roofs once."""
    names = {each.group if each.kind == "line" else each.name or each.group: each for each in layers if each.is_shown}
    return ((each.rgb, name) for name, each in names.items())


def _lines(layers: Sequence[Layer]) -> Iterator[Line]:
    """Yield regions and paths; the stretches of a path have one name, with a number from the second one on."""
    counts: Counter[str] = Counter()
    for each in (layer for layer in layers if layer.kind == "line"):
        group = "regions/region" if each.group == "regions" else f"paths/{each.group.removeprefix('path ')}"
        counts[group] += 1
        yield Line(group if counts[group] == 1 else f"{group} {counts[group]}", each.points, each.rgb)


def _objects(content: AnswerContent) -> Iterator[Cloud]:
    for index, item in enumerate(content.report.objects):
        if len(item.points_map):
            colours = _colours(CHANGE_RGB[item.kind], len(item.points_map))
            points = item.points_map.astype(np.float32)
            yield Cloud(f"changes/{item.kind}/object {index}", points, colours, _SHARE * OBJECT_POINT_M)


def _labels(content: AnswerContent) -> Iterator[Label]:
    for index, item in enumerate(content.report.objects):
        if len(item.points_map):
            top = np.array([*object_place(item)[:2], item.points_map[:, 2].max() + 0.2])
            yield Label(f"names/{index}", top, f"{index} {item.kind}")


def _play(content: AnswerContent) -> Play:
    """Return what shows the sensors at a share of both paths."""
    body = cylinder_mesh(_SENSOR_M, _SENSOR_M, 24)

    def place(path: Float64Array, share: float) -> Mesh:
        return Mesh(body.vertices + path[min(int(share * len(path)), len(path) - 1)], body.faces)

    def play(share: float) -> tuple[tuple[Surface, ...], tuple[Cloud, ...]]:
        both = zip(("before", "after"), content.paths, (BEFORE_RGB, AFTER_RGB), strict=True)
        return tuple(Surface(f"sensor/{name}", place(path, share), rgb) for name, path, rgb in both), ()

    return play


def _cloud(layer: Layer) -> Cloud:
    name = f"displacement/{layer.name}" if layer.group == MOVED_ROCK else layer.group.replace(" ", "/")
    points = layer.points.astype(np.float32)
    return Cloud(name, points, _colours(layer.rgb, len(points)), _SHARE * layer.size_m, layer.is_shown)


def _colours(rgb: Rgb, n: int) -> dict[str, npt.NDArray[np.uint8]]:
    return {"kind": np.tile(np.array(rgb, dtype=np.uint8), (n, 1))}
