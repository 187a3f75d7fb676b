"""Standard deviations by the residuals: true where noise is white, and where it is not."""

from dataclasses import replace

import numpy as np

from pipelines.backend.global_batch import run_global_batch
from pipelines.backend.marginals import pose_covariances
from pipelines.backend.object_graph import pose_graph
from pipelines.backend.point_elimination import evaluate
from pipelines.backend.score_bootstrap import bootstrap_covariances
from pipelines.config import BatchConfig
from pipelines.geometry import invert_T, rotation_vector
from pipelines.object_types import ObjectEstimates

CONFIG = BatchConfig(held_out_share=0.05, rounds=1, max_steps=10)


def perturbations(Ts, Ts_true):
    E = invert_T(Ts) @ Ts_true
    return np.concatenate([rotation_vector(E), E[:, :3, 3]], 1)


def drifting(log, rng, cell_px, sigma_px):
    """The log with pixels that drift on and on, alike where tracks begin in one cell."""
    drift, begun, frames = {}, {}, []
    for k, entry in enumerate(log):
        seen = entry.sightings
        uv = seen.uv_px.copy()
        for i, key in enumerate(zip(seen.object_id.tolist(), seen.track_id.tolist(), strict=True)):
            first, cell = begun.setdefault(key, (k, (key[0], *np.floor(uv[i] / cell_px).tolist())))
            if cell not in drift:
                drift[cell] = rng.normal(size=2) * sigma_px
            uv[i] += drift[cell] * (k - first)
        frames.append(replace(entry, sightings=replace(seen, uv_px=uv)))
    return frames


def covariances(result):
    """By the residuals and by the model, at a solution without objects."""
    problem = result.after
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    keep = np.ones(len(problem.tracks), bool)
    residuals = evaluate(problem.camera, problem.tracks, views, problem.points_m, keep, keep)
    graph = pose_graph(problem, CONFIG)
    return [f(problem, graph, residuals) for f in (bootstrap_covariances, pose_covariances)]


def z_scores(make_drive, stereo, alter, seeds=5):
    """Root mean squares of errors of steps over standard deviations: by residuals, by the model."""
    squares = ([], [])
    for seed in range(seeds):
        drive = make_drive(seed)
        log = alter(drive.log, np.random.default_rng(seed))
        result = run_global_batch(stereo, log, ObjectEstimates.empty(), CONFIG)
        Ts, T = result.after.Ts_world_camera, drive.Ts_true
        e = perturbations(invert_T(Ts[:-1]) @ Ts[1:], invert_T(T[:-1]) @ T[1:])
        for found, by in zip(covariances(result), squares, strict=True):
            by.append(e**2 / np.diagonal(found.camera_steps, axis1=1, axis2=2)[1:])
    return [float(np.sqrt(np.mean(by))) for by in squares]


def test_white_noise_gives_what_it_did(make_drive, stereo):
    by_residuals, _ = z_scores(make_drive, stereo, lambda log, rng: log)
    assert 0.6 < by_residuals < 1.3


def test_lasting_errors_of_patches_make_it_wider(make_drive, stereo):
    by_residuals, by_model = z_scores(
        make_drive, stereo, lambda log, rng: drifting(log, rng, 80.0, 0.25)
    )
    assert by_model > 2.0
    assert 0.7 < by_residuals < 1.3


def test_draws_repeat(make_drive, stereo):
    drive = make_drive(1)
    result = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    again = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    for name in ("cameras", "camera_steps", "objects", "steps"):
        a, b = (getattr(r.covariances, name) for r in (result, again))
        np.testing.assert_array_equal(a, b)
    found = result.covariances
    assert np.abs(found.cameras[0]).max() < 1e-10  # held
    first = [s.first_pose for s in result.before.stretches]
    assert (
        np.isnan(found.steps[first]).all() and np.isfinite(np.delete(found.steps, first, 0)).all()
    )
    smallest = np.linalg.eigvalsh(found.cameras[1:]).min()
    assert smallest > 0.0
