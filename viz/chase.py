"""Viewpoints that follow the camera from behind and above, and the frame that tells the most.

Owns how far behind they stay and how calmly they follow. Pure geometry, draws nothing.
"""

from __future__ import annotations

import numpy as np

from pipelines.geometry import invert_T, transform_points
from pipelines.object_types import ObjectState
from pipelines.types import Array
from viz.playback import Playback
from viz.scene import View, extent_m
from viz.smoothing import smoothed
from viz.views import look_from, view_axes

BACK, ABOVE, AHEAD = 0.42, 0.29, 0.35  # of the reach: eye behind and above, target ahead
LOWEST_SHARE, HIGHEST_SHARE = 0.03, 0.5  # of the scene's extent: bounds of the reach
FIELD_OF_VIEW_DEG = 62.0  # across a picture of 16:9; a wider one shows more at its sides
HAZE = (1.6, 7.0, 0.8)  # depths in reaches, and how far points fade
NEAR = 0.3  # of the way from the eye to the camera: points before that only hide things
FAR = 5.0  # in reaches: objects beyond are too small to tell anything
N_SAMPLES = 15


def chase_views(playback: Playback, size: tuple[int, int]) -> list[View]:
    """A view of (width, height) pixels for each frame, which follows the camera calmly."""
    scene = playback.scene
    if len(playback) == 0:
        return []
    reach_m = view_reach_m(playback)
    centers = smoothed(playback.Ts_world_camera[:, :3, 3], playback.timestamps_s)
    headings = _headings(playback)
    focal = 0.5 * min(size[0], size[1] * 16 / 9) / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2.0)
    K = np.array([[focal, 0, (size[0] - 1) / 2.0], [0, focal, (size[1] - 1) / 2.0], [0, 0, 1.0]])
    views = []
    for center, heading in zip(centers, headings, strict=True):
        eye = center + reach_m * (ABOVE * scene.up - BACK * heading)
        forward = center + reach_m * AHEAD * heading - eye
        forward /= np.linalg.norm(forward)
        R = view_axes(np.cross(heading, scene.up), forward)
        near_m = NEAR * reach_m * np.hypot(BACK, ABOVE)
        haze = (HAZE[0] * reach_m, HAZE[1] * reach_m, HAZE[2])
        views.append(View("chase", size, K, look_from(R, eye), None, near_m, haze))
    return views


def view_reach_m(playback: Playback) -> float:
    """How far the camera typically saw points of the map: the measure of all that follows it."""
    scene, last = playback.scene, len(playback) - 1
    extent = extent_m(scene.path_m, scene.points_m)
    medians = []
    for k in np.linspace(0, last, N_SAMPLES).astype(int).tolist() if last >= 0 else ():
        local = transform_points(invert_T(playback.Ts_world_camera[k]), scene.points_m)
        seen = (local[:, 2] > 0) & (np.abs(local[:, :2]) < [0.8, 0.6] * local[:, 2:]).all(1)
        if seen.any():
            medians.append(float(np.median(local[seen, 2])))
    reach = float(np.median(medians)) if medians else 0.3 * extent
    return float(np.clip(reach, LOWEST_SHARE * extent, HIGHEST_SHARE * extent))


def telling_frame(playback: Playback, views: list[View]) -> int:
    """Position of the frame with the most moving objects before the view; later ones if alike."""
    reach_m = view_reach_m(playback)
    scores = np.linspace(0.0, 0.5, len(playback))
    for k, (boxes, view) in enumerate(zip(playback.boxes, views, strict=True)):
        if not playback.is_tracked[k]:
            scores[k] -= 100.0
        for box in boxes:
            uv, depth = view.project(box.T_world_box[None, :3, 3])
            inside = ((uv[0] > 0) & (uv[0] < view.size)).all()
            if inside and view.near_m < depth[0] < FAR * reach_m:
                scores[k] += 1.0 if box.state == str(ObjectState.MOVING) else 0.1
    return int(scores.argmax())


def _headings(playback: Playback) -> Array:
    """Level unit vectors (F, 3) along which the camera looks, smoothed.

    One that looks straight down or up has no such direction: the top of its picture then counts.
    """
    scene, Ts = playback.scene, playback.Ts_world_camera
    ahead, above = Ts[:, :3, 2], -Ts[:, :3, 1]
    tilt = (ahead @ scene.up)[:, None]
    level = ahead - tilt * above
    level = level - (level @ scene.up)[:, None] * scene.up
    level = smoothed(level, playback.timestamps_s)
    length = np.linalg.norm(level, axis=1)[:, None]
    return np.where(length > 1e-3, level / np.maximum(length, 1e-9), scene.forward)
