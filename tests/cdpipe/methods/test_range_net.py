"""`range-net` between the network and the regions: which keyframes show the maps, and what becomes of probabilities."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array, Int64Array
from cdpipe.descriptors.change_network import make_untrained_change_network
from cdpipe.descriptors.weights_file import digest, numbered_checkpoint_bytes
from cdpipe.methods import range_net as method
from cdpipe.methods.range_net import range_net
from cdpipe.methods.registry import load_source
from cdpipe.methods.whole_map import PlacedMaps
from cdpipe.model.config import RangeNetConfig, load_config
from cdpipe.model.types import MergedMaps, SessionName
from tests.cdpipe.methods.test_rivals import answer, crate, pair


def test_a_point_is_new_from_the_threshold_on(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[SessionName, Mapping[SessionName, Int64Array]] = {}

    def probabilities(
        merged: MergedMaps,
        session: SessionName,
        other: SessionName,
        scans: Mapping[SessionName, Int64Array],
        config: RangeNetConfig,
    ) -> Float64Array:
        asked[session] = scans
        return np.array([0.0, 0.3, 0.5, 0.7])

    monkeypatch.setattr(method, "change_probabilities", probabilities)
    merged = pair([], [])
    path = {name: merged.to_map(name, merged.map_of(name).odom_T_keyframe[:, :3, 3]) for name in ("before", "after")}
    # the after session is believed to have driven 20 m farther along x: half of either path is beside the other
    path["after"] = path["after"] + (20.0, 0.0, 0.0)
    maps = PlacedMaps(merged, {}, path, {})
    for threshold, expected in ((0.5, [False, False, True, True]), (0.3, [False, True, True, True])):
        config = load_config("range-net", [f"range_net.threshold={threshold}", "query.max_pair_m=2"])
        assert range_net.new_mask(maps, "after", "before", config).tolist() == expected
    assert asked["after"]["before"].tolist() == list(range(18, 40))
    assert asked["after"]["after"].tolist() == list(range(22))


def test_what_the_network_marks_becomes_regions_and_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    new = crate(20.0)  # 4 x 4 x 4 points, the last ones of the after map

    def probabilities(merged: MergedMaps, session: SessionName, *rest: object) -> Float64Array:
        found = np.zeros(len(merged.map_of(session).points))
        found[-len(new) :] = session == "after"
        return found

    monkeypatch.setattr(method, "change_probabilities", probabilities)
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(numbered_checkpoint_bytes(make_untrained_change_network()))
    settings = ("query.threshold=0", "outlier.sigmas=10", f"range_net.weights={weights}")
    config = load_config("range-net", settings)
    assert load_source(config).has_clusters
    report = answer(pair([], [new]), config)
    assert report.checkpoints["range-net"] == digest(weights.read_bytes())
    assert report.regions.scores.tolist() == [64.0]
    np.testing.assert_allclose(report.regions.centres_map, [[20.4, 0.0, 1.6]], atol=1e-9)
    (item,) = report.objects
    assert (item.session, item.kind, len(item.returns)) == ("after", "added", 64)
    by_nearest = answer(pair([], [new]), load_config("range-net", [*settings, "extract.method=nearest"]))
    assert [(each.session, len(each.returns)) for each in by_nearest.objects] == [("after", 64)]
