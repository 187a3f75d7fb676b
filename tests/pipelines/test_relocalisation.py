"""Kidnapped cameras: put back into a place seen before they are found, in a strange one not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import Config
from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.io.config import load_config
from pipelines.types import Array, FrameResult, MotionHypothesis, TrackingStatus

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST
RELOCALISATION = MotionHypothesis.RELOCALISATION


def settings(*more: str) -> Config:
    """So many keyframes that the latest ones, which are always tried, do not reach the start."""
    return load_config(None, ["mapping.keyframe_max_interval=1", *more])


def drive(
    slam: DyObSlam, sequence: Sequence, order: Iterable[int], n_before=0
) -> list[FrameResult]:
    """Frames in another order than they were taken in, as one recording without cuts.

    The flow is kept only where the frame before is the one that it starts at.
    """
    results, last = [], None
    for n, k in enumerate(order, start=n_before):
        frame = sequence.read(k)
        flow = frame.flow_prev_to_curr_px if last == k - 1 else None
        frame = replace(frame, index=n, timestamp_s=0.1 * n, flow_prev_to_curr_px=flow)
        results.append(slam.process(frame))
        last = k
    return results


def off_m_deg(T: Array, sequence: Sequence, k: int, origin: int) -> tuple[float, float]:
    """Error of a pose in the world of frame `origin`, where the run began."""
    Ts = sequence.ground_truth().Ts_world_camera
    E = invert_T(invert_T(Ts[origin]) @ Ts[k]) @ T
    return float(np.linalg.norm(E[:3, 3])), float(rotation_angle_deg(E))


def first_found(results: list[FrameResult]) -> int:
    return [r.status for r in results].index(OK)


def assert_found(
    back: list[FrameResult],
    sequence: Sequence,
    first: int,
    *,
    within: int,
    metres: float,
    degrees: float,
    origin: int = 0,
) -> None:
    """Found within so many frames, kept from then on, and all the time where it truly is.

    back: of frames `first`, `first` + 1, ... of the sequence. metres, degrees: the largest errors.
    """
    n = first_found(back)
    assert n < within
    assert back[n].hypothesis is RELOCALISATION
    assert [r.status for r in back[n:]] == [OK] * (len(back) - n)
    for k, result in enumerate(back[n:], start=first + n):
        off_m, off_deg = off_m_deg(result.T_world_camera, sequence, k, origin)
        assert 1e-5 < off_m < metres
        assert 1e-5 < off_deg < degrees


def test_put_back_to_the_beginning_the_camera_is_found_by_how_the_place_looks(street) -> None:
    slam = DyObSlam(street.camera, settings())
    drive(slam, street, range(20))
    assert len(slam.places) == len(slam.map.keyframes) > 8  # beyond the latest that are tried
    back = drive(slam, street, range(1, 8), 20)
    assert_found(back, street, 1, within=3, metres=0.05, degrees=0.15)


def test_a_jump_tells_no_speed_of_objects_and_leaves_no_velocity(street) -> None:
    slam = DyObSlam(street.camera, settings())
    before = drive(slam, street, range(20))
    assert np.isfinite(before[-1].objects.motion_covariances).all(axis=(1, 2)).any()
    back = drive(slam, street, range(1, 8), 20)
    n = first_found(back)
    assert np.isnan(back[n].objects.motion_covariances).any(axis=(1, 2)).all()
    speeds_mps = np.concatenate([r.objects.speed_mps for r in back[n:]])
    assert np.isfinite(speeds_mps).sum() > 3
    assert np.nanmax(speeds_mps) < 40.0  # 18 m of a jump in 0.1 s would be 180 m/s
    # the frame after the jump is expected near, not as far again
    step = invert_T(back[n].T_world_camera) @ back[n + 1].T_world_camera
    assert np.linalg.norm(step[:3, 3]) < 2.0


def test_a_strange_street_is_not_taken_for_a_known_one(street, other_place) -> None:
    config = settings("tracking.restart_after_frames=99")
    slam = DyObSlam(street.camera, config)
    drive(slam, street, range(20))
    strange = drive(slam, other_place, range(6), 20)
    assert [r.status for r in strange] == [LOST] * 6
    assert first_found(drive(slam, street, range(1, 4), 26)) == 0  # and the true one is


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "degrade"), [("static", None), ("street", "all")])
def test_forty_frames_back_the_camera_is_found_within_five(scene, degrade, render_cache) -> None:
    more = {"degrade": degrade} if degrade else {}
    sequence = open_sequence(f"simulated:{scene}", frames=60, scale=0.4, cache=render_cache, **more)
    slam = DyObSlam(sequence.camera)
    drive(slam, sequence, range(60))
    back = drive(slam, sequence, range(6, 16), 60)
    assert_found(back, sequence, 6, within=5, metres=0.15, degrees=0.15)


def test_a_hundred_frames_back_in_a_room_the_camera_is_found_within_five(render_cache) -> None:
    """Every second frame of a camera that looks around; it is put back between two of them."""
    sequence = open_sequence("simulated:room", frames=112, scale=0.3, cache=render_cache)
    slam = DyObSlam(sequence.camera)
    before = drive(slam, sequence, range(1, 112, 2))
    back = drive(slam, sequence, range(111 - 100, 111 - 95), len(before))
    assert_found(back, sequence, 11, within=5, metres=0.2, degrees=2.0, origin=1)


def test_a_hundred_frames_back_in_a_real_kitchen_the_camera_is_found(real_data) -> None:
    """Every second frame of a Kinect, 3 a second, and back to one that was left out."""
    sequence = open_sequence(real_data("7scenes_redkitchen_200f"))
    slam = DyObSlam(sequence.camera)
    before = drive(slam, sequence, range(60, 172, 2))
    assert [r.status for r in before] == [OK] * 56
    back = drive(slam, sequence, range(71, 76), 56)
    assert_found(back, sequence, 71, within=5, metres=0.05, degrees=1.5, origin=60)


@pytest.mark.slow
def test_without_places_the_latest_keyframes_do_not_find_it(render_cache) -> None:
    sequence = open_sequence("simulated:static", frames=60, scale=0.4, cache=render_cache)
    slam = DyObSlam(sequence.camera, load_config(None, ["places.relocalise_among=0"]))
    drive(slam, sequence, range(60))
    assert [r.status for r in drive(slam, sequence, range(6, 10), 60)] == [LOST] * 4
