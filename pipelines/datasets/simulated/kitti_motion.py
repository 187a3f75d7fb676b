"""Smooth motion on a level road from noisy labels: how KITTI's cars and people really moved.

Owns the step from labelled boxes to poses. KITTI's roads are not flat, ours is: heights are
dropped, and of the ego car's pitch, roll and bounce only the quick part stays. Things stand, or
follow a smoothing spline; cars follow theirs like a trailer, so that no wheel slides sideways.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import binary_opening, uniform_filter1d

from pipelines.datasets.simulated.kitti_labels import KittiLabels
from pipelines.datasets.simulated.meshes import pose
from pipelines.types import Array

FPS = 10.0
_SMOOTHING = 0.05  # passes what is slower than half a hertz: braking, not the labels' jitter
_EGO_SMOOTHING = 0.01
_SLOW_FRAMES = 21  # what lasts longer than this in pitch, roll and height is the road's slope
_SHORTEST, _LONGEST_GAP = 3, 5  # frames
_BEYOND = 10  # frames that motion goes on before the first label and after the last
_EYE_M = 1.65
_STAND_MPS, _STAND_M = 1.0, 2.5  # a vehicle slower and within this has not moved
_STAY_MPS, _STAY_M = 0.25, 1.0  # a person
PERSONS = ("Pedestrian", "Person", "Person_sitting")


@dataclass(frozen=True, slots=True)
class Track:
    """One labelled thing. size_m: (3,) width, height, length.

    x_m, z_m, heading_rad: (N + 1,) on the ground, at all frames. labelled: (N + 1,) bool, frames
    between its labels. present: (N + 1,) bool, these and those that motion is carried on to.
    """

    track: int
    kind: str
    size_m: Array
    x_m: Array
    z_m: Array
    heading_rad: Array
    labelled: NDArray[np.bool_]
    present: NDArray[np.bool_]
    moving: bool

    @property
    def outlines_m(self) -> Array:
        """Corners (N + 1, 4, 2) of its box on the ground, in order."""
        return outline(self.x_m, self.z_m, self.heading_rad, self.size_m[0], self.size_m[2])


def outline(x: Array, z: Array, heading: Array, width: float, length: float) -> Array:
    """Corners (..., 4, 2), in order, of rectangles around (x, z)."""
    forward = np.stack([np.sin(heading), np.cos(heading)], -1)
    right = np.stack([np.cos(heading), -np.sin(heading)], -1)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    across = signs[:, :1] * width * right[..., None, :]
    along = signs[:, 1:] * length * forward[..., None, :]
    return np.stack([x, z], -1)[..., None, :] + across + along


def overlapping(a: Array, b: Array, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Whether rectangles (..., 4, 2) come nearer than `margin_m`, by separating axes.

    The margin is kept exactly between parallel ones, at least roughly between others.
    """
    apart = np.full(np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), -np.inf)
    for corners in (a, b):
        for side in (1, 3):
            axis = corners[..., side, :] - corners[..., 0, :]
            axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
            pa, pb = (np.einsum("...kc,...c->...k", c, axis) for c in (a, b))
            gap = np.maximum(pa.min(-1) - pb.max(-1), pb.min(-1) - pa.max(-1))
            apart = np.maximum(apart, gap)
    return apart < margin_m


def ego_path(labels: KittiLabels, n: int) -> Array:
    """Poses (n + 1, 4, 4) of the camera over a level road at y = 0, by the estimated ones."""
    Ts = labels.Ts_world_camera
    x, y, z = Ts[:, :3, 3].T
    if np.linalg.norm(Ts[-1, :3, 3] - Ts[0, :3, 3]) < 0.5 and np.ptp(x) + np.ptp(z) < 1.0:
        return np.repeat(pose(0, -camera_height_m(labels), 0)[None], n + 1, 0)
    R = Ts[:, :3, :3]
    yaw = np.unwrap(np.arctan2(R[:, 0, 2], R[:, 2, 2]))
    up = _quick(-np.arcsin(R[:, 1, 2]))
    roll, lift = _quick(np.arcsin(R[:, 1, 0])), _quick(y)
    t = np.arange(len(Ts)) / FPS
    wanted = np.arange(n + 1) / FPS
    smooth = [_curve(t, q, np.ones_like(t), _EGO_SMOOTHING, wanted) for q in (x, z, yaw)]
    up, roll, lift = (np.interp(wanted, t, q) for q in (up, roll, lift))
    height = camera_height_m(labels)
    out = np.stack(
        [
            pose(a, -height + c, b, d)
            for a, b, c, d in zip(*smooth[:2], lift, smooth[2], strict=True)
        ]
    )
    for T, p, r in zip(out, up, roll, strict=True):
        tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
        lean = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
        T[:3, :3] = T[:3, :3] @ tilt @ lean
    return out


