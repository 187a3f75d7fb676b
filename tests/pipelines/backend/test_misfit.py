"""Weights by misfits: of views that fit badly as a whole, and of errors that last or do not."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend import global_batch
from pipelines.backend.batch_problem import build_problem
from pipelines.backend.held_out import held_out_errors, hold_out
from pipelines.backend.misfit import allow_for_noisy_views, learn_carried, squared_misfits
from pipelines.backend.point_elimination import camera_points
from pipelines.config import BatchConfig
from pipelines.geometry import invert_T, project_stereo
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
    assert np.median(squared_misfits(problem)) == pytest.approx(1.5, abs=1.5)


def with_errors(drive, stereo, carried, sigma_px=0.1):
    """The batch's problem of a drive at the truth, with errors that go on by a share a frame."""
    problem = build_problem(stereo, drive.log, drive.objects)
    tracks, rng = problem.tracks, np.random.default_rng(4)
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    new = rng.normal(0.0, sigma_px, (len(tracks), 2))
    error = new / np.sqrt(max(1.0 - carried**2, 1e-6)) if carried < 1.0 else new.copy()
    for row in np.flatnonzero(tracks.is_followed):
        error[row] = carried * error[row - 1] + new[row]
    seen = camera_points(tracks, views, problem.points_m)
    uv = project_stereo(stereo, seen)[:, :2] + error
    step = np.where(tracks.is_followed, sigma_px * np.sqrt(2.0 / (1.0 + carried)), 0.05)
    tracks = replace(tracks, uv_px=uv, sigma_uv_px=step)
    return problem.with_tracks(tracks, problem.sighting_rows)


@pytest.mark.parametrize("carried", [0.1, 0.5, 0.8, 1.0])
def test_the_share_of_an_error_that_goes_on_is_learned(make_drive, stereo, carried):
    drive = make_drive(0, n_frames=30, n_points=400, jitter=0.0)
    problem = with_errors(drive, stereo, carried)
    learned = learn_carried(problem).tracks
    static = learned.is_followed & (learned.view < problem.n_frames)
    found = learned.carried[static]
    assert np.ptp(found) == 0.0
    assert found[0] == pytest.approx(carried, abs=0.12)
    if carried < 1.0:  # the new part of an error is what was drawn
        assert learned.sigma_uv_px[static][0] == pytest.approx(0.1, rel=0.1)
    others = learned.is_followed & ~static
    assert others.any() and (learned.carried[others] == 1.0).all()
    np.testing.assert_array_equal(learned.is_followed, problem.tracks.is_followed)


@pytest.mark.parametrize("carried", [0.3, 1.0])
def test_held_out_sightings_are_predicted_as_their_errors_last(make_drive, stereo, carried):
    """Squared errors are 1 on average by the right model, at the truth."""
    drive = make_drive(1, n_frames=30, n_points=400, jitter=0.0)
    problem = learn_carried(with_errors(drive, stereo, carried))
    tracks, _, held = hold_out(problem.tracks, problem.sighting_rows, 0.1)
    static = held.view < problem.n_frames
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    far = np.full(len(held), np.nan)  # disparities are not what is asked here
    errors = held_out_errors(
        stereo, tracks, replace(held, disparity_px=far), views, problem.points_m
    )
    assert errors[static].mean() == pytest.approx(1.0, abs=0.15)


def test_little_says_nothing_of_how_errors_last(make_drive, stereo):
    problem = build_problem(stereo, make_drive(0, n_frames=6).log, ObjectEstimates.empty())
    assert learn_carried(problem) is problem
