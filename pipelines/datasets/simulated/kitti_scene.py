"""A KITTI tracking sequence replayed: its ego path and its traffic, in streets of our own.

Owns which of our shapes stands for which label, and how road, houses and traffic come together.
What is rendered is the truth: smoothed labels, not the labels themselves.
"""

from __future__ import annotations

import numpy as np

from pipelines.datasets.simulated.facades import FACADES
from pipelines.datasets.simulated.kitti_ground import Ground
from pipelines.datasets.simulated.kitti_labels import KittiFiles
from pipelines.datasets.simulated.kitti_motion import PERSONS, Track, ego_path, read_tracks
from pipelines.datasets.simulated.kitti_surroundings import Surroundings
from pipelines.datasets.simulated.meshes import Mesh, merge, pose
from pipelines.datasets.simulated.people import WARDROBE, walker_mesh
from pipelines.datasets.simulated.road_users import (
    ROAD_USER_ART,
    cyclist_mesh,
    fitted,
    lorry_mesh,
    tram_mesh,
)
from pipelines.datasets.simulated.street import CAR_PAINTS, DAYLIGHT
from pipelines.datasets.simulated.textures import SURFACES
from pipelines.datasets.simulated.vehicles import SHAPES, VEHICLE_ART, car_mesh
from pipelines.datasets.simulated.world import Actor, World
from pipelines.types import Array, StereoCamera

FPS = 10.0
# KITTI's classes by COCO's names, which a detector would give.
_CLASS_NAMES = {
    "Car": "car", "Van": "car", "Truck": "truck", "Misc": "truck", "Tram": "train",
    "Cyclist": "bicycle", "Pedestrian": "person", "Person": "person", "Person_sitting": "person",
}  # fmt: skip
_AHEAD_M, _BEHIND_M = 60.0, 15.0  # of road beyond the ego path
_MARGIN_M = 45.0  # of ground around everything
_NEAR_M = 90.0  # things farther from the ego path than this do not widen the ground


def make_kitti(files: KittiFiles, frames: int, seed: int, camera: StereoCamera) -> World:
    """The world of the first `frames` frames; seed: of colours, houses and clothes."""
    labels = files.read()
    rng = np.random.default_rng(seed)
    Ts = ego_path(labels, frames)
    tracks = read_tracks(labels, frames)
    actors = tuple(_actor(track, rng) for track in tracks)
    return World(
        camera,
        FPS,
        _static(Ts, tracks, rng),
        actors,
        Ts,
        DAYLIGHT,
        SURFACES | FACADES | VEHICLE_ART | ROAD_USER_ART,
        sky="sky",
    )


def _actor(track: Track, rng: np.random.Generator) -> Actor:
    mesh = _mesh(track, rng)
    _, high = mesh.bounds()
    rows = zip(track.x_m, track.z_m, track.heading_rad, strict=True)
    Ts = np.stack([pose(x, -high[1], z, heading) for x, z, heading in rows])
    name = _CLASS_NAMES[track.kind]
    present = None if track.present.all() else track.present
    return Actor(track.track + 1, name, mesh, Ts, track.moving, present)


def _mesh(track: Track, rng: np.random.Generator) -> Mesh:
    """Our shape that is nearest to a label's class and proportions, made of the label's size."""
    paint = CAR_PAINTS[int(rng.integers(0, len(CAR_PAINTS)))]
    clothes = WARDROBE[int(rng.integers(0, len(WARDROBE)))]
    if track.kind in PERSONS:
        return walker_mesh(clothes, float(track.size_m[1]))  # labels are as wide as a stride
    if track.kind == "Cyclist":
        return fitted(cyclist_mesh(clothes), track.size_m)
    if track.kind in ("Truck", "Misc"):
        return fitted(lorry_mesh().painted_as(paint), track.size_m)
    if track.kind == "Tram":
        return fitted(tram_mesh().painted_as(paint), track.size_m)
    if track.kind == "Van":
        return fitted(car_mesh("van").painted_as(paint), track.size_m)
    kinds = [kind for kind in SHAPES if kind != "van"]
    misfit = [_misfit(SHAPES[kind].size_m, track.size_m) for kind in kinds]
    return fitted(car_mesh(kinds[int(np.argmin(misfit))]).painted_as(paint), track.size_m)


def _misfit(ours: tuple[float, float, float], theirs: Array) -> float:
    return float(np.abs(np.log(np.asarray(ours) / theirs)).max())


def _static(Ts: Array, tracks: list[Track], rng: np.random.Generator) -> Mesh:
    path = _extended(Ts)
    step = np.gradient(path, axis=0)
    right = np.stack([step[:, 1], -step[:, 0]], 1) / np.hypot(*step.T)[:, None]
    driven = [(path - 1.8 * right, 5.2)]
    occupied = [path]
    for track in tracks:
        corners = track.outlines_m[track.present]
        near = np.hypot(*(corners[:, :1] - path[None, ::8]).transpose(2, 0, 1)).min(1) < _NEAR_M
        if not near.any():
            continue
        points = _rim(corners[near])
        occupied.append(points)
        if track.kind not in PERSONS:
            driven.append((np.unique(points.round(1), axis=0), 0.7))
    everything = np.concatenate(occupied)
    low, high = everything.min(0) - _MARGIN_M, everything.max(0) + _MARGIN_M
    rims = [points for points, radius in driven[1:]]
    driven = [driven[0], *([(np.concatenate(rims), 0.7)] if rims else [])]
    ground = Ground.around(driven, low, high)
    spots = np.unique((everything / 0.4).round(), axis=0) * 0.4
    parts = Surroundings(ground, path, spots, rng).build()
    return merge([ground.mesh(), *parts])


def _rim(corners: Array) -> Array:
    """Points (., 2) every half metre or so around and inside rectangles (K, 4, 2)."""
    width = float(np.linalg.norm(corners[0, 1] - corners[0, 0]))
    length = float(np.linalg.norm(corners[0, 3] - corners[0, 0]))
    a, b = np.meshgrid(
        np.linspace(0, 1, int(np.ceil(width / 0.8)) + 1),
        np.linspace(0, 1, int(np.ceil(length / 0.8)) + 1),
    )
    u, v = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    cover = corners[:, :1] + a.ravel()[:, None] * u[:, None] + b.ravel()[:, None] * v[:, None]
    return cover.reshape(-1, 2)


def _extended(Ts: Array) -> Array:
    """The ego path (P, 2) every half metre, with straight road behind and ahead of it."""
    places = Ts[:, [0, 2], 3]
    length = np.append(0, np.hypot(*np.diff(places, axis=0).T).cumsum())
    kept = np.append(True, np.diff(length) > 1e-4)
    places, length = places[kept], length[kept]
    first, last = Ts[0, [0, 2], 2], Ts[-1, [0, 2], 2]
    first, last = first / np.hypot(*first), last / np.hypot(*last)
    places = np.concatenate([places[:1] - _BEHIND_M * first, places, places[-1:] + _AHEAD_M * last])
    length = np.concatenate([[-_BEHIND_M], length, [length[-1] + _AHEAD_M]])
    s = np.arange(length[0], length[-1], 0.5)
    return np.stack([np.interp(s, length, q) for q in places.T], 1)
