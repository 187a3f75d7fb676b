"""A slanted, textured floor as any camera sees it, and patches cut from it."""

import cv2
import numpy as np

from pipelines.frontend.patch_cutting import Shot, renew_patches
from pipelines.frontend.view import View
from pipelines.geometry import exp_se3, invert_T, project_stereo, transform_points
from pipelines.observations import Tracks
from pipelines.patches import Patches
from pipelines.types import Features, StereoCamera

W, H = 400, 300
CAMERA = StereoCamera(W, H, 300.0, 300.0, 200.0, 150.0, 120.0)
NORMAL = np.array([0.0, -0.9, -0.435])  # of a slanted floor: normal @ point = -DISTANCE
DISTANCE_M = 1.5
SIGMA_PX = 0.05
TEXELS_PER_M = 120.0


def texture():
    noise = np.random.default_rng(0).normal(size=(1500, 1500)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.float32)


TEXTURE = texture()


def view_from(T_world_camera, index=0):
    """The floor as a camera sees it, with exact disparities."""
    v, u = np.mgrid[:H, :W].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((H, W))], -1)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):  # at the horizon
        depth = (-DISTANCE_M - NORMAL @ t) / (rays @ (R.T @ NORMAL))
    depth = np.clip(np.nan_to_num(depth, nan=100.0), -100.0, 100.0)
    points = rays * depth[..., None] @ R.T + t
    along = np.cross(NORMAL / np.linalg.norm(NORMAL), [1.0, 0.0, 0.0])
    x = (points[..., 0] * TEXELS_PER_M + 750).astype(np.float32)
    y = (points @ along * TEXELS_PER_M + 750).astype(np.float32)
    gray = cv2.remap(TEXTURE, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    gray = np.clip(gray, 0, 255).round().astype(np.uint8)
    disparity = (CAMERA.bf / depth).astype(np.float32)
    everywhere = np.ones((H, W), bool)
    return View(index, 0.1 * index, gray, gray, disparity, everywhere, Features.empty(), None)


def some_points(n=120, seed=1):
    """Pixels and depths in the first view."""
    uv = np.random.default_rng(seed).uniform([120, 130], [280, 230], (n, 2))
    x = (uv - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    return uv, -DISTANCE_M / (np.column_stack([x, np.ones(n)]) @ NORMAL)


def cut(view, uv, depth, old=None, T=None, ids=None):
    ids = np.arange(len(uv)) if ids is None else ids
    T = np.eye(4) if T is None else T
    old = Patches.empty() if old is None else old
    tracks = Tracks(ids, uv, CAMERA.bf / depth, np.full(len(uv), 0.1))
    return renew_patches(old, Shot(CAMERA, view, T, SIGMA_PX), tracks, depth)


def true_pixels(uv, depth, T):
    x = (uv - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points = np.column_stack([x, np.ones(len(uv))]) * depth[:, None]
    return project_stereo(CAMERA, transform_points(invert_T(T), points))[:, :2]


CLOSER = exp_se3(np.array([0.01, -0.02, 0.03, 0.1, 0.05, 0.7]))
