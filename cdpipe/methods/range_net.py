"""A learned comparison of range images, plain torch: which pixels of one map's images are not in the other's.

Both maps are rendered at the keyframes of both sessions. A network with a head for changes and one for visibility, as
in Chamelion (arXiv 2602.08189), compares the images; map points take the probabilities of their pixels. A point is new
if the mean over the keyframes that see it reaches a threshold.
"""

from __future__ import annotations

from cdpipe.core.geometry import BoolArray
from cdpipe.descriptors import change_probabilities
from cdpipe.extract.crops import DIRECTIONS
from cdpipe.extract.point_comparison import is_within
from cdpipe.methods.whole_map import PlacedMaps, WholeMap
from cdpipe.model.config import PipelineConfig
from cdpipe.model.types import SessionName


@WholeMap
def range_net(maps: PlacedMaps, session: SessionName, other: SessionName, config: PipelineConfig) -> BoolArray:
    """Mark the map points of `session` that the network calls changed.

    Args:
        maps: Both maps.
        session: The session whose points are marked.
        other: The session with which they are compared.
        config: `range_net` and `query.max_pair_m` are used: keyframes farther than that from the other path show no
            images.

    Returns:
        (N,) mask of the points of `session`.

    Raises:
        InputError: The weights are missing or cannot be used.
    """
    scans = {
        here: maps.merged.map_of(here).keyframe_scans[
            is_within(maps.path[here], maps.path[there], config.query.max_pair_m)
        ]
        for here, there in DIRECTIONS
    }
    probabilities = change_probabilities(maps.merged, session, other, scans, config.range_net)
    return probabilities >= config.range_net.threshold
