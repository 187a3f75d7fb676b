"""Degraded inputs: each fault alone, of the size it should have, and the truth untouched."""

import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence
from pipelines.datasets.simulated.cache import forget
from pipelines.datasets.simulated.degrade import Degradation, exposure_gain, worn_depth, worn_masks
from pipelines.datasets.simulated.motion import blur_along
from pipelines.errors import ConfigError
from pipelines.types import StereoCamera

CAMERA = StereoCamera(400, 300, 700.0, 700.0, 199.5, 149.5, 380.0)


def worn_street(cache, words, **options):
    return SimulatedSequence("street", frames=4, scale=0.3, cache=cache, degrade=words, **options)


@pytest.mark.parametrize(
    ("word", "touched"),
    [
        ("disparity", {"depth_m"}),
        ("holes", {"depth_m"}),
        ("flow", {"flow_prev_to_curr_px"}),
        ("masks", {"instance_labels"}),
        ("blur", {"image"}),
        ("exposure", {"image"}),
        ("noise", {"image"}),
    ],
)
def test_each_fault_touches_its_own_input_alone(street, cache, word, touched):
    worn = worn_street(cache, word)
    inputs = ("image", "depth_m", "flow_prev_to_curr_px", "instance_labels")
    changed = {
        name
        for name in inputs
        for k in (1, 2)
        if not np.array_equal(
            getattr(street.read(k), name), getattr(worn.read(k), name), equal_nan=True
        )
    }
    assert changed == touched
    a, b = street.ground_truth(), worn.ground_truth()
    assert (a.Ts_world_camera == b.Ts_world_camera).all()
    assert (a.objects.Ts_world_object == b.objects.Ts_world_object).all()


def test_other_faults_befall_the_same_scene(street, cache):
    """A noise seed alters the faults alone; that of the scene is no other sequence."""
    same, other = (worn_street(cache, "disparity", noise_seed=n) for n in (0, 1))
    assert same.root == worn_street(cache, "disparity").root != other.root
    depths = [sequence.read(2).depth_m for sequence in (same, other, street)]
    assert np.array_equal(other.read(2).image, street.read(2).image)
    apart = [np.nanmedian(np.abs(depths[k] - depths[2])) for k in (0, 1)]
    assert apart[0] == pytest.approx(apart[1], rel=0.1) and min(apart) > 0.0
    assert not np.array_equal(depths[0], depths[1], equal_nan=True)
    forget(other.root)
    assert not other.root.exists() and street.root.exists()
    forget(cache)  # holds sequences, but is none
    assert street.root.exists()


def test_white_noise_is_of_the_size_that_the_truth_tells(street, cache):
    worn = worn_street(cache, "white")
    noise = worn.ground_truth().noise
    assert street.ground_truth().noise is None and worn.read(0).flow_prev_to_curr_px is None
    exact, found = street.read(2), worn.read(2)
    flow = (found.flow_prev_to_curr_px - exact.flow_prev_to_curr_px).reshape(-1, 2)
    flow = flow[np.isfinite(flow).all(1)]
    bf = street.camera.bf
    disparity = (bf / found.depth_m - bf / exact.depth_m)[exact.depth_m < 25]
    for error, sigma in ((flow, noise.flow_px), (disparity, noise.disparity_px)):
        assert 0.97 * sigma < np.nanstd(error) < 1.03 * sigma
        assert abs(np.nanmean(error)) < 0.03 * sigma
    assert abs(np.corrcoef(flow.T)[0, 1]) < 0.02
    assert (found.instance_labels == exact.instance_labels).all()
    again = worn_street(cache, "white").read(2).flow_prev_to_curr_px
    np.testing.assert_array_equal(found.flow_prev_to_curr_px, again)
    alone = worn_street(cache, "white", provide="right").ground_truth()
    assert alone.noise is None  # its own flow and depth err otherwise


def test_white_noise_stands_alone(cache):
    with pytest.raises(ConfigError, match="alone, found it with flow"):
        worn_street(cache, "white,flow")


def test_disparity_noise_is_a_third_of_a_pixel(street, cache):
    exact, worn = street.read(2).depth_m, worn_street(cache, "disparity").read(2).depth_m
    near = exact < 25
    error = (street.camera.bf / worn - street.camera.bf / exact)[near]
    assert 0.25 < np.nanstd(error) < 0.35
    assert abs(np.nanmean(error)) < 0.02
    assert (np.isnan(worn) & ~np.isnan(exact))[near].mean() < 0.01


def test_room_depth_noise_grows_with_the_square(cache):
    options = {"frames": 4, "scale": 0.35, "cache": cache}
    exact = SimulatedSequence("room", **options).read(1).depth_m
    worn = SimulatedSequence("room", degrade="disparity", **options).read(1).depth_m
    scaled = (worn - exact) / exact**2
    assert 0.0017 < np.nanstd(scaled) < 0.0021
    for low, high in ((1.5, 3.0), (3.0, 7.0)):
        part = scaled[(exact > low) & (exact < high)]
        assert 0.0016 < np.nanstd(part) < 0.0022


