"""The share of an error that goes on from frame to frame: learned, whatever the poses."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend.batch_problem import build_problem
from pipelines.backend.carried_errors import learn_carried
from pipelines.backend.held_out import held_out_errors, hold_out
from pipelines.backend.point_elimination import camera_points
from pipelines.geometry import exp_se3, project_stereo
from pipelines.object_types import ObjectEstimates


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


@pytest.mark.parametrize("carried", [0.1, 0.8, 1.0])
def test_poses_that_err_anew_in_each_frame_are_not_taken_for_errors_of_pixels(
    make_drive, stereo, carried
):
    drive = make_drive(0, n_frames=30, n_points=400, jitter=0.0)
    problem = with_errors(drive, stereo, carried)
    off = np.random.default_rng(2).normal(size=(problem.n_frames, 6)) * ([0.002] * 3 + [0.02] * 3)
    Ts = problem.Ts_world_camera @ exp_se3(off)
    learned = learn_carried(problem.at(Ts, problem.Ts_world_object, problem.points_m)).tracks
    static = learned.is_followed & (learned.view < problem.n_frames)
    assert learned.carried[static][0] == pytest.approx(carried, abs=0.12)


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
