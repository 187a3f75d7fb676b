"""Views: disparities, static pixels and features with depth, out of a frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.config import OrbConfig
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.view import (
    complete_view,
    normalise_contrast,
    prepare_frame,
    static_pixels,
    to_gray,
)
from pipelines.types import Frame, StereoCamera

H, W = 200, 320
CAMERA = StereoCamera(W, H, 300.0, 300.0, 160.0, 100.0, 120.0)
ORB = OrbExtractor(OrbConfig(n_features=400))


def textured(seed=0):
    noise = np.random.default_rng(seed).normal(size=(H, W)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def labelled_box():
    labels = np.zeros((H, W), np.int32)
    labels[80:130, 120:200] = 3
    return labels


def view_of(depth_m, offset_px=0.0, **more):
    return complete(Frame(7, 1.25, textured(), **more), depth_m, offset_px)


def masked_view(depth_m, labels, dilation_px=7):
    return view_of(depth_m).masked(labels, dilation_px)


def complete(frame, depth_m, offset_px=0.0):
    return complete_view(CAMERA, prepare_frame(CAMERA, frame, depth_m, ORB), 0.1, offset_px)


def slanted_depth():
    """Depth of a plane: its disparity is linear in the pixel."""
    v, u = np.mgrid[:H, :W]
    return (CAMERA.bf / (12.0 + 0.02 * u + 0.05 * v)).astype(np.float32)


def test_view_carries_the_frame_along():
    """And the flow that was chosen for it, not the one that the frame happens to bring."""
    flow, unused = (np.full((H, W, 2), value, np.float32) for value in (0.0, 9.0))
    frame = Frame(7, 1.25, textured(), flow_prev_to_curr_px=unused)
    prepared = prepare_frame(CAMERA, frame, slanted_depth(), ORB)
    assert complete_view(CAMERA, prepared, 0.1, 0.0).flow_prev_to_curr_px is None
    prepared = replace(prepared, flow_prev_to_curr_px=flow, flow_is_given=True)
    view = complete_view(CAMERA, prepared, 0.1, 0.0)
    assert (view.frame_index, view.timestamp_s) == (7, 1.25)
    assert view.flow_prev_to_curr_px is flow and view.flow_is_given
    np.testing.assert_array_equal(view.gray, textured())


def test_features_know_their_depth_between_pixels():
    features = view_of(slanted_depth()).features
    truth = CAMERA.bf / (12.0 + features.uv_px @ [0.02, 0.05])
    assert len(features) > 200
    np.testing.assert_allclose(features.depth_m, truth, rtol=1e-4)
    assert (features.uv_px % 1 != 0).any()  # coarser levels lie between pixels


def test_disparity_is_bf_over_depth_plus_the_learned_offset_of_far_points():
    depth = slanted_depth()
    plain, moved = view_of(depth), view_of(depth, offset_px=0.75)
    np.testing.assert_allclose(plain.disparity_px, CAMERA.bf / depth, rtol=1e-5)
    # None of it at ten baselines, where rigs are calibrated
    share = 1 - 10 / CAMERA.fx * plain.disparity_px
    np.testing.assert_allclose(moved.disparity_px - plain.disparity_px, 0.75 * share, atol=1e-4)
    assert (moved.features.depth_m < plain.features.depth_m).all()
    assert plain.disparity_px.dtype == np.float32


@pytest.mark.parametrize("value", [np.nan, 0.0, -3.0])
def test_useless_depths_are_unknown(value):
    depth = slanted_depth()
    depth[50:90, 60:150] = value
    view = view_of(depth)
    assert np.isnan(view.disparity_px[50:90, 60:150]).all()
    assert np.isfinite(view.disparity_px).sum() == H * W - 40 * 90
    uv = view.features.uv_px
    inside = ((uv > [62, 52]) & (uv < [147, 87])).all(1)
    assert inside.sum() > 5
    assert np.isnan(view.features.depth_m[inside]).all()


def test_no_depth_at_all_still_gives_features():
    view = view_of(None)
    assert len(view.features) > 200
    assert np.isnan(view.features.depth_m).all() and np.isnan(view.disparity_px).all()
    assert np.isnan(view.depth_of_static_m(CAMERA)).all()


def test_depth_of_static_pixels_leaves_movable_ones_out():
    depth = slanted_depth()
    view = masked_view(depth, labelled_box())
    found = view.depth_of_static_m(CAMERA)
    assert found.dtype == np.float32
    assert np.isnan(found[80:130, 120:200]).all()
    np.testing.assert_array_equal(np.isfinite(found), view.static)
    np.testing.assert_allclose(found[view.static], depth[view.static], rtol=1e-5)


def test_masks_grow_by_the_setting():
    labels = labelled_box()
    for grow in (0, 1, 7):
        static = static_pixels(labels, (H, W), grow)
        expected = np.ones((H, W), bool)
        expected[80 - grow : 130 + grow, 120 - grow : 200 + grow] = False
        np.testing.assert_array_equal(static, expected)
    assert static_pixels(None, (H, W), 7).all()


def test_no_feature_lies_on_a_movable_object():
    view = masked_view(slanted_depth(), labelled_box())
    x, y = np.rint(view.features.uv_px).astype(int).T
    assert len(x) > 150
    assert not labelled_box()[y, x].any()
    nowhere = masked_view(slanted_depth(), np.ones((H, W), np.int32))
    assert len(nowhere.features) == 0


def test_everything_is_static_until_something_is_said_to_move():
    """What the sequence masks may stand still: whoever knows says so by `masked`."""
    view = view_of(slanted_depth(), instance_labels=labelled_box())
    assert view.static.all()
    x, y = np.rint(view.features.uv_px).astype(int).T
    assert (labelled_box()[y, x] > 0).sum() > 10
    again = view.masked(np.zeros((H, W), np.int32), 7)
    assert again.static.all() and len(again.features) == len(view.features)


def test_features_that_are_left_keep_their_depths():
    view = view_of(slanted_depth())
    masked = view.masked(labelled_box(), 7)
    left = view.is_static(view.features.uv_px) & masked.is_static(view.features.uv_px)
    assert 0 < left.sum() < len(view.features)
    np.testing.assert_array_equal(masked.features.uv_px, view.features.uv_px[left])
    np.testing.assert_array_equal(masked.features.depth_m, view.features.depth_m[left])
    assert view.static.all()  # the first view is as it was


def test_static_places_lie_in_the_image_and_off_objects():
    view = masked_view(None, labelled_box())
    places = np.array([
        [10.0, 10.0], [160.0, 100.0], [-0.4, 0.0], [-0.6, 5.0], [W - 0.6, H - 0.6], [W, 5.0],
        [np.nan, 5.0], [5.0, np.nan],
    ])  # fmt: skip
    answer = view.is_static(places)
    assert answer.tolist() == [True, False, True, False, True, False, False, False]
    assert view.is_static(np.empty((0, 2))).shape == (0,)


def test_grey_of_rgb_weighs_green_most():
    red, green, blue = (np.zeros((2, 2, 3), np.uint8) for _ in range(3))
    red[..., 0] = green[..., 1] = blue[..., 2] = 200
    levels = [int(to_gray(image)[0, 0]) for image in (red, green, blue)]
    assert levels[1] > levels[0] > levels[2] > 0
    assert sum(levels) == pytest.approx(200, abs=2)
    gray = textured()
    assert to_gray(gray) is gray


def test_contrast_is_evened_but_noise_is_not_blown_up():
    gray = textured().astype(np.float32)
    gray[:, W // 2 :] = 60 + 0.4 * (gray[:, W // 2 :] - 128)
    gray[:50] = np.random.default_rng(1).normal(200, 1.0, (50, W))  # a flat, noisy sky
    even = normalise_contrast(gray.clip(0, 255).astype(np.uint8)).astype(float)
    left, right, sky = even[90:, 20:140], even[90:, 180:300], even[10:25, 20:300]
    assert 0.6 < right.std() / left.std() < 1.05  # it was 0.4
    assert abs(right.mean() - left.mean()) < 12  # it was 68
    assert 0.2 < sky.std() < 0.25 * left.std()
    assert normalise_contrast(np.full((H, W), 90, np.uint8)).std() == 0


def test_evened_contrast_brings_features_to_faint_parts():
    gray = textured().astype(np.float32)
    gray[:, W // 2 :] = 128 + 0.5 * (gray[:, W // 2 :] - 128)
    view = complete(Frame(0, 0.0, gray.astype(np.uint8)), None)
    alone = ORB.extract(gray.astype(np.uint8))
    faint, faint_alone = ((f.uv_px[:, 0] > W / 2).mean() for f in (view.features, alone))
    assert faint > faint_alone + 0.1
    assert 0.15 < faint < 0.6


def test_frame_is_not_changed():
    frame = Frame(0, 0.0, textured(), instance_labels=labelled_box())
    depth = slanted_depth()
    depth[:10] = np.nan
    before = frame.image.copy(), depth.copy(), frame.instance_labels.copy()
    complete(frame, depth, 0.3)
    for now, then in zip((frame.image, depth, frame.instance_labels), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_depth_of_static_pixels_is_never_negative_or_infinite():
    far = np.full((H, W), 2000.0, np.float32)  # 0.06 px of disparity
    view = view_of(far, offset_px=-0.2)
    depth = view.depth_of_static_m(CAMERA)
    assert np.isnan(depth).all() or depth[np.isfinite(depth)].min() > 0
