"""Movers on a level floor, without a planner."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cdpipe.core.geometry import make_pose
from scenarios.schema import Mover
from sim.geometry.mesh import Mesh, box_mesh, move_mesh
from sim.movers.course import Course
from sim.movers.kinds import build_body
from sim.movers.mover import MovingBody, make_figure


@pytest.fixture(scope="session")
def floor() -> Mesh:
    return move_mesh(box_mesh((40, 40, 0.05)), make_pose(translation=(0, 0, -0.05)))


@pytest.fixture(scope="session")
def make_body() -> Callable[..., MovingBody]:
    """A mover of some kind that goes to and fro on 10 m of a bend, from (3, 2, 0) on."""

    def make(kind: str, instance: int = 1, offset_s: float = 0.0, **keys: Any) -> MovingBody:
        mover = Mover.model_validate({"name": kind, "kind": kind, **keys})
        way_m = np.linspace(0.0, 10.0, 201)
        yaw = 0.05 * way_m
        step = np.gradient(way_m)
        x, y = 3.0 + np.cumsum(np.cos(yaw) * step), 2.0 + np.cumsum(np.sin(yaw) * step)
        level = np.full(201, 2.4 if kind == "curtain" else 0.0)
        zero = np.zeros(201)
        speed_mps, pause_s = mover.speed_mps or 0.0, mover.pause_s or 0.0
        is_turning = kind == "person"
        points = np.column_stack([x, y, level])
        course = Course(way_m, points, yaw, zero, zero, zero, zero + 0.05, speed_mps, pause_s, offset_s, is_turning)
        return MovingBody(mover, instance, make_figure(build_body(mover), None), course)

    return make
