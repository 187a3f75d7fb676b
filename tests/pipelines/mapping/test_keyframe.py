"""Tracks as parallel arrays, and when a frame becomes a keyframe."""

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.mapping.keyframe import Keyframe, needs_keyframe
from pipelines.observations import Tracks
from pipelines.types import Features

CONFIG = MappingConfig(keyframe_min_overlap=0.7, keyframe_max_interval=10)


def tracks_of(ids, moved_px=0.0):
    ids = np.asarray(ids, np.int64)
    uv = np.column_stack([ids * 1.0 + moved_px, ids * 2.0])
    return Tracks(ids, uv, np.where(ids % 2 == 0, 5.0, np.nan), ids * 0.1)


def keyframe_of(ids, frame_index=0):
    return Keyframe(frame_index, 0.0, np.eye(4), tracks_of(ids), Features.empty())


def test_stereo_pixels_of_tracks():
    uvr = tracks_of([2, 3]).uvr_px
    np.testing.assert_array_equal(uvr, [[2, 4, -3], [3, 6, np.nan]])


@pytest.mark.parametrize("which", [np.array([3, 0]), np.array([True, False, False, True])])
def test_tracks_are_chosen_by_index_or_mask(which):
    tracks = tracks_of([4, 5, 6, 7])
    chosen = tracks[which]
    assert len(chosen) == 2
    for name in ("point_ids", "uv_px", "disparity_px", "sigma_uv_px"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(tracks, name)[which])


def test_tracks_are_joined_in_order():
    joined = Tracks.concatenate(tracks_of([1, 2]), Tracks.empty(), tracks_of([9]))
    assert joined.point_ids.tolist() == [1, 2, 9]
    assert joined.point_ids.dtype == np.int64
    np.testing.assert_array_equal(joined.uvr_px, tracks_of([1, 2, 9]).uvr_px)
    assert len(Tracks.concatenate(Tracks.empty(), Tracks.empty())) == 0


def test_the_first_frame_is_a_keyframe():
    assert needs_keyframe(CONFIG, tracks_of(range(100)), None, 0)


@pytest.mark.parametrize(
    ("n_shared", "expected"), [(100, False), (71, False), (69, True), (0, True)]
)
def test_a_frame_of_many_new_points_is_a_keyframe(n_shared, expected):
    last = keyframe_of(range(100))
    tracks = tracks_of(range(100 - n_shared, 200 - n_shared), moved_px=4.0)
    assert needs_keyframe(CONFIG, tracks, last, 3) is expected


def test_what_the_keyframe_saw_and_is_lost_does_not_count():
    """Only the present tracks are asked: fifty old points alone need no keyframe."""
    assert not needs_keyframe(CONFIG, tracks_of(range(50), 4.0), keyframe_of(range(400)), 3)


@pytest.mark.parametrize(("frame_index", "expected"), [(14, False), (15, True), (40, True)])
def test_a_keyframe_is_due_after_the_interval(frame_index, expected):
    last = keyframe_of(range(100), frame_index=5)
    assert needs_keyframe(CONFIG, tracks_of(range(100), 4.0), last, frame_index) is expected


@pytest.mark.parametrize("n_shared", [100, 40, 15])
def test_a_camera_that_stands_makes_no_keyframe(n_shared):
    """Neither for long, nor though much of what it sees has changed."""
    tracks = tracks_of(range(100 - n_shared, 200 - n_shared), moved_px=2.0)
    assert not needs_keyframe(CONFIG, tracks, keyframe_of(range(100)), 500)
    tracks = tracks_of(range(100 - n_shared, 200 - n_shared), moved_px=4.0)
    assert needs_keyframe(CONFIG, tracks, keyframe_of(range(100)), 500)


def test_a_frame_that_shares_hardly_a_point_is_a_keyframe():
    assert needs_keyframe(CONFIG, tracks_of(range(90, 190)), keyframe_of(range(100)), 3)


def test_a_frame_without_tracks_does_not_divide_by_zero():
    assert needs_keyframe(CONFIG, Tracks.empty(), keyframe_of(range(10)), 1)
