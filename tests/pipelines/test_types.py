"""The nouns refuse arrays of the wrong shape, in words, and are indexed like arrays."""

from dataclasses import FrozenInstanceError, fields

import numpy as np
import pytest

from pipelines.types import (
    Features,
    Frame,
    FrameResult,
    GroundTruth,
    MotionHypothesis,
    ObjectTruth,
    StaticMap,
    StereoCamera,
    TrackingStatus,
)

CAMERA = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 320.0, "cy": 240.0}
IMAGE = np.zeros((4, 6), np.uint8)


def make_features(n):
    rng = np.random.default_rng(0)
    return Features(
        rng.uniform(0, 100, (n, 2)),
        rng.integers(0, 8, n).astype(np.int32),
        rng.uniform(0, 360, n).astype(np.float32),
        rng.uniform(0, 1, n).astype(np.float32),
        rng.integers(0, 256, (n, 32)).astype(np.uint8),
        rng.uniform(1, 50, n),
    )


def test_camera_gives_baseline_and_intrinsic_matrix():
    camera = StereoCamera(**CAMERA, bf=250.0)
    assert camera.baseline_m == pytest.approx(0.5)
    assert not camera.is_rgbd
    uvw = camera.K @ np.array([0.2, -0.1, 2.0])
    assert uvw[:2] / uvw[2] == pytest.approx([500 * 0.1 + 320, 510 * -0.05 + 240])


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "bf"])
@pytest.mark.parametrize("value", [0, -1])
def test_camera_refuses_what_is_not_positive(name, value):
    with pytest.raises(ValueError, match="expected positive"):
        StereoCamera(**({**CAMERA, "bf": 1.0} | {name: value}))


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3)])
def test_frame_takes_grey_and_color(shape):
    frame = Frame(3, 0.1, np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))
    assert (frame.index, frame.depth_m, frame.instance_labels) == (3, None, None)


def test_frame_has_no_room_for_truth():
    names = {f.name for f in fields(Frame)}
    assert names == {
        "index", "timestamp_s", "image", "image_right", "depth_m", "flow_prev_to_curr_px",
        "instance_labels", "instance_classes",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("image", np.zeros((4, 6), np.float32)),
        ("image", np.zeros(6, np.uint8)),
        ("image_right", np.zeros((4, 5), np.uint8)),
        ("depth_m", np.zeros((6, 4), np.float32)),
        ("depth_m", np.zeros((4, 6, 1), np.float32)),
        ("flow_prev_to_curr_px", np.zeros((4, 6), np.float32)),
        ("flow_prev_to_curr_px", np.zeros((4, 6, 3), np.float32)),
        ("instance_labels", np.zeros((4, 7), np.int32)),
    ],
)
def test_frame_names_the_wrong_array_and_what_was_found(name, array):
    with pytest.raises(ValueError, match=rf"Frame\.{name}: expected .* found") as caught:
        Frame(**({"index": 0, "timestamp_s": 0.0, "image": IMAGE} | {name: array}))
    assert str(array.shape) in str(caught.value)


def test_nouns_are_frozen():
    frame = Frame(0, 0.0, IMAGE)
    with pytest.raises(FrozenInstanceError):
        frame.index = 1  # type: ignore[misc]


@pytest.mark.parametrize("which", [np.array([4, 1, 1]), np.arange(9) % 2 == 0])
def test_features_are_chosen_by_index_or_mask(which):
    features = make_features(9)
    chosen = features[which]
    assert len(chosen) == len(features.uv_px[which])
    for f in fields(Features):
        np.testing.assert_array_equal(
            getattr(chosen, f.name), getattr(features, f.name)[which], err_msg=f.name
        )


def test_features_with_depth_leaves_the_original_alone():
    features = make_features(4)
    before = features.depth_m.copy()
    deeper = features.with_depth(before + 1)
    np.testing.assert_array_equal(features.depth_m, before)
    np.testing.assert_array_equal(deeper.depth_m, before + 1)
    assert deeper.descriptors is features.descriptors


def test_empty_features_have_the_types_of_full_ones():
    empty, full = Features.empty(), make_features(3)
    assert len(empty) == 0
    for f in fields(Features):
        assert getattr(empty, f.name).dtype == getattr(full, f.name).dtype, f.name
    assert len(empty[np.zeros(0, bool)]) == 0


@pytest.mark.parametrize("name", [f.name for f in fields(Features)])
def test_features_of_unequal_length_are_refused(name):
    features = make_features(5)
    arrays = {f.name: getattr(features, f.name) for f in fields(Features)}
    longer = len(arrays[name]) + 1
    arrays[name] = np.resize(arrays[name], (longer, *arrays[name].shape[1:]))
    with pytest.raises(ValueError, match=r"Features\.\w+: expected shape"):
        Features(**arrays)


def test_ground_truth_and_static_map_check_their_shapes():
    GroundTruth(np.arange(3.0), np.zeros((3, 4, 4)))
    with pytest.raises(ValueError, match=r"GroundTruth\.Ts_world_camera: expected shape \(3, 4, 4"):
        GroundTruth(np.arange(3.0), np.zeros((2, 4, 4)))
    good = (
        np.zeros((2, 3)), np.zeros((2, 3), np.uint8), np.ones(2, np.int32), np.zeros((1, 4, 4)),
        np.zeros(1, np.int64),
    )  # fmt: skip
    assert len(StaticMap(*good)) == 2
    with pytest.raises(ValueError, match=r"StaticMap\.colors"):
        StaticMap(good[0], good[1][:1], *good[2:])
    with pytest.raises(ValueError, match=r"StaticMap\.keyframe_Ts_world_camera"):
        StaticMap(*good[:4], np.zeros(2, np.int64))


def test_object_truth_is_parallel_arrays():
    def make(m, boxes):
        ids = np.arange(m)
        return ObjectTruth(
            ids, ids, np.full(m, "car"), np.zeros((m, 4, 4)), np.zeros(boxes), ids > 0
        )

    assert len(make(3, (3, 4))) == 3
    with pytest.raises(ValueError, match=r"boxes_px: expected shape \(3, 4\), found \(3, 2\)"):
        make(3, (3, 2))


def test_frame_result_checks_its_observations():
    def make(n_ids):
        return FrameResult(
            0, 0.0, TrackingStatus.OK, np.eye(4), np.zeros((6, 6)), MotionHypothesis.PNP_RANSAC,
            False, np.zeros((4, 2)), np.zeros(n_ids, np.int64), np.ones(4, bool), 0.5,
        )  # fmt: skip

    assert make(4).timings_ms == {}
    assert make(4).timings_ms is not make(4).timings_ms
    with pytest.raises(ValueError, match=r"FrameResult\.point_ids: expected shape \(4\)"):
        make(3)


def test_names_that_files_carry():
    assert [str(s) for s in TrackingStatus] == ["OK", "LOST"]
    assert f"{MotionHypothesis.RGBD_ODOMETRY}" == "rgbd_odometry"
