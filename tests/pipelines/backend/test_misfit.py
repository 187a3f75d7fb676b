"""Weights by misfits: views of objects that fit badly as a whole count less."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend import global_batch
from pipelines.backend.batch_problem import build_problem
from pipelines.backend.misfit import allow_for_noisy_views, object_misfits
from pipelines.config import BatchConfig
from pipelines.geometry import invert_T
from pipelines.object_types import ObjectEstimates

NOISY = 6  # the frame in which the object's points are dragged along


def dragged(drive, by_px):
    """The drive with some of the object's sightings of one frame moved, each by its own share."""
    log = list(drive.log)
    seen = log[NOISY].sightings
    shift = np.random.default_rng(1).uniform(0.3, 1.0, (len(seen), 1)) * by_px
    uv = seen.uv_px + np.where(seen.object_id[:, None] == 1, shift, 0.0)
    log[NOISY] = replace(log[NOISY], sightings=replace(seen, uv_px=uv))
    return replace(drive, log=log)


def test_only_the_noisy_view_is_widened(make_drive, stereo):
    drive = make_drive(1, jitter=0.0)
    clean = build_problem(stereo, drive.log, drive.objects)
    tracks = allow_for_noisy_views(clean).tracks
    np.testing.assert_array_equal(tracks.sigma_uv_px, clean.tracks.sigma_uv_px)
    problem = build_problem(stereo, dragged(drive, (1.0, -0.4)).log, drive.objects)
    wider = allow_for_noisy_views(problem).tracks
    factor = wider.sigma_uv_px / problem.tracks.sigma_uv_px
    noisy = problem.tracks.view == problem.n_frames + NOISY
    assert np.ptp(factor[noisy]) < 1e-9 and 2.0 < factor[noisy][0] <= 4.0
    others = ~noisy & (problem.tracks.view != problem.n_frames + NOISY + 1)  # the way back
    assert (factor[others] == 1.0).all()
    np.testing.assert_allclose(wider.sigma_disparity_px / problem.tracks.sigma_disparity_px, factor)


def test_a_dragged_view_drags_the_motion_less(make_drive, stereo, monkeypatch):
    errors = {}
    for name, allow in (("weighed", allow_for_noisy_views), ("as told", lambda problem: problem)):
        monkeypatch.setattr(global_batch, "allow_for_noisy_views", allow)
        errors[name] = []
        for seed in range(3):
            drive = dragged(make_drive(seed, jitter=0.0002), (1.0, -0.4))
            config = BatchConfig(guard=False, covariances=False, acceleration_mps2=0.05)
            result = global_batch.run_global_batch(stereo, drive.log, drive.objects, config)
            seen_true = invert_T(drive.Ts_true[NOISY]) @ drive.Ls_true[NOISY]
            after = result.after
            seen = invert_T(after.Ts_world_camera[NOISY]) @ after.Ts_world_object[NOISY]
            errors[name].append(np.linalg.norm((seen - seen_true)[:3, 3]))
    share = np.array(errors["weighed"]) / errors["as told"]
    assert (share < 0.95).all() and share.mean() < 0.9


def test_without_objects_nothing_is_weighed(make_drive, stereo):
    problem = build_problem(stereo, make_drive(0, jitter=0.0).log, ObjectEstimates.empty())
    assert allow_for_noisy_views(problem) is problem
    assert len(object_misfits(problem)) == 0


def test_misfits_of_objects_at_the_truth_are_as_the_noise(make_drive, stereo):
    drive = make_drive(0, jitter=0.0)
    problem = build_problem(stereo, drive.log, drive.objects)
    squares = object_misfits(problem)
    assert len(squares) == (problem.tracks.view >= problem.n_frames).sum()
    assert np.median(squares) == pytest.approx(1.5, abs=1.0)
