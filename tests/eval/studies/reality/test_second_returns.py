"""Figures of second returns: closed forms on synthetic data, those of the real revolution, the command."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from cdpipe.core.errors import InputError
from cdpipe.sensor.ouster import load_profile
from eval.studies.reality import second_returns
from eval.studies.reality.reality import find_data
from eval.studies.reality.scenes import find_recording, plan_drive
from eval.studies.reality.second_returns import (
    PROFILE,
    RECORDING,
    DualReturns,
    arrange_by_source,
    compare,
    main,
    read_real_returns,
    split_returns,
    tabulate_second_returns,
)
from eval.studies.reality.sensor_measures import stagger

SENSOR = load_profile("os0-32-nominal", "1024x10")
SHAPE = (1, SENSOR.height, SENSOR.width)


def with_returns(
    first_m: np.ndarray, second_m: np.ndarray, signals: tuple[float, float] = (100.0, 40.0)
) -> DualReturns:
    staggered = [stagger(SENSOR, image) for image in (first_m, second_m)]
    signal = [np.where(image > 0, each, 0.0) for image, each in zip(staggered, signals, strict=True)]
    both = [np.concatenate(pair, axis=-2) for pair in (staggered, signal, signal)]
    return split_returns(SENSOR, both)


def values(returns: DualReturns) -> pd.Series:
    return tabulate_second_returns(returns, "x").set_index("figure")["value"]


def test_second_returns_are_counted_among_first_ones() -> None:
    first_m, second_m = np.full(SHAPE, 5.0), np.zeros(SHAPE)
    first_m[..., 0] = 0.0
    second_m[..., 10:20], second_m[..., 20:25] = 8.0, 3.0
    found = values(with_returns(first_m, second_m))
    assert found["beams with a second return, of those with a first"] == pytest.approx(15 / 1023)
    assert found["of these, the second lies behind the first"] == pytest.approx(10 / 15)
    assert found["of these, the second is stronger"] == 0.0
    assert found["signal of the second by that of the first, median"] == pytest.approx(0.4)
    assert found["distance between both returns, 5th percentile, m"] == pytest.approx(2.0)
    assert found["distance between both returns, 95th percentile, m"] == pytest.approx(3.0)


def test_a_second_return_stays_with_its_beam() -> None:
    first_m, second_m = np.full(SHAPE, 5.0), np.zeros(SHAPE)
    second_m[0, 3, 7] = 6.0
    has_both = with_returns(first_m, second_m).has_both
    assert np.argwhere(has_both).tolist() == [[0, 3, 7]]


def test_beams_at_jumps_are_counted_by_height() -> None:
    first_m, second_m = np.full(SHAPE, 5.0), np.zeros(SHAPE)
    first_m[..., 100:200] = 6.5  # two jumps of 1.5 m a row
    second_m[..., 99], second_m[..., 500] = 6.5, 9.0
    found = values(with_returns(first_m, second_m))
    # four pixels a row lie at a jump, one of them has a second return
    assert found["beams with a second return, at a jump of 1 to 2 m"] == pytest.approx(0.25)
    assert np.isnan(found["beams with a second return, at a jump of 2 to 8 m"])


def test_no_second_return_is_no_figure_of_them() -> None:
    found = values(with_returns(np.full(SHAPE, 5.0), np.zeros(SHAPE)))
    assert found["beams with a second return, of those with a first"] == 0.0
    assert found.drop("beams with a second return, of those with a first").isna().all()


def real_recording() -> Path:
    try:
        return find_recording(find_data(None), RECORDING)
    except InputError as error:
        pytest.skip(str(error))


def test_figures_of_the_real_revolution() -> None:
    found = values(read_real_returns(real_recording()))
    assert found["beams with a second return, of those with a first"] == pytest.approx(0.00264, abs=1e-5)
    assert found["of these, the second is stronger"] == 0.0
    assert found["distance between both returns, 50th percentile, m"] == pytest.approx(0.798)


def test_the_simulator_makes_as_many_second_returns_as_the_real_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    real = read_real_returns(real_recording())
    monkeypatch.setattr(second_returns, "WORLDS", (("narrow", 10001),))
    table = arrange_by_source(compare(real, [plan_drive("narrow", 10001, real.first.sensor, PROFILE)]))
    assert list(table.columns) == ["figure", "real", "real scene", "narrow 10001"]
    shares = table.set_index("figure").loc["beams with a second return, of those with a first"]
    assert (shares > 0.5 * shares["real"]).all()
    assert (shares < 2.0 * shares["real"]).all()


def test_without_the_recording_one_line_says_what_is_wanted(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(main)
    result = CliRunner().invoke(app, ["--out", str(tmp_path / "out"), "--data", str(tmp_path)])
    assert isinstance(result.exception, InputError)
    assert RECORDING in str(result.exception)
    assert not (tmp_path / "out").exists()
