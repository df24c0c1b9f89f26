"""The props of a grafted pair, rebuilt from its truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import require_poses
from scenarios.grafted import GraftScenario
from sim.placement.placing import Standing
from sim.props.props import shape_of
from sim.session.truth import PairTruth


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
