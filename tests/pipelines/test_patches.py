"""Patches: warped to other views of a plane, and what that is good for."""

import numpy as np

from pipelines.frontend.alignment import align_patches
from pipelines.patches import SIDE_PX, Patches
from tests.pipelines.slanted_floor import (
    CAMERA,
    CLOSER,
    H,
    W,
    cut,
    some_points,
    true_pixels,
    view_from,
)


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


def test_patches_are_joined_by_ascending_id_and_chosen():
    uv, depth = some_points(6)
    view = view_from(np.eye(4))
    odd, even = (cut(view, uv[k::2], depth[k::2], ids=np.arange(k, 6, 2)) for k in (1, 0))
    both = Patches.concatenate(odd, even)
    np.testing.assert_array_equal(both.point_ids, np.arange(6))
    np.testing.assert_array_equal(both.uv_px, uv)
    np.testing.assert_array_equal(both[both.point_ids > 3].uv_px, uv[4:])
    assert len(Patches.concatenate(Patches.empty(), odd)) == 3
