"""The command that trains networks of many sizes: what it trains, on what, and that it goes on where it stopped."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cdpipe.core.errors import InputError
from cdpipe.descriptors.sphere_network import SphereSize
from cdpipe.training.data import TunnelShard
from eval.studies.descriptors import curves as descriptor_curves
from eval.studies.descriptors.curve_plots import curves_chart, varying
from eval.studies.descriptors.curves import BITS, Point, main, points, select_share


def _tunnels(**n_of: int) -> list[TunnelShard]:
    return [TunnelShard(Path(), family, seed, 1, 1) for family, n in n_of.items() for seed in range(n)]


def test_a_share_is_of_each_family_and_holds_the_smaller_ones() -> None:
    tunnels = _tunnels(narrow=16, wide=20, tight=3)
    shares = [select_share(tunnels, share, seed=1) for share in (0.125, 0.25, 0.5, 1.0)]
    counted = [
        [sum(tunnel.family == family for tunnel in own) for family in ("narrow", "wide", "tight")] for own in shares
    ]
    # round(2.5) is 2, round(0.375) is none and one is the least
    assert counted == [[2, 2, 1], [4, 5, 1], [8, 10, 2], [16, 20, 3]]
    names = [{(tunnel.family, tunnel.seed) for tunnel in own} for own in shares]
    assert all(small < large for small, large in pairwise(names))
    assert shares[3] == tunnels and select_share(tunnels, 0.25, seed=2) != shares[1]


def test_every_network_is_trained_once_and_differs_from_the_base_in_one_thing_or_in_the_head() -> None:
    planned = points(3)
    assert planned[:3] == [Point(seed=seed) for seed in range(3)]
    assert len({point.name for point in planned}) == len(planned) == 3 * 13
    for point in planned:
        size = point.size
        assert (size.per_sector != 4) + (size.width != 1) + (point.share != 1) <= 1
        assert size.reads_after or (size.width, point.share) == (1, 1)


def _table() -> pd.DataFrame:
    rows = [
        {
            "seed": point.seed, "share": point.share, "tunnels": 76 * point.share, "bits": bits,
            "numbers": point.size.numbers, "width": point.size.width, "reads_after": point.size.reads_after,
            **{
                name + group: 0.5 + 0.001 * bits
                for name in ("log_likelihood", "auroc", "unchanged_above_0", "changes_found")
                for group in ("", "_tight")
            },
        }
        for point in points(2)
        for bits in BITS
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_a_panel_shows_what_was_varied_and_the_base_point() -> None:
    table = _table()
    assert sorted(set(varying(table, "numbers", True)["numbers"])) == [16, 32, 64, 128]
    assert sorted(set(varying(table, "numbers", False)["numbers"])) == [16, 32, 64, 128]
    assert sorted(set(varying(table, "width", True)["width"])) == [0.5, 1, 2]
    assert sorted(set(varying(table, "tunnels", True)["tunnels"])) == [9.5, 19, 38, 76]
    for reads_after in (True, False):
        assert sorted(varying(table, "bits", reads_after)["bits"]) == [2, 2, 4, 4, 8, 8, 32, 32]
    assert (varying(table, "width", True)["bits"] == 32).all()


def test_the_chart_shows_every_network_and_the_shipped_one() -> None:
    table = _table()
    shipped = table.head(4).assign(seed=np.nan, share=np.nan, tunnels=np.nan, auroc_tight=0.9)
    rows = curves_chart(pd.concat([table, shipped], ignore_index=True)).rows
    assert [len(row) for row in rows] == [4] * 4
    bits = rows[1][3].series
    (star,) = (each for each in bits if each.name == "family tight, shipped weights")
    assert sorted(zip(star.x, star.y, strict=True)) == [(2, 0.9), (4, 0.9), (8, 0.9), (32, 0.9)]
    (line,) = (each for each in bits if each.name == "all validation tunnels, reads the after image")
    assert list(line.x) == [2, 4, 8, 32]
    np.testing.assert_allclose(line.y, 0.5 + 0.001 * np.array([2, 4, 8, 32]))
    # shares are shown in percent
    assert np.max(rows[2][3].series[0].y) == pytest.approx(100 * 0.532)


def test_the_command_goes_on_where_it_was_cut_off(
    training_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = [Point(SphereSize(width=0.5)), Point(SphereSize(per_sector=1, width=0.5, reads_after=False))]
    monkeypatch.setattr(descriptor_curves, "points", lambda seeds: small[:seeds])
    main(training_data, tmp_path, steps=2, seeds=1)
    first = pd.read_csv(tmp_path / "curves.csv")
    assert first["point"].unique().tolist() == ["shipped", small[0].name]
    assert first["bits"].tolist() == 2 * list(BITS) and first["bytes"].tolist() == 2 * [256, 64, 32, 16]
    assert first["seed"].isna().sum() == 4 and (first["n_changes"] == 1).all()
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    capsys.readouterr()
    main(training_data, tmp_path, steps=2, seeds=2)
    assert small[0].name not in capsys.readouterr().out  # kept, the other one alone is trained
    second = pd.read_csv(tmp_path / "curves.csv")
    pd.testing.assert_frame_equal(second.head(8), first, check_dtype=False)
    assert second["bytes"].tolist()[8:] == [64, 16, 8, 4] and second["n_weights"].iloc[8] < second["n_weights"].iloc[4]
    # without its row a network is measured again, and not trained
    first.to_csv(tmp_path / "curves.csv", index=False)
    main(training_data, tmp_path, steps=2, seeds=2)
    again = pd.read_csv(tmp_path / "curves.csv")
    pd.testing.assert_frame_equal(again.drop(columns="cpu_s"), second.drop(columns="cpu_s"), check_dtype=False)


def test_rows_of_another_schedule_are_not_mixed(
    training_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptor_curves, "points", lambda _: [])
    main(training_data, tmp_path, steps=2, seeds=1)
    with pytest.raises(InputError, match="another number of steps"):
        main(training_data, tmp_path, steps=3, seeds=1)
    (tmp_path / "curves.csv").write_text("point\nshipped\n")
    with pytest.raises(InputError, match="damaged"):
        main(training_data, tmp_path, steps=2, seeds=1)