def camera_height_m(labels: KittiLabels) -> float:
    """Height of the camera above the road, from the undersides of near boxes."""
    near = labels.bottom_m[:, 2] < 20
    return float(np.median(labels.bottom_m[near, 1])) if near.sum() > 20 else _EYE_M


def read_tracks(labels: KittiLabels, n: int) -> list[Track]:
    """All things of the first `n` frames; none lets its carried-on motion run into another."""
    tracks = []
    for number in np.unique(labels.track):
        rows = np.flatnonzero(labels.track == number)
        rows = rows[np.argsort(labels.frame[rows], kind="stable")]
        if len(rows) >= _SHORTEST and labels.frame[rows[0]] <= n:
            track = _smooth_track(labels, rows, n)
            if track.labelled.any():
                tracks.append(track)
    return _held_back(tracks)


def _quick(q: Array) -> Array:
    """`q` without what changes slowly, lightly smoothed."""
    q = uniform_filter1d(q, 3, mode="nearest")
    return q - uniform_filter1d(uniform_filter1d(q, _SLOW_FRAMES), _SLOW_FRAMES)


def _curve(t: Array, q: Array, weights: Array, smoothing: float, wanted: Array) -> Array:
    """A smoothing spline through `q` at times `t`, read at `wanted`; straight beyond its ends."""
    if len(t) < 5:
        slope, start = np.polyfit(t - t[0], q, 1)
        return np.asarray(start + slope * (wanted - t[0]))
    spline = make_smoothing_spline(t, q, weights, lam=smoothing)
    inside = np.clip(wanted, t[0], t[-1])
    speed = spline.derivative()
    return np.asarray(spline(inside) + speed(inside) * (wanted - inside))


def _smooth_track(labels: KittiLabels, rows: NDArray[np.int64], n: int) -> Track:
    kind = str(labels.kind[rows[0]])
    frames = labels.frame[rows]
    Ts = labels.Ts_world_camera[frames]
    xz = (np.einsum("nij,nj->ni", Ts[:, :3, :3], labels.bottom_m[rows]) + Ts[:, :3, 3])[:, [0, 2]]
    yaw = np.arctan2(Ts[:, 0, 2], Ts[:, 2, 2])
    heading = np.unwrap(labels.heading_rad[rows] + yaw)
    # Labels are as noisy as the laser points are few: noise grows with distance.
    weights = 1.0 / (1.0 + labels.bottom_m[rows, 2] / 20)
    size = np.median(labels.size_m[rows], axis=0)
    t, wanted = frames / FPS, np.arange(n + 1) / FPS
    labelled = np.zeros(n + 1, bool)
    labelled[frames[frames <= n]] = True
    for a, b in pairwise(frames):
        if b - a <= _LONGEST_GAP:
            labelled[a : b + 1] = True
    person = kind in PERSONS
    if not _moves(xz, frames, person):
        x, z = (xz * weights[:, None]).sum(0) / weights.sum()
        angle = _mean_heading(heading, weights)
        always = np.ones(n + 1)
        return Track(
            int(labels.track[rows[0]]),
            kind,
            size,
            x * always,
            z * always,
            angle * always,
            labelled,
            always > 0,
            False,
        )
    fine = np.arange(10 * n + 1) / (10 * FPS)
    path = _path(t, xz, weights, person, fine)
    arm = 0.25 if person else 0.3 * float(size[2])
    headings = _trailing(path, fine, arm, (t, heading))
    near = np.zeros(n + 1, bool)
    for k in np.flatnonzero(labelled):
        near[max(k - _BEYOND, 0) : k + _BEYOND + 1] = True
    near[max(int(frames[0]) - _BEYOND, 0) : int(frames[0])] = True
    x, z, angles = (np.interp(wanted, fine, q) for q in (*path.T, headings))
    return Track(int(labels.track[rows[0]]), kind, size, x, z, angles, labelled, near, True)


