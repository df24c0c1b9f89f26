from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.io.readers import open_session
from cdpipe.io.session import read_session
from cdpipe.mapping.mapping import build_map
from cdpipe.model.config import load_config
from eval.studies.session_maps import find_dynamic, main, measure_accuracy
from scenarios import load_scenario
from scenarios.schema import Scenario
from sim.session.truth import read_labels, read_pair_truth

WALKER = "movers=[{name: walker, kind: person, path: {length_m: 6}, speed_mps: 1.2, sessions: after}]"
SMALL = ["sensor.mode=512x10", "platform.scan_spacing_m=0.5", WALKER]


def test_accuracies_by_hand() -> None:
    is_dynamic = np.array([True, True, True, True, False, False, False, False, False])
    is_dropped = np.array([True, True, True, False, True, False, False, False, False])
    found = measure_accuracy(is_dynamic, is_dropped)
    assert found == pytest.approx({"SA": 0.8, "DA": 0.75, "AA": np.sqrt(0.6), "HA": 2 * 0.6 / 1.55})
    assert measure_accuracy(is_dynamic, np.zeros(9, np.bool_)) == {"SA": 1.0, "DA": 0.0, "AA": 0.0, "HA": 0.0}
    clean = measure_accuracy(np.zeros(9, np.bool_), is_dropped)
    assert clean["SA"] == pytest.approx(5 / 9)
    assert np.isnan([clean["DA"], clean["AA"], clean["HA"]]).all()


@pytest.fixture(scope="module")
def pair(simulated_once: Callable[[Scenario, int], Path]) -> Path:
    return simulated_once(load_scenario("smoke/unchanged", 3, SMALL), 3)


def test_a_point_is_dynamic_by_its_returns(pair: Path) -> None:
    (mover,) = read_pair_truth(pair).movers
    assert mover.session == "after"
    point_map = build_map(open_session(pair / "after"), load_config("tunnelcd", {"map.movers": "keep"}).map)
    found = find_dynamic(point_map, pair / "after", [mover.instance])
    assert found.sum() > 30
    # counted return by return
    wanted = np.zeros((len(found), 2), dtype=np.int64)
    n_chunks = read_session(pair / "after").n_chunks
    instances = np.concatenate([each for each, _ in read_labels(pair / "after", n_chunks)])
    for scan, instance in enumerate(instances):
        own = slice(*point_map.scan_offsets[scan : scan + 2])
        for point, pixel in zip(point_map.return_points[own], point_map.return_pixels[own], strict=True):
            wanted[point, int(instance.flat[pixel] == mover.instance)] += 1
    np.testing.assert_array_equal(found, wanted[:, 1] > wanted[:, 0])
    assert not find_dynamic(point_map, pair / "after", []).any()


def test_the_table_has_each_session_and_cleaning(pair: Path, tmp_path: Path) -> None:
    pytest.importorskip("dufomap", reason="pip install 'tunnelcd[dufomap]'")
    main([pair], tmp_path / "maps.csv")
    table = pd.read_csv(tmp_path / "maps.csv").set_index(["session", "cleaning"])
    assert len(table) == 6
    assert (table.SA > 0.9).all()
    assert table.DA["before"].isna().all()
    assert table.DA["after", "keep"] == 0 < table.DA["after", "map.movers=drop"]
    assert table.DA["after", "dufomap"] > 0.3