def test_holes_are_blobs_and_rims_of_edges(street, cache):
    exact, worn = street.read(2).depth_m, worn_street(cache, "holes").read(2).depth_m
    lost = np.isnan(worn) & ~np.isnan(exact)
    assert 0.02 < lost.mean() < 0.25
    kept = ~np.isnan(worn)
    assert (worn[kept] == exact[kept]).all()


def test_holes_of_a_wall_cover_their_share():
    wall = np.full((300, 400), 5.0, np.float32)
    how = Degradation(hole_share=0.03)
    lost = np.isnan(worn_depth(wall, CAMERA, how, np.random.default_rng(0)))
    assert 0.025 < lost.mean() < 0.035
    step = wall.copy()
    step[:, 200:] = 15.0
    lost = np.isnan(worn_depth(step, CAMERA, how, np.random.default_rng(0)))
    assert lost[:, 200:202].mean() > 0.2  # the far side of the edge
    assert lost[:, 260:].mean() < 0.06


def test_computed_flow_is_close_but_not_exact(street, cache):
    exact = street.read(2).flow_prev_to_curr_px
    worn = worn_street(cache, "flow").read(2).flow_prev_to_curr_px
    error = np.linalg.norm(exact - worn, axis=-1)[~np.isnan(street.read(1).depth_m)]
    assert 0.02 < np.median(error) < 1.0


def test_masks_wear_by_their_amount_and_drop_by_their_share():
    labels = np.zeros((300, 400), np.int32)
    for i in range(20):
        y, x = 15 + 58 * (i // 4), 20 + 95 * (i % 4)
        labels[y : y + 40, x : x + 60] = i + 1
    how = Degradation.of("masks", indoors=False)
    rng = np.random.default_rng(3)
    widths, missing, total = [], 0, 0
    for _ in range(40):
        worn = worn_masks(labels, how, rng)
        for i in range(20):
            columns = np.flatnonzero((worn == i + 1).any(0))
            total += 1
            if len(columns) == 0:
                missing += 1
            else:
                widths.append((np.ptp(columns) + 1 - 60) / 2)
    assert 0.03 < missing / total < 0.075
    assert set(np.unique(widths)) == set(range(-4, 5))
    assert abs(np.mean(widths)) < 0.4


def test_dilated_masks_never_take_pixels_of_a_neighbour():
    labels = np.zeros((60, 80), np.int32)
    labels[20:40, 20:40], labels[20:40, 40:60] = 1, 2
    how = Degradation(mask_wear_px=4)
    rng = np.random.default_rng(0)
    for _ in range(30):
        worn = worn_masks(labels, how, rng)
        assert not (worn[labels == 1] == 2).any()
        assert not (worn[labels == 2] == 1).any()


def test_exposure_swings_smoothly_within_its_bounds():
    t = np.arange(400) / 10
    gain = exposure_gain(t, Degradation.of("exposure", indoors=False), seed=0)
    assert 0.1 < np.abs(gain - 1).max() <= 0.25
    assert np.abs(np.diff(gain)).max() < 0.04
    assert (exposure_gain(t, Degradation(), seed=0) == 1).all()


def test_image_noise_has_its_deviation(street, cache):
    exact, worn = street.read(1).image, worn_street(cache, "noise").read(1).image
    middle = (exact > 20) & (exact < 235)
    error = worn.astype(float)[middle] - exact[middle]
    assert 2.2 < error.std() < 2.8
    assert abs(error.mean()) < 0.1


def test_blur_spreads_a_line_by_the_exposure():
    image = np.zeros((40, 120, 3), np.uint8)
    image[:, 60] = 255
    flow = np.zeros((40, 120, 2), np.float32)
    flow[..., 0] = 20.0
    row = blur_along(image, flow, share=0.5)[20, :, 0].astype(float)
    wide = np.flatnonzero(row > 4)
    assert 8 <= np.ptp(wide) <= 12  # half of 20 px
    assert abs((row * np.arange(120)).sum() / row.sum() - 60) < 0.5
    assert (blur_along(image, 0 * flow, share=0.5) == image).all()


def test_right_picture_is_degraded_with_its_own_noise(cache):
    worn = worn_street(cache, "exposure,noise", provide="right").read(2)
    exact = worn_street(cache, None, provide="right").read(2)
    left = worn.image.astype(float).mean() / exact.image.mean()
    right = worn.image_right.astype(float).mean() / exact.image_right.mean()
    assert left == pytest.approx(right, abs=0.01)
    assert abs(left - 1) > 0.005
    pairs = ((worn.image, exact.image), (worn.image_right, exact.image_right))
    middle = np.logical_and(*((e > 25) & (e < 190) for _, e in pairs))  # nothing is clipped
    noise = [w[middle].astype(float) - left * e[middle] for w, e in pairs]
    assert abs(np.corrcoef(noise)[0, 1]) < 0.2


def test_words_are_understood():
    everything = Degradation.of("all", indoors=False)
    assert everything == Degradation.of(
        ["disparity", "holes", "flow", "masks", "blur", "exposure", "noise"], indoors=False
    )
    assert Degradation.of("all", indoors=True).depth_sigma_per_m == 0.0019
    assert not Degradation.of(None, indoors=False).any
    assert not Degradation.of("none", indoors=True).any
    with pytest.raises(ConfigError, match=r"unknown degradation 'rain'.*disparity"):
        Degradation.of("flow,rain", indoors=False)
