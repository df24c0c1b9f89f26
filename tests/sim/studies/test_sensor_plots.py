from __future__ import annotations

from pathlib import Path

import matplotlib.image

from sim.studies import sensor_plots
from sim.studies.sensor_plots import draw_plots


def test_every_effect_has_a_plot_that_a_page_can_show(tmp_path: Path) -> None:
    files = draw_plots(tmp_path / "sensor")
    assert [file.stem for file in files] == list(sensor_plots._PLOTS)
    shapes = set()
    for file in files:
        assert file.stat().st_size < 100_000
        pixels = matplotlib.image.imread(file)
        shapes.add(pixels.shape[:2])
        assert 0.02 < (pixels[..., :3].min(axis=-1) < 0.9).mean() < 0.5
    ((height, width),) = shapes  # side by side on a page
    assert height < width
