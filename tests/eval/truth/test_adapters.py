"""What a registered method is handed: arrays, and nothing that leads to the folder in which the truth lies."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from cdpipe.model.config import load_config
from cdpipe.pipeline import map_session
from eval.truth.adapters import pipeline_input
from scenarios.library import load_scenario
from sim.session.simulate import simulate_pair

SMALL = ("sensor.mode=512x10", "platform.scan_spacing_m=1.0")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gallery") / "20417"
    simulate_pair(load_scenario("smoke/one_box", 11, SMALL), 11, path)
    return path


@pytest.mark.parametrize("preset", ["tunnelcd", "voxel-diff"])
def test_maps_and_descriptors_name_no_folder(pair: Path, preset: str) -> None:
    source = pipeline_input(pair, "after")
    assert str(pair) in source.name  # the pipeline's messages name it; what a method gets does not
    content = pickle.dumps(map_session(source, load_config(preset)))
    assert len(content) > 100_000
    for secret in (str(pair), "20417", "gallery", "one_box", "/after"):
        assert secret.encode() not in content
