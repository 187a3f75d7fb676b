"""Where points go: by flow, by alignment, and by what is believed where these contradict."""

import cv2
import numpy as np
import pytest

from pipelines.frontend.noise import NoiseModel
from pipelines.frontend.view import View
from pipelines.objects.following import Followed, follow_points, learn_edges
from pipelines.types import Features

SHIFT = np.array([4.0, -2.0])
H, W = 120, 200
COARSE = np.random.default_rng(0).integers(20, 235, (H // 4, W // 4)).astype(np.uint8)
PREV = cv2.resize(COARSE, (W, H), interpolation=cv2.INTER_CUBIC)
NOW = cv2.warpAffine(
    PREV, np.c_[np.eye(2), SHIFT], (W, H), borderMode=cv2.BORDER_REFLECT, flags=cv2.INTER_LINEAR
)
UV = np.stack(np.meshgrid(np.arange(40.0, 160, 12), np.arange(30.0, 95, 12)), -1).reshape(-1, 2)
NOWHERE = np.full_like(UV, np.nan)


def flow(shift=SHIFT):
    return np.broadcast_to(np.float32(shift), (H, W, 2)).copy()


def view_of(gray, flow_px=None, disparity_px=None):
    if disparity_px is None:
        disparity_px = np.full((H, W), 20.0, np.float32)
    everywhere = np.ones((H, W), bool)
    return View(0, 0.0, gray, gray, disparity_px, everywhere, Features.empty(), flow_px)


def follow(flow_px, expected_px, uv=UV, disparity_px=None, noise=None):
    now = view_of(NOW, flow_px, disparity_px)
    return follow_points(view_of(PREV), now, uv, expected_px, noise or NoiseModel())


@pytest.mark.parametrize("with_flow", [True, False])
@pytest.mark.parametrize("with_expected", [True, False])
def test_points_are_found_by_whatever_there_is(with_flow, with_expected):
    found = follow(flow() if with_flow else None, UV + SHIFT + 1.0 if with_expected else NOWHERE)
    if not with_flow and not with_expected:
        assert not found.valid.any()
        return
    assert found.valid.mean() > 0.95
    error = np.linalg.norm(found.uv_px - UV - SHIFT, axis=1)[found.valid]
    assert np.median(error) < 0.05
    assert np.isnan(found.flow_px).all() != with_flow
    assert np.median(found.sigma_px) == pytest.approx(0.3 / np.sqrt(2) if with_flow else 0.3)


def test_flow_that_leads_elsewhere_than_expected_is_not_of_the_object():
    """A fast object: the flow found the background; the motion says where to look."""
    found = follow(flow((-14.0, 6.0)), UV + SHIFT + (0.5, 0.5))
    assert np.isnan(found.flow_px).all()
    assert found.valid.mean() > 0.95
    assert np.median(np.linalg.norm(found.uv_px - UV - SHIFT, axis=1)) < 0.05


def test_where_both_contradict_the_one_nearer_to_the_expected_is_believed():
    wrong_flow = SHIFT + np.array([5.0, 0.0])
    for expected, right in ((SHIFT, SHIFT), (SHIFT + np.array([4.5, 0.0]), wrong_flow)):
        found = follow(flow(wrong_flow), UV + expected)
        error = np.linalg.norm(found.uv_px - UV - right, axis=1)[found.valid]
        assert np.median(error) < 0.1
    # Without any expectation the alignment starts at the flow, and finds its way from there
    found = follow(flow(SHIFT + np.array([1.0, 0.0])), NOWHERE)
    assert np.median(np.linalg.norm(found.aligned_px - UV - SHIFT, axis=1)) < 0.05


def test_points_that_leave_the_image_are_lost():
    out = follow(flow((300.0, 0.0)), NOWHERE)
    assert not (out.valid & (out.uv_px[:, 0] > W - 1)).any()
    edge = np.array([[W - 3.0, 60.0], [60.0, 1.0]])  # shifted by 4 and -2
    assert not follow(flow(), np.full((2, 2), np.nan), edge).valid.any()


def test_unknown_flow_leaves_a_point_to_the_alignment():
    holes = flow()
    holes[:, : W // 2] = np.nan
    found = follow(holes, UV + SHIFT + 0.5)
    left = UV[:, 0] < W // 2 - 1
    assert np.isnan(found.flow_px[left]).all() and found.valid[left].mean() > 0.9


def test_no_points():
    for part in (follow(flow(), np.empty((0, 2)), np.empty((0, 2))), Followed.empty()):
        assert part.uv_px.shape == (0, 2) and len(part.valid) == len(part.sigma_px) == 0
    both = Followed.concatenate(follow(flow(), NOWHERE), Followed.empty())
    assert len(both.valid) == len(UV)
    assert len(both[both.valid].sigma_px) == both.valid.sum()


@pytest.mark.parametrize("edge_px", [0.05, 0.1, 0.4])
def test_beside_a_depth_edge_a_place_is_as_precise_as_it_was_learned(edge_px):
    """What lies across moves otherwise, which drags windows along, but not exact flow."""
    disparity = np.where(np.arange(W) < 100, 20.0, 8.0) * np.ones((H, 1))
    disparity = disparity.astype(np.float32)
    noise, rng = NoiseModel(), np.random.default_rng(0)
    across = np.repeat([0.0, 0.1, 0.35], 400)
    sigma = np.where(across > 0.2, edge_px, 0.1)[:, None]
    for _ in range(20):
        learn_edges(rng.normal(0.0, 1.0, (1200, 2)) * sigma, across, noise)
    found = follow(flow(), UV + SHIFT, disparity_px=disparity, noise=noise)
    factor = found.sigma_px / follow(flow(), UV + SHIFT).sigma_px
    at_edge, off = found.across > 0.15, found.across == 0.0
    assert at_edge.sum() > 5 and off.sum() > 20
    np.testing.assert_array_equal(factor[off], 1.0)
    worse = max(edge_px / 0.1, 1.0) - 1.0  # where 0.35 of the surroundings are across
    np.testing.assert_allclose(
        factor[at_edge], 1.0 + worse * found.across[at_edge] / 0.35, rtol=0.1
    )
