"""Loops found again in rendered images, and none where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend import loop_detection
from pipelines.backend.loop_detection import LoopDetector
from pipelines.datasets.simulated.sequence import SimulatedSequence
from pipelines.dyob_slam import DyObSlam
from pipelines.geometry import exp_se3, rotation_angle_deg
from pipelines.mapping.keyframe import Keyframe
from pipelines.observations import Tracks
from pipelines.types import Features

real = loop_detection._may_be_drift
DRIFT = exp_se3(np.array([0.0, 0.02, 0.0, 0.3, 0.0, 0.2]))


@pytest.fixture(scope="module")
def mapped():
    """A map of some frames, the detector that has seen them, and their features."""
    sequence = SimulatedSequence("static", frames=12, scale=0.5)
    slam = DyObSlam(sequence.camera)
    detector = LoopDetector(slam.sensor, slam.places)
    features = []
    for index in range(12):
        prepared = slam.prepare(sequence.read(index))
        if slam.process(prepared).is_keyframe:
            assert detector.take(slam.map, prepared.features) is None
        features.append(prepared.features)
    return sequence, slam, detector, features


def come_again(slam: DyObSlam, T: np.ndarray, descriptors: np.ndarray) -> None:
    """A keyframe that tracking led to a drifted pose, where it knew no point."""
    last = slam.map.keyframes[-1]
    index, stamp = last.frame_index + 1, last.timestamp_s + 0.1
    slam.map.add_keyframe(Keyframe(index, stamp, T, Tracks.empty(), Features.empty()))
    slam.places.add(len(slam.map.keyframes) - 1, descriptors)


def test_a_place_seen_again_is_found_where_it_is(mapped, monkeypatch) -> None:
    sequence, slam, detector, features = mapped
    monkeypatch.setattr(loop_detection, "_RECENT", 1)
    truth = sequence.ground_truth().Ts_world_camera
    truth = np.linalg.inv(truth[0]) @ truth
    come_again(slam, DRIFT @ truth[1], features[1].descriptors)
    assert detector.take(slam.map, features[1]) is None  # one alone is no proof
    come_again(slam, DRIFT @ truth[2], features[2].descriptors)
    closure = detector.take(slam.map, features[2])
    assert closure is not None
    assert slam.map.keyframes[closure.place].frame_index < 12
    error = np.linalg.inv(truth[2]) @ closure.T_world_camera
    assert 1e-6 < np.linalg.norm(error[:3, 3]) < 0.05
    assert rotation_angle_deg(error) < 0.2
    assert len(closure.tracks) >= 50
    assert np.abs(closure.off @ DRIFT - np.eye(4)).max() < 0.05


def test_places_that_disagree_are_no_loop(mapped, monkeypatch) -> None:
    sequence, slam, detector, features = mapped
    monkeypatch.setattr(loop_detection, "_RECENT", 1)
    truth = sequence.ground_truth().Ts_world_camera
    truth = np.linalg.inv(truth[0]) @ truth
    aside = exp_se3(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
    come_again(slam, DRIFT @ truth[3], features[3].descriptors)
    assert detector.take(slam.map, features[3]) is None
    come_again(slam, aside @ truth[4], features[4].descriptors)
    assert detector.take(slam.map, features[4]) is None


def test_a_copy_of_a_house_down_the_road_is_no_loop(mapped, monkeypatch) -> None:
    """All agrees, but nobody drifts by half of the way."""
    sequence, slam, detector, features = mapped
    monkeypatch.setattr(loop_detection, "_RECENT", 1)
    truth = sequence.ground_truth().Ts_world_camera
    truth = np.linalg.inv(truth[0]) @ truth
    way_m = np.linalg.norm(truth[11, :3, 3])
    far = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 2.0 * way_m]))
    found = []
    monkeypatch.setattr(loop_detection, "_may_be_drift", lambda *a: found.append(a) or real(*a))
    for k in (5, 6):
        come_again(slam, far @ truth[k], features[k].descriptors)
        assert detector.take(slam.map, features[k]) is None
    assert len(found) >= 2  # they were proved but for this


def test_what_was_never_seen_is_no_loop(mapped, monkeypatch) -> None:
    _, slam, detector, features = mapped
    monkeypatch.setattr(loop_detection, "_RECENT", 1)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, features[1].descriptors.shape, dtype=np.uint8)
    for _ in range(2):
        come_again(slam, np.eye(4), noise)
        assert detector.take(slam.map, replace(features[1], descriptors=noise)) is None
