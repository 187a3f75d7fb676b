"""Patches: kept while they fit, warped to other views of a plane, and what that is good for."""

from dataclasses import fields

import cv2
import numpy as np
import pytest

from pipelines.frontend.alignment import align_patches
from pipelines.frontend.patch_cutting import Shot, renew_patches
from pipelines.frontend.view import View
from pipelines.geometry import exp_se3, invert_T, project_stereo, transform_points
from pipelines.observations import Tracks
from pipelines.patches import SIDE_PX, Patches
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


def test_homographies_lead_points_to_where_another_camera_sees_them():
    uv, depth = some_points()
    patches = cut(view_from(np.eye(4)), uv, depth)
    Hs = patches.homographies(CAMERA, np.arange(len(uv)), CLOSER)
    at = np.einsum("nij,nj->ni", Hs, np.column_stack([uv, np.ones(len(uv))]))
    np.testing.assert_allclose(at[:, :2] / at[:, 2:], true_pixels(uv, depth, CLOSER), atol=1e-6)


def aligned(T, warp):
    """Errors (N, 2) of places found from the first view's patches in a view from T."""
    uv, depth = some_points()
    patches, rows = cut(view_from(np.eye(4)), uv, depth), np.arange(len(uv))
    now, truth = view_from(T, 1).gray, true_pixels(uv, depth, T)
    Hs = patches.homographies(CAMERA, rows, T)
    if not warp:
        Hs = np.tile(np.eye(3), (len(uv), 1, 1))
    start = truth + np.random.default_rng(2).uniform(-1, 1, uv.shape)
    found, valid = np.empty_like(uv), np.zeros(len(uv), bool)
    for part, sheet, places in patches.sheets(rows, Hs, (H, W)):
        sure = np.ones(len(places), bool)
        found[part], valid[part] = align_patches(sheet, now, places, start[part], 3.0, sure)
    assert valid.mean() > 0.95
    return (found - truth)[valid]


def test_a_patch_is_found_again_from_much_closer_because_it_is_warped():
    good, plain = aligned(CLOSER, warp=True), aligned(CLOSER, warp=False)
    assert 1e-3 < np.median(np.abs(good)) < 0.03
    assert np.abs(np.median(good, axis=0)).max() < 0.01  # a slanted plane pulls nowhere
    assert np.median(np.abs(plain)) > 4 * np.median(np.abs(good))


def test_without_a_motion_patches_are_as_they_were_cut():
    uv, depth = some_points(700)  # more than fit on one sheet
    view = view_from(np.eye(4))
    patches, rows = cut(view, uv, depth), np.arange(700)[::-1]
    Hs = patches.homographies(CAMERA, rows, np.eye(4))
    sheets = list(patches.sheets(rows, Hs, (H, W)))
    assert len(sheets) == -(-700 // ((H // SIDE_PX) * (W // SIDE_PX)))
    for part, sheet, places in sheets:
        for row, (x, y) in zip(rows[part], np.floor(places).astype(int), strict=True):
            tile = sheet[y - 10 : y + 11, x - 10 : x + 11].astype(int)
            assert np.abs(tile - patches.pixels[row]).max() <= 1
        np.testing.assert_allclose(places % 1, uv[rows[part]] % 1, atol=1e-9)


def test_patches_are_kept_while_they_fit_and_cut_anew_when_they_have_grown():
    uv, depth = some_points(40)
    first = cut(view_from(np.eye(4)), uv, depth)
    near = exp_se3(np.array([0, 0, 0, 0, 0, 0.4]))
    kept = cut(view_from(near), uv + 1.0, depth - 0.4, old=first, T=near)
    for field in fields(Patches):
        np.testing.assert_array_equal(getattr(kept, field.name), getattr(first, field.name))
    nearer = exp_se3(np.array([0, 0, 0, 0, 0, 0.6 * float(depth.min())]))
    at = true_pixels(uv, depth, nearer)
    inside = (at > 30).all(1) & (at < [W - 30, H - 30]).all(1)
    ids = np.flatnonzero(inside)
    z = depth[inside] - nearer[2, 3]
    renewed = cut(view_from(nearer), at[inside], z, old=first, T=nearer, ids=ids)
    anew = (renewed.T_world_camera == nearer).all(axis=(1, 2))
    assert anew.any()
    flatter = (DISTANCE_M + NORMAL @ nearer[:3, 3]) / DISTANCE_M  # seen more from the side
    growth = (depth[inside] / z) ** 1.5 * flatter**0.5
    np.testing.assert_array_equal(anew, growth > 2.0)


def test_points_come_and_go_in_any_order():
    uv, depth = some_points(6)
    view = view_from(np.eye(4))
    first = cut(view, uv[:4], depth[:4], ids=np.array([9, 3, 7, 1]))
    assert first.point_ids.tolist() == [1, 3, 7, 9]
    np.testing.assert_array_equal(first.uv_px, uv[[3, 1, 2, 0]])
    assert first.rows(np.array([7, 2, 1, 11])).tolist() == [2, -1, 0, -1]
    moved = first.moved(CLOSER)
    again = cut(view, uv[3:], depth[3:], old=moved, T=CLOSER, ids=np.array([1, 8, 2]))
    assert again.point_ids.tolist() == [1, 2, 8]
    np.testing.assert_allclose(again.T_world_camera, np.tile(CLOSER, (3, 1, 1)))
    assert Patches.empty().rows(np.array([4, 5])).tolist() == [-1, -1]


def test_behind_the_camera_no_patch_is_kept():
    uv, depth = some_points(5)
    first = cut(view_from(np.eye(4)), uv, depth)
    beyond = exp_se3(np.array([0, 0, 0, 0, 0, float(depth.max()) + 1.0]))
    renewed = cut(view_from(np.eye(4)), uv, depth, old=first, T=beyond)
    np.testing.assert_array_equal(renewed.T_world_camera, np.tile(beyond, (5, 1, 1)))


@pytest.mark.parametrize("place", [(1.2, 2.7), (W - 1.5, H - 1.1)])
def test_at_the_border_the_image_goes_on_as_it_ends(place):
    view = view_from(np.eye(4))
    patches = cut(view, np.array([place]), np.array([3.0]))
    padded = cv2.copyMakeBorder(view.gray, 10, 10, 10, 10, cv2.BORDER_REPLICATE)
    x, y = np.floor(place).astype(int)
    np.testing.assert_array_equal(patches.pixels[0], padded[y : y + 21, x : x + 21])
