"""What a batch estimates: cameras, object poses and points, with where each of them starts.

Owns the turning of the observation log and of the front-end's objects into arrays. Solves nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.point_tracks import Index, PointTracks, build_tracks
from pipelines.frame_observations import STATIC, FrameObservations, Sightings
from pipelines.geometry import invert_T
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array, StereoCamera

_CORRELATION_PX = 20.0  # errors of flow are alike over a patch: see `objects.motion`
_MEASURED = (str(ObjectState.MOVING), str(ObjectState.STOPPED))


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of frames in which the front-end knew each motion of one object.

    frames: (n,) positions in `BatchProblem.frame_index`, one after the other. rows: (n,) of the
    object's estimates, -1 for a first frame that has none. first_pose: where its poses begin among
    all object poses.
    """

    object_id: int
    class_name: str
    frames: Index
    rows: Index
    first_pose: int

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def poses(self) -> slice:
        """Its poses among all object poses."""
        return slice(self.first_pose, self.first_pose + len(self))


@dataclass(frozen=True, slots=True)
class BatchProblem:
    """F cameras, O object poses and P points, as they start, and all that was seen of them.

    frame_index, timestamps_s: (F,) of the tracked frames. Ts_world_camera: (F, 4, 4).
    Ts_world_object: (O, 4, 4) of all stretches in a row. points_m: (P, 3) each in its body: the
    world or the object. tracks: of V = F + O views; view v < F is the static world in frame v, and
    view F + o the body of object pose o. sighting_rows: (N,) each one's row in the log.
    """

    camera: StereoCamera
    frame_index: Index
    timestamps_s: Array
    Ts_world_camera: Array
    stretches: tuple[Stretch, ...]
    Ts_world_object: Array
    points_m: Array
    tracks: PointTracks
    sighting_rows: Index

    @property
    def n_frames(self) -> int:
        """F."""
        return len(self.frame_index)

    @property
    def camera_of_view(self) -> Index:
        """(V,) which camera each view belongs to."""
        return np.concatenate([np.arange(self.n_frames), *(s.frames for s in self.stretches)])

    @property
    def body_of_view(self) -> Index:
        """(V,) 0 for the static world, s + 1 for stretch s."""
        lengths = [self.n_frames, *(len(s) for s in self.stretches)]
        return np.repeat(np.arange(len(lengths)), lengths)

    def views(self, Ts_world_camera: Array, Ts_world_object: Array) -> Array:
        """(V, 4, 4) T_body_camera: X, and P = inv(L) X of each object pose."""
        of_objects = (
            invert_T(Ts_world_object) @ Ts_world_camera[self.camera_of_view[self.n_frames :]]
        )
        return np.concatenate([Ts_world_camera, of_objects])

    def with_tracks(self, tracks: PointTracks, sighting_rows: Index) -> BatchProblem:
        """The same problem with other sightings of the same points."""
        return replace(self, tracks=tracks, sighting_rows=sighting_rows)

    def at(self, Ts_world_camera: Array, Ts_world_object: Array, points_m: Array) -> BatchProblem:
        """The same problem from another start."""
        return replace(
            self,
            Ts_world_camera=Ts_world_camera,
            Ts_world_object=Ts_world_object,
            points_m=points_m,
        )


def build_problem(
    camera: StereoCamera,
    log: Sequence[FrameObservations],
    objects: ObjectEstimates,
    max_static_per_frame: int = 0,
) -> BatchProblem:
    """The problem of all frames in a log. objects: the front-end's; `empty` leaves them out.

    Rows that tell a motion (moving or stopped) enter, those without one end a stretch.
    max_static_per_frame: longest tracks first, evenly over the image; 0 = all.
    """
    tracked = [entry for entry in log if entry.is_tracked]
    frame_index = np.array([entry.frame_index for entry in tracked], np.int64)
    Ts = np.array([entry.T_world_camera for entry in tracked]).reshape(-1, 4, 4)
    stretches, Ls = find_stretches(frame_index, objects)
    sightings = Sightings.concatenate(*(entry.sightings for entry in log))
    position = np.searchsorted(frame_index, sightings.frame_index)
    position[position == len(frame_index)] = 0
    known = np.isin(sightings.frame_index, frame_index)
    F = len(frame_index)
    body = np.full(len(sightings), -1, np.int64)
    view = np.full(len(sightings), -1, np.int64)
    static = known & (sightings.object_id == STATIC)
    body[static], view[static] = 0, position[static]
    by_object = np.argsort(sightings.object_id, kind="stable")
    ids = np.array([stretch.object_id for stretch in stretches], np.int64)
    begins, ends = (
        np.searchsorted(sightings.object_id, ids, side, by_object) for side in ("left", "right")
    )
    for s, stretch in enumerate(stretches):
        first, last = stretch.frames[0], stretch.frames[-1]
        own = by_object[begins[s] : ends[s]]
        own = own[known[own] & (position[own] >= first) & (position[own] <= last)]
        body[own], view[own] = s + 1, F + stretch.first_pose + position[own] - first
    tracks, rows = build_tracks(sightings, body, view, position, F + len(Ls))
    problem = BatchProblem(
        camera,
        frame_index,
        np.array([entry.timestamp_s for entry in tracked]),
        Ts,
        stretches,
        Ls,
        np.empty((0, 3)),
        tracks,
        rows,
    )
    if max_static_per_frame:
        keep = tracks.view[tracks.starts] >= F
        keep |= choose_longest(tracks, camera, max_static_per_frame, F)
        problem = replace(
            problem, tracks=tracks.of_tracks(keep), sighting_rows=rows[keep[tracks.track]]
        )
    return replace(
        problem,
        tracks=weigh(problem.tracks),
        points_m=_last_positions(problem, sightings.position_m),
    )


