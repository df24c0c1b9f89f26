"""Groups of points that are near to one another."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cdpipe.core.geometry.arrays import Float64Array, Int64Array


def label_groups(points: Float64Array, link_m: float) -> tuple[Int64Array, Int64Array]:
    """Return the (N,) connected component of each point and the size of every component.

    Two of the (N, 3) points are neighbours if they are within `link_m` of each other.
    """
    n = len(points)
    if n == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    # a tree that is searched once pays neither for balance nor for tight boxes
    pairs = cKDTree(points, balanced_tree=False, compact_nodes=False).query_pairs(link_m, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, labels = connected_components(graph, directed=False)
    return labels.astype(np.int64), np.bincount(labels)
