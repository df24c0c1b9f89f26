"""The props of a grafted pair, and where its rock moves, rebuilt from its truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, require_poses, transform
from scenarios.grafted import GraftScenario
from sim.graft.rock.heights import list_corners
from sim.placement.placing import Standing
from sim.props.props import shape_of
from sim.session.truth import PairTruth, SurfaceChangeTruth


@dataclass(frozen=True, slots=True, eq=False)
class RockOutline:
    """Where rock of a grafted pair moves.

    Attributes:
        told: What its truth says.
        ring: (5, 3) corners of its rectangle, around it and back to the first one, world frame, metres.
    """

    told: SurfaceChangeTruth
    ring: Float64Array

    @property
    def text(self) -> str:
        """What it is, in words."""
        return f"{self.told.name}, {self.told.kind} {1000 * self.told.largest_m:+.0f} mm"


def outline_rock(truth: PairTruth) -> list[RockOutline]:
    """Return where the rock of a grafted pair moves.

    Raises:
        InputError: The truth is not one of this version.
    """
    try:
        places: list[dict[str, Any]] = (truth.graft or {}).get("rock", [])
        poses = np.array([each["world_T_patch"] for each in places], dtype=np.float64).reshape(-1, 4, 4)
        require_poses("world_T_patch", poses)
        halves = [(float(each["length_m"]) / 2, float(each["width_m"]) / 2) for each in places]
        rings = [np.array([(*corner, 0.0) for corner in list_corners(half_m)])[[0, 1, 2, 3, 0]] for half_m in halves]
        each = zip(truth.surface_changes, poses, rings, strict=True)
        return [RockOutline(told, transform(pose, ring)) for told, pose, ring in each]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"graft is not of this version ({error.__class__.__name__}): graft the pair again") from error


def rebuild_props(truth: PairTruth) -> list[Standing]:
    """Return every prop of a grafted pair at each of its places.

    Raises:
        InputError: The truth is not one of this version.
        ScenarioError: The file of a mesh cannot be used.
    """
    try:
        scenario = GraftScenario.model_validate(truth.scenario)
        props = {prop.name: prop for prop in scenario.props}
        told: list[dict[str, Any]] = (truth.graft or {})["props"]
        poses = np.array([item["world_T_object"] for item in told], dtype=np.float64).reshape(-1, 4, 4)
        require_poses("world_T_object", poses)
        found = [(props[item["name"]], frozenset(item["sessions"]), bool(item["loaded"])) for item in told]
    except (ValidationError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"graft is not of this version ({error.__class__.__name__}): graft the pair again") from error
    shapes = [
        shape_of(prop, truth.seed, loaded_share=prop.loaded_share if is_loaded else None)
        for prop, _, is_loaded in found
    ]
    return [
        Standing(prop, shape, sessions, pose)
        for (prop, sessions, _), shape, pose in zip(found, shapes, poses, strict=True)
    ]