def find_stretches(
    frame_index: Index, objects: ObjectEstimates
) -> tuple[tuple[Stretch, ...], Array]:
    """Stretches of known motion, and the poses (O, 4, 4) of all of them in a row.

    frame_index: (F,) of the tracked frames. A motion leads from the tracked frame before; the pose
    there is known by it too.
    """
    told = np.isfinite(objects.Hs_world_curr_prev).all((1, 2))
    told &= np.isfinite(objects.Ts_world_object).all((1, 2))
    told &= np.isin(objects.state, _MEASURED) & np.isin(objects.frame_index, frame_index[1:])
    position = np.searchsorted(frame_index, objects.frame_index)
    stretches: list[Stretch] = []
    poses: list[Array] = []
    for object_id in np.unique(objects.object_id[told]):
        own = np.flatnonzero(told & (objects.object_id == object_id))
        own = own[np.argsort(position[own], kind="stable")]
        every = np.flatnonzero(objects.object_id == object_id)
        row_at = dict(zip(position[every].tolist(), every.tolist(), strict=True))
        for rows in np.split(own, np.flatnonzero(np.diff(position[own]) != 1) + 1):
            L = objects.Ts_world_object[rows[0]]
            Hs = objects.Hs_world_curr_prev[rows]
            chain = [invert_T(Hs[0]) @ L, L]
            for H in Hs[1:]:
                chain.append(H @ chain[-1])
            before = int(position[rows[0]]) - 1
            stretches.append(
                Stretch(
                    int(object_id),
                    str(objects.class_name[rows[-1]]),
                    np.r_[before, position[rows]],
                    np.r_[_row_of(objects, row_at, before, frame_index), rows],
                    len(poses),
                )
            )
            poses += chain
    return tuple(stretches), np.array(poses).reshape(-1, 4, 4)


def _row_of(
    objects: ObjectEstimates, row_at: dict[int, int], position: int, frame_index: Index
) -> int:
    row = row_at.get(position, -1)
    return row if row >= 0 and objects.frame_index[row] == frame_index[position] else -1


def _last_positions(problem: BatchProblem, position_m: Array) -> Array:
    """(P, 3) each point in its body, where the front-end's filter had it in the end."""
    tracks = problem.tracks
    last = tracks.starts + tracks.lengths - 1
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)[tracks.view[last]]
    in_camera = np.asarray(position_m[problem.sighting_rows[last]], np.float64)
    return np.einsum("pij,pj->pi", views[:, :3, :3], in_camera) + views[:, :3, 3]


def weigh(tracks: PointTracks) -> PointTracks:
    """The tracks with pixel sigmas raised by how far they outnumber their witnesses.

    Points found again are witnesses of their own: what led the others here did not lead them.
    """
    begins = np.zeros(len(tracks), bool)
    begins[tracks.starts] = True
    group = 2 * tracks.view + (~tracks.is_followed & ~begins)
    first = witnesses(group, tracks.uv_px)
    n_cells = np.bincount(group[first], minlength=2 * tracks.n_views)
    n_points = np.bincount(group, minlength=2 * tracks.n_views)
    factor = np.sqrt(n_points / np.maximum(n_cells, 1))[group]
    return tracks.with_sigmas(tracks.sigma_uv_px * factor, tracks.sigma_disparity_px)


def witnesses(group: Index, uv_px: Array) -> Index:
    """Rows, one of each patch of the image in each group (N,), in which errors of pixels are alike.

    uv_px: (N, 2). So many are witnesses, however many sightings there are.
    """
    cell = np.floor(uv_px / _CORRELATION_PX).astype(np.int64)
    cell -= cell.min(0, initial=0)
    wide, high = (int(n) + 1 for n in cell.max(0, initial=0))
    return np.unique((group * high + cell[:, 1]) * wide + cell[:, 0], return_index=True)[1]


def choose_longest(
    tracks: PointTracks, camera: StereoCamera, most: int, n_views: int | None = None
) -> NDArray[np.bool_]:
    """(P,) which tracks are the longest in some cell of some view.

    Cells divide the image so that each view keeps about `most` sightings. n_views: only the first
    so many views are asked, by default all.
    """
    lengths = tracks.lengths
    keep = np.zeros(tracks.n_tracks, bool)
    side = np.sqrt(camera.width * camera.height / most)
    uv = np.clip(tracks.uv_px, 0.0, (camera.width - 1, camera.height - 1))
    columns = int(camera.width // side) + 1
    cell = (uv[:, 1] // side).astype(np.int64) * columns + (uv[:, 0] // side).astype(np.int64)
    rows = tracks.view < (tracks.n_views if n_views is None else n_views)
    key = tracks.view * (columns * (int(camera.height // side) + 1)) + cell
    order = np.lexsort((-lengths[tracks.track], key))
    order = order[rows[order]]
    best = order[np.r_[True, np.diff(key[order]) != 0]] if len(order) else order
    keep[tracks.track[best]] = True
    return keep
