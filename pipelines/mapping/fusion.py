"""Points that turned out to be one: the older of two takes the place of its double.

Owns what that changes in the map. Which points are one is for the back-end to say.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks

Ids = NDArray[np.int64]


def fuse_points(sparse_map: SparseMap, pairs: Ids) -> Ids:
    """Let the first point of each pair (P, 2) be seen wherever its second one, which dies, was.

    No point may be in two pairs. Returns the pairs of which both points were still alive.
    """
    pairs = pairs[sparse_map.alive[pairs].all(axis=1)]
    if len(pairs) == 0:
        return pairs
    kept, gone = pairs.T
    for index, keyframe in enumerate(sparse_map.keyframes):
        tracks = rename_points(keyframe.tracks, pairs)
        if tracks is not keyframe.tracks:
            sparse_map.replace_tracks(index, tracks)
    for name in ("n_found", "n_visible"):
        column = getattr(sparse_map, name)
        column[kept] += column[gone]
    sparse_map.remove_points(gone)
    return pairs


def rename_points(tracks: Tracks, pairs: Ids) -> Tracks:
    """The tracks with the first point of each pair (P, 2) for its second, each point once.

    The very same tracks where they have none of these.
    """
    order = np.argsort(pairs[:, 1], kind="stable")
    gone, kept = pairs[order, 1], pairs[order, 0]
    place = np.minimum(np.searchsorted(gone, tracks.point_ids), len(gone) - 1)
    is_gone = gone[place] == tracks.point_ids if len(gone) else np.zeros(len(tracks), bool)
    if not is_gone.any():
        return tracks
    ids = np.where(is_gone, kept[place], tracks.point_ids)
    once = ~(is_gone & np.isin(ids, tracks.point_ids))
    return replace(tracks, point_ids=ids)[once]
