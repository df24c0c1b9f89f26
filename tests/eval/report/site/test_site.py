"""The picture of the regions of an answer, and the words under it."""

from dataclasses import replace

import numpy as np
import pytest

from cdpipe.core.geometry import Float64Array
from eval.report.site.site import region_picture
from tests.eval.report.site.test_case_view import report


@pytest.mark.parametrize(
    ("radius_m", "n_reported", "words"),
    [
        (4.5, 2, "2 regions of 4.5 m reported"),
        (np.array([10.0, 4.5]), 2, "2 regions of 4.5 to 10 m reported"),
        (np.array([10.0, 4.5]), 1, "1 region of 10 m reported"),
        (np.array([10.0, 4.5]), 0, "0 regions reported"),
    ],
)
def test_the_words_name_the_radii_of_the_reported_regions(
    radius_m: float | Float64Array, n_reported: int, words: str
) -> None:
    answer = report(np.eye(4))
    regions = replace(answer.regions, radius_m=radius_m, is_reported=np.arange(2) < n_reported)
    points = np.random.default_rng(0).uniform(0.0, 10.0, (500, 3)).astype(np.float32)
    picture = region_picture("Regions", points, replace(answer, regions=regions), None, {"regions": []})
    assert picture.caption.startswith(words)
