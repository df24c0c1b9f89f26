"""Where movers were seen, as the truth of a pair holds it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import make_pose
from eval.truth.ground_truth import load_ground_truth
from sim.session.truth import MoverTrack, MoverTruth, PairTruth, read_pair_truth, write_mover_track, write_pair_truth


def add_movers(pair: Path, n_scans: int = 14) -> None:
    """Two movers of the after session; the first was seen in revolutions 3 and 5."""
    truth = read_pair_truth(pair)
    movers = tuple(MoverTruth(name, "person", 9, "after", 0.0, 0.0, 7) for name in ("one", "two"))
    write_pair_truth(pair, PairTruth(truth.family, truth.seed, 3.0, truth.changes, truth.scenario, {}, movers))
    n_returns, seen = np.zeros((2, n_scans), np.int32), np.full((2, n_scans, 3), np.nan)
    n_returns[0, [3, 5]], seen[0, [3, 5]] = (4, 3), [(1, 2, 3), (4, 5, 6)]
    poses = np.broadcast_to(make_pose(), (2, n_scans, 4, 4)).copy()
    write_mover_track(pair / "after", MoverTrack(poses, n_returns, seen))


def test_the_places_where_movers_gave_returns_are_read(tiny_pair: Path) -> None:
    assert load_ground_truth(tiny_pair).after.seen_movers_world.shape == (0, 3)
    add_movers(tiny_pair)
    truth = load_ground_truth(tiny_pair)
    np.testing.assert_array_equal(truth.after.seen_movers_world, [(1, 2, 3), (4, 5, 6)])
    assert truth.before.seen_movers_world.shape == (0, 3)
    assert [mover.name for mover in truth.pair.movers] == ["one", "two"]


def test_places_of_another_session_are_refused(tiny_pair: Path) -> None:
    add_movers(tiny_pair, n_scans=13)
    told = (
        "after/truth/movers.npz: not the truth of this session: it has 2 movers and 13 revolutions, expected 2 and 14"
    )
    with pytest.raises(InputError, match=told):
        load_ground_truth(tiny_pair)
    (tiny_pair / "after" / "truth" / "movers.npz").unlink()
    with pytest.raises(InputError, match="it has 0 movers and 14 revolutions, expected 2 and 14"):
        load_ground_truth(tiny_pair)