def _moves(xz: Array, frames: NDArray[np.int64], person: bool) -> bool:
    """Whether it got anywhere: faster, or farther, than ego pose and label errors can feign."""
    part = max(len(xz) // 5, 1)
    travelled = float(np.linalg.norm(xz[-part:].mean(0) - xz[:part].mean(0)))
    seconds = max(float(frames[-part:].mean() - frames[:part].mean()) / FPS, 1 / FPS)
    mps, metres = (_STAY_MPS, _STAY_M) if person else (_STAND_MPS, _STAND_M)
    return travelled / seconds > mps or travelled > metres


def _mean_heading(heading: Array, weights: Array) -> float:
    """Mean angle; labels that face the other way round are turned to the majority's."""
    double = np.angle((weights * np.exp(2j * heading)).sum()) / 2
    same = (weights * np.cos(heading - double)).sum() > 0
    return float(double if same else double + np.pi)


def _path(t: Array, xz: Array, weights: Array, person: bool, wanted: Array) -> Array:
    """Smooth places (W, 2); where it stood for a second, it stands still."""
    slow = np.stack([_curve(t, q, weights, 3.0, t) for q in xz.T], 1)
    speed = np.linalg.norm(np.gradient(slow, t, axis=0), axis=1)
    standing = binary_opening(speed < (0.2 if person else 0.4), np.ones(10))
    held, firm = xz.copy(), weights.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], standing, [0]]).astype(int)))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        held[a:b], firm[a:b] = np.median(xz[a:b], axis=0), 30.0
    return np.stack([_curve(t, q, firm, _SMOOTHING, wanted) for q in held.T], 1)


def _trailing(path: Array, times: Array, arm_m: float, labels: tuple[Array, Array]) -> Array:
    """Headings (W,) of things whose rear axle, `arm_m` behind their middle, follows it.

    labels: times and headings that say which way it faces at first, and whether it backs up: then
    time is run through backwards.
    """
    step = np.diff(path, axis=0)
    seen = np.interp(times[:-1], *labels)
    facing = np.stack([np.sin(seen), np.cos(seen)], 1)
    backing = float((step * facing).sum()) < 0
    order = slice(None, None, -1) if backing else slice(None)
    p = path[order]
    first = seen[-1] if backing else seen[0]
    moved = p[1] - p[0]
    if np.hypot(*moved) * 10 * FPS > 1.5:  # fast enough for its course to be the better guess
        first = np.arctan2(*moved)
    heading = np.empty(len(p))
    heading[0] = first
    axle = p[0] - arm_m * np.array([np.sin(first), np.cos(first)])
    for k in range(1, len(p)):
        d = p[k] - axle
        heading[k] = np.arctan2(d[0], d[1])
        axle = p[k] - arm_m * d / np.hypot(*d)
    return np.unwrap(heading[order])


def _held_back(tracks: list[Track]) -> list[Track]:
    """The tracks, each present outside its labels only until it would touch another's box."""
    corners = [track.outlines_m for track in tracks]
    out: list[Track] = []
    for i, track in enumerate(tracks):
        blocked = np.zeros(len(track.present), bool)
        for j, other in enumerate(tracks):
            theirs = out[j].present if j < i else other.labelled
            both = track.present & ~track.labelled & theirs
            if i != j and both.any():
                blocked[both] |= overlapping(corners[i][both], corners[j][both], 0.3)
        out.append(_cut(track, blocked))
    return out


def _cut(track: Track, blocked: NDArray[np.bool_]) -> Track:
    present = track.present & ~blocked
    known = np.flatnonzero(track.labelled)
    runs = np.cumsum(np.append(0, np.diff(present.astype(int)) != 0))
    kept = np.isin(runs, runs[known]) & present  # only what hangs together with its labels
    return Track(track.track, track.kind, track.size_m, track.x_m, track.z_m, track.heading_rad,
                 track.labelled, kept, track.moving)  # fmt: skip
