"""ORB features: evenly spread, as dense on masks as off them, none where there is nothing."""

import cv2
import numpy as np
import pytest

from pipelines.config import OrbConfig
from pipelines.frontend.orb import OrbExtractor, spread_evenly

H, W = 300, 500
CONFIG = OrbConfig(n_features=500)


def textured(seed=0):
    noise = np.random.default_rng(seed).normal(size=(H, W)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def half_faint():
    """The right half has four fifths of the left half's contrast: cv2's own choice shuns it."""
    gray = textured().astype(np.float32)
    gray[:, W // 2 :] = 128 + 0.8 * (gray[:, W // 2 :] - 128)
    return gray.astype(np.uint8)


def occupied_cells(uv_px, cell_px=50):
    return len({tuple(cell) for cell in (np.asarray(uv_px) // cell_px).astype(int)})


def test_features_are_spread_where_cv2_alone_clusters():
    gray = half_faint()
    features = OrbExtractor(CONFIG).extract(gray)
    own = cv2.ORB_create(nfeatures=CONFIG.n_features, fastThreshold=CONFIG.fast_threshold)
    own_uv = [k.pt for k in own.detect(gray)]
    assert len(own_uv) == len(features) == CONFIG.n_features
    assert occupied_cells(features.uv_px) > occupied_cells(own_uv) + 3
    faint, own_faint = (np.mean(np.array(uv)[:, 0] > W / 2) for uv in (features.uv_px, own_uv))
    assert 1.4 * own_faint < faint < 0.55


def test_features_of_an_even_image_fill_all_of_it():
    features = OrbExtractor(CONFIG).extract(textured())
    assert occupied_cells(features.uv_px) >= 0.95 * (H // 50) * (W // 50)


def test_number_and_form_of_features():
    features = OrbExtractor(CONFIG).extract(textured())
    assert 0.9 * CONFIG.n_features < len(features) <= CONFIG.n_features
    assert features.descriptors.dtype == np.uint8 and features.uv_px.dtype == np.float64
    assert set(np.unique(features.octave)) <= set(range(CONFIG.n_levels))
    assert len(np.unique(features.octave)) > 2
    assert ((features.uv_px >= 0) & (features.uv_px < [W, H])).all()
    assert np.isnan(features.depth_m).all()
    assert (features.response > 0).all()
    assert ((features.angle_deg >= 0) & (features.angle_deg <= 360)).all()
    assert len(np.unique(features.descriptors, axis=0)) > 0.95 * len(features)


@pytest.mark.parametrize("seed", range(4))
def test_masks_get_their_features_on_top_at_the_density_of_the_rest(seed):
    """What moves must not take the static world's features, yet may turn out to be still."""
    rng = np.random.default_rng(seed)
    static = np.ones((H, W), bool)
    for _ in range(6):
        x, y = rng.integers(20, W - 120), rng.integers(20, H - 90)
        static[y : y + 70, x : x + 100] = False
    features = OrbExtractor(CONFIG).extract(textured(seed), static, movable_too=True)
    x, y = np.rint(features.uv_px).astype(int).T
    n_static, n_masked = static[y, x].sum(), (~static[y, x]).sum()
    assert 0.95 * CONFIG.n_features < n_static < 1.02 * CONFIG.n_features
    density_ratio = n_masked / (~static).sum() * static.sum() / n_static
    assert 0.95 < density_ratio < 1.05
    alone = OrbExtractor(CONFIG).extract(textured(seed), static)
    np.testing.assert_array_equal(alone.uv_px, features.uv_px[static[y, x]])


def test_mask_that_hides_nothing_or_all_changes_nothing():
    gray, everywhere = textured(), np.ones((H, W), bool)
    without, with_all = (OrbExtractor(CONFIG).extract(gray, mask) for mask in (None, everywhere))
    np.testing.assert_array_equal(without.uv_px, with_all.uv_px)
    np.testing.assert_array_equal(without.descriptors, with_all.descriptors)
    all_masked = OrbExtractor(CONFIG).extract(gray, ~everywhere, movable_too=True)
    np.testing.assert_array_equal(without.uv_px, all_masked.uv_px)
    assert len(OrbExtractor(CONFIG).extract(gray, ~everywhere)) == 0


@pytest.mark.parametrize("level", [0, 128, 255])
def test_flat_images_have_no_features(level):
    features = OrbExtractor(CONFIG).extract(np.full((H, W), level, np.uint8))
    assert len(features) == 0
    assert features.descriptors.shape == (0, 32)


def test_extractor_keeps_nothing_from_image_to_image():
    extractor = OrbExtractor(CONFIG)
    first = extractor.extract(textured(1))
    extractor.extract(textured(2), np.zeros((H, W), bool))
    again = extractor.extract(textured(1))
    np.testing.assert_array_equal(first.uv_px, again.uv_px)
    np.testing.assert_array_equal(first.descriptors, again.descriptors)


def test_descriptors_recognise_a_shifted_image():
    gray = textured()
    moved = np.roll(gray, (4, 7), (0, 1))
    a, b = (OrbExtractor(CONFIG).extract(image) for image in (gray, moved))
    distance = np.linalg.norm(a.uv_px[:, None] + [7, 4] - b.uv_px[None], axis=-1)
    distance[a.octave[:, None] != b.octave[None]] = np.inf
    i, j = np.nonzero(distance < 0.5)
    assert len(i) > 0.2 * len(a)
    bits = np.unpackbits(a.descriptors[i] ^ b.descriptors[j], axis=1).sum(1)
    assert np.median(bits) < 16


def test_corners_of_one_image_are_described_on_another():
    gray = half_faint()
    extractor = OrbExtractor(CONFIG)
    plain = extractor.extract(gray)
    both = extractor.extract(255 - gray, detect_on=gray)
    np.testing.assert_array_equal(both.uv_px, plain.uv_px)
    np.testing.assert_array_equal(both.angle_deg, plain.angle_deg)
    differing = np.unpackbits(both.descriptors ^ plain.descriptors, axis=1).mean()
    assert 0.9 < differing < 1.0  # what was brighter is darker; ties stay as they are


def test_spreading_takes_the_strongest_of_each_cell_first():
    rng = np.random.default_rng(3)
    uv = np.vstack([rng.uniform(0, 60, (900, 2)), rng.uniform(0, [500, 300], (100, 2))])
    response = np.r_[rng.uniform(0.5, 1, 900), rng.uniform(0, 0.4, 100)]
    kept = spread_evenly(uv, response, (300, 500), 150)
    assert len(kept) == 150 and len(np.unique(kept)) == 150
    lonely = (uv >= 110).all(1)  # more than a cell away from the crowd
    assert np.isin(np.flatnonzero(lonely), kept).mean() > 0.9
    crowd = kept[kept < 900]
    assert len(crowd) < 90
    assert response[crowd].mean() > response[:900].mean() + 0.1


def test_spreading_keeps_all_when_few():
    uv = np.random.default_rng(4).uniform(0, 100, (20, 2))
    np.testing.assert_array_equal(spread_evenly(uv, np.ones(20), (100, 100), 20), np.arange(20))
    assert len(spread_evenly(uv[:0], np.ones(0), (100, 100), 5)) == 0


@pytest.mark.parametrize(("n_levels", "scale_factor"), [(16, 4.0), (16, 2.0), (8, 1.2)])
@pytest.mark.parametrize("size", [(H, W), (60, 90), (39, 39), (20, 20)])
def test_more_levels_than_an_image_has_room_for_are_left_out(n_levels, scale_factor, size):
    gray = textured()[: size[0], : size[1]].copy()
    config = OrbConfig(n_features=500, n_levels=n_levels, scale_factor=scale_factor)
    features = OrbExtractor(config).extract(gray)
    assert features.octave.max(initial=0) < n_levels
    if size == (H, W):
        assert len(features) == 500
