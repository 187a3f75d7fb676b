"""Points and the views that saw them, as the batch estimates them: flat arrays, sorted by track.

Owns the choice of sightings and their order. A *view* is a body (the static world or one object) as
one frame's camera saw it; a *track* is one point of one body in all its views.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import Sightings
from pipelines.types import Array

Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PointTracks:
    """N sightings of P tracks in V views, sorted by track and then by view.

    view, track: (N,) int64. carried: (N,) share of the error of the sighting before, in these
    arrays, that goes on in this one: 1 where errors walk, 0 where it was not followed from there.
    uv_px: (N, 2). disparity_px: (N,) NaN where unknown. sigma_uv_px: (N,) of what is new in the
    error where followed, else of the place. sigma_disparity_px: (N,). n_tracks, n_views: P and V.
    """

    view: Index
    track: Index
    carried: Array
    uv_px: Array
    disparity_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: Array
    n_tracks: int
    n_views: int

    def __len__(self) -> int:
        return len(self.view)

    @property
    def is_followed(self) -> NDArray[np.bool_]:
        """(N,) whether a sighting was followed from the one before it in these arrays."""
        return self.carried > 0.0

    @property
    def starts(self) -> Index:
        """(P,) row of the first sighting of each track."""
        return np.searchsorted(self.track, np.arange(self.n_tracks))

    @property
    def lengths(self) -> Index:
        """(P,) sightings of each track."""
        return np.bincount(self.track, minlength=self.n_tracks)

    def of_tracks(self, keep: NDArray[np.bool_]) -> PointTracks:
        """The tracks chosen by a boolean mask (P,), numbered anew; views stay."""
        rows = keep[self.track]
        number = np.cumsum(keep) - 1
        arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self)[:7]}
        arrays["track"] = number[arrays["track"]]
        return PointTracks(**arrays, n_tracks=int(keep.sum()), n_views=self.n_views)

    def parts(self, most: int) -> Iterator[tuple[slice, slice, PointTracks]]:
        """The tracks and rows of consecutive parts of about `most` sightings, each from track 0."""
        ends = np.cumsum(self.lengths)
        begin, row = 0, 0
        while begin < self.n_tracks:
            end = max(begin + 1, int(np.searchsorted(ends, row + most, side="right")))
            rows = slice(row, int(ends[end - 1]))
            arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self)[:7]}
            arrays["track"] = arrays["track"] - begin
            part = PointTracks(**arrays, n_tracks=end - begin, n_views=self.n_views)
            yield slice(begin, end), rows, part
            begin, row = end, rows.stop

    def with_sigmas(self, sigma_uv_px: Array, sigma_disparity_px: Array) -> PointTracks:
        """The same with other weights, (N,) each."""
        return replace(self, sigma_uv_px=sigma_uv_px, sigma_disparity_px=sigma_disparity_px)


def build_tracks(
    sightings: Sightings, body: Index, view: Index, frame_order: Index, n_views: int
) -> tuple[PointTracks, Index]:
    """Tracks of at least two views, and for each of their N sightings its row in `sightings`.

    body: (S,) int64, which body each sighting belongs to, -1 for none. view: (S,) its view.
    frame_order: (S,) position of its frame among those tracked: a sighting is followed from one in
    the frame just before.
    """
    rows = np.flatnonzero(body >= 0)
    if len(rows) == 0:
        nothing, none = np.empty(0, np.int64), np.empty(0)
        tracks = PointTracks(nothing, nothing, none, np.empty((0, 2)), none, none, none, 0, n_views)
        return tracks, nothing
    order = np.lexsort((view[rows], sightings.track_id[rows], body[rows]))
    rows = rows[order]
    b, t, k = body[rows], sightings.track_id[rows], frame_order[rows]
    same = np.r_[False, (np.diff(b) == 0) & (np.diff(t) == 0)]
    double = same & np.r_[False, np.diff(k) == 0]
    rows, b, k, same = rows[~double], b[~double], k[~double], same[~double]
    track = np.cumsum(~same) - 1
    long = np.bincount(track)[track] >= 2 if len(track) else np.zeros(0, bool)
    rows, k, same = rows[long], k[long], same[long]
    track = np.cumsum(~same) - 1
    chosen = sightings[rows]
    tracks = PointTracks(
        view[rows],
        track,
        (same & np.r_[False, np.diff(k) == 1][: len(k)]).astype(np.float64),
        chosen.uv_px,
        chosen.disparity_px,
        chosen.sigma_uv_px,
        chosen.sigma_disparity_px,
        int(track[-1]) + 1 if len(track) else 0,
        n_views,
    )
    return tracks, rows
