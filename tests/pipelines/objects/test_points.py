"""Where points are taken inside masks, and the noun that holds them."""

import numpy as np
import pytest

from pipelines.geometry import project_stereo
from pipelines.objects.points import ObjectPoints, choose_pixels, create_points, tight_window

GRAY = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
NONE = np.empty((0, 2))


def window_and_mask(rows, columns):
    window = (slice(*rows), slice(*columns))
    return np.ones((rows[1] - rows[0], columns[1] - columns[0]), bool), window


def points_of(ids):
    ids = np.array(ids, np.int64)
    n = len(ids)
    place = np.arange(3.0 * n).reshape(n, 3)
    return ObjectPoints(ids, place, np.repeat(np.eye(3)[None], n, 0), place[:, :2], np.arange(n))


def test_points_of_several_parts_are_sorted_by_object_and_keep_together():
    joined = ObjectPoints.concatenate(points_of([2, 2, 5]), points_of([1, 5]))
    np.testing.assert_array_equal(joined.object_id, [1, 2, 2, 5, 5])
    np.testing.assert_array_equal(joined.position_m[:, 0], [0, 0, 3, 6, 3])  # in their order
    ids, sizes = joined.groups()
    assert ids.tolist() == [1, 2, 5] and sizes.tolist() == [1, 2, 2]
    assert len(joined[joined.object_id == 2]) == 2


def test_no_points_at_all():
    assert len(ObjectPoints.empty()) == len(ObjectPoints.concatenate()) == 0
    assert [len(a) for a in ObjectPoints.empty().groups()] == [0, 0]


def test_points_lie_where_their_disparities_say(kitti):
    uv = np.array([[100.0, 50.0], [400.5, 200.25], [30.0, 30.0], [700.0, 100.0]])
    disparity = np.full((375, 1242), 20.0, np.float32)
    disparity[:60, :60] = np.nan
    disparity[80:120, 680:720] = 0.7  # too little to say
    points = create_points(kitti, disparity, np.array([1, 1, 2, 3]), uv, 0.3, 1.5)
    assert points.object_id.tolist() == [1, 1]
    seen = project_stereo(kitti, points.position_m)
    np.testing.assert_allclose(seen[:, :2], uv[:2], atol=1e-9)
    np.testing.assert_allclose(seen[:, 0] - seen[:, 2], 20.0, atol=1e-5)
    sigma_z = np.sqrt(points.covariance_m2[:, 2, 2])
    np.testing.assert_allclose(sigma_z, 0.3 * (kitti.bf / 20.0) / 20.0, rtol=0.01)
    none = create_points(kitti, disparity, np.empty(0, np.int64), NONE, 0.3, 1.5)
    assert len(none) == 0


@pytest.mark.parametrize("n_all", [10, 50, 200])
def test_no_more_pixels_than_asked_for_and_all_in_the_mask(n_all):
    mask, window = window_and_mask((20, 100), (30, 140))
    mask[:, 50:70] = False
    uv = choose_pixels(GRAY, mask, window, n_all, NONE)
    assert 0.6 * n_all < len(uv) <= n_all
    at = uv.astype(int) - [30, 20]
    assert mask[at[:, 1], at[:, 0]].all()
    assert len(np.unique(uv, axis=0)) == len(uv)


def test_pixels_spread_over_the_whole_object():
    mask, window = window_and_mask((20, 100), (30, 140))
    uv = choose_pixels(GRAY, mask, window, 60, NONE)
    quarters = (uv[:, 0] > 85).astype(int) * 2 + (uv[:, 1] > 60)
    assert np.bincount(quarters, minlength=4).min() >= 8
    cells = np.floor((uv - [30, 20]) / 12).astype(int)  # sqrt(8800 / 60) = 12 px
    assert len(np.unique(cells, axis=0)) == len(uv)


@pytest.mark.parametrize(
    ("size", "rim_px"), [((80, 100), 3), ((40, 40), 2), ((18, 18), 1), ((12, 12), 0)]
)
def test_the_rim_is_left_out_and_no_more(size, rim_px):
    """A worn mask holds background at its edges."""
    top, left = 15, 25
    mask, window = window_and_mask((top - 8, top + size[0] + 8), (left - 8, left + size[1] + 8))
    mask[:8], mask[-8:], mask[:, :8], mask[:, -8:] = False, False, False, False
    uv = choose_pixels(GRAY, mask, window, 2000, NONE)
    assert uv[:, 0].min() >= left + rim_px and uv[:, 1].min() >= top + rim_px
    assert uv[:, 0].max() <= left + size[1] - 1 - rim_px
    assert uv[:, 1].max() <= top + size[0] - 1 - rim_px
    assert uv[:, 0].min() <= left + rim_px + 2 and uv[:, 1].min() <= top + rim_px + 2


def test_where_a_mask_ends_with_its_window_it_has_no_rim():
    mask, window = window_and_mask((60, 120), (0, 100))
    mask[:20, 50:] = False
    uv = choose_pixels(GRAY, mask, window, 2000, NONE)
    assert uv[:, 0].min() <= 1 and uv[:, 1].max() >= 118 and uv[:, 0].max() >= 98
    inner_corner = (uv[:, 0] > 46) & (uv[:, 1] < 83)
    assert not inner_corner.any()


def test_where_an_object_has_points_no_new_ones_are_taken():
    mask, window = window_and_mask((20, 100), (30, 140))
    all_of_it = choose_pixels(GRAY, mask, window, 60, NONE)
    right = all_of_it[all_of_it[:, 0] >= 85]
    more = choose_pixels(GRAY, mask, window, 60, right)
    assert len(more) + len(right) <= 60
    apart = np.linalg.norm(more[:, None] - right[None], axis=-1)
    assert apart.min() >= 1.0
    assert len(choose_pixels(GRAY, mask, window, 60, np.tile(all_of_it, (2, 1)))) == 0
    outside = np.array([[-5.0, -5.0], [159.0, 119.0], [300.0, 300.0]])
    assert len(choose_pixels(GRAY, mask, window, 60, outside)) > 30


@pytest.mark.parametrize("n_pixels", [0, 1, 3])
def test_an_object_of_few_pixels(n_pixels):
    mask, window = window_and_mask((20, 21), (30, 33))
    mask[0, n_pixels:] = False
    uv = choose_pixels(GRAY, mask, window, 50, NONE)
    assert (len(uv) > 0) == (n_pixels > 0)
    assert len(uv) <= n_pixels


def test_an_object_without_any_texture_has_points_too():
    mask, window = window_and_mask((20, 60), (30, 80))
    assert len(choose_pixels(np.full_like(GRAY, 90), mask, window, 40, NONE)) > 20


def test_the_tight_window_holds_all_pixels_and_no_more():
    mask = np.zeros((9, 12), bool)
    mask[2, 7] = mask[5, 3] = True
    assert tight_window(mask) == (slice(2, 6), slice(3, 8))
