"""The Cramer-Rao bound: met by the best estimate of what was seen, and reported by `eval`."""

import json

import numpy as np
import pytest

from pipelines.backend.batch_solver import solve
from pipelines.backend.object_graph import gauge_graph
from pipelines.datasets import open_sequence
from pipelines.errors import FormatError
from pipelines.evaluation import evaluate_result, metrics_text
from pipelines.evaluation.bound import (
    camera_step_errors,
    causal_bounds,
    compare,
    joint_bounds,
)
from pipelines.evaluation.folder import processed_frames
from pipelines.evaluation.objects import LIMITS
from pipelines.evaluation.true_problem import build_true_problem, find_true_objects
from pipelines.geometry import invert_T
from pipelines.io import folder as names
from pipelines.io.observations import read_observations
from pipelines.runner import run
from pipelines.types import KnownNoise

N_FRAMES = 14  # of the 20 that are rendered, which other tests share
OPTIONS = {"frames": 20, "scale": 0.4}


@pytest.fixture(scope="module")
def sequence(render_cache):
    return open_sequence("simulated:street", degrade="white", cache=render_cache, **OPTIONS)


@pytest.fixture(scope="module")
def result(sequence, tmp_path_factory):
    return run(sequence, output=tmp_path_factory.mktemp("white") / "result", frames=N_FRAMES)


def true_problem(result, sequence, noise):
    objects = result.objects
    frames = processed_frames(result)
    them = find_true_objects(objects, result.gt_objects, frames, LIMITS)
    log = read_observations(result.folder / names.OBSERVATIONS)
    return build_true_problem(sequence.camera, log, objects, them, frames, noise)


@pytest.fixture(scope="module")
def problem(result, sequence):
    return true_problem(result, sequence, sequence.ground_truth().noise)


def test_the_best_estimate_of_what_was_seen_meets_the_bound(problem):
    """Maximum likelihood with the true noise, from the truth: the bound is neither low nor high."""
    every = np.ones(len(problem.tracks), bool)
    best = solve(problem, gauge_graph(problem), every, every, 8).problem
    bounds = joint_bounds(problem)
    steps = compare(camera_step_errors(best.Ts_world_camera, problem), bounds.camera_steps)
    assert steps["n"] == N_FRAMES - 1
    assert 0.7 < steps["trans_ratio"] < 1.6 and 0.7 < steps["rot_ratio"] < 1.6
    objects = compare(invert_T(problem.Ts_world_object) @ best.Ts_world_object, bounds.objects)
    assert objects["n"] >= N_FRAMES
    assert 0.7 < objects["trans_ratio"] < 2.0 and 0.7 < objects["rot_ratio"] < 2.0


def test_what_later_frames_saw_helps_all_steps_but_the_last(problem):
    causal, joint = causal_bounds(problem), joint_bounds(problem)
    own, all_seen = (np.trace(c.camera_steps, axis1=1, axis2=2) for c in (causal, joint))
    assert (own[1:-1] > all_seen[1:-1]).all()
    np.testing.assert_allclose(causal.camera_steps[-1], joint.camera_steps[-1], rtol=1e-3)
    ends = [s.first_pose + len(s) - 1 for s in problem.stretches if s.frames[-1] == N_FRAMES - 1]
    assert ends
    np.testing.assert_allclose(
        np.diagonal(causal.objects[ends], axis1=1, axis2=2),
        np.diagonal(joint.steps[ends], axis1=1, axis2=2),
        rtol=1e-2,
    )


def test_twice_the_noise_is_twice_the_bound(problem, result, sequence):
    noise = sequence.ground_truth().noise
    twice = KnownNoise(2.0 * noise.flow_px, 2.0 * noise.disparity_px)
    loud = joint_bounds(true_problem(result, sequence, twice)).camera_steps[1:]
    quiet = joint_bounds(problem).camera_steps[1:]
    ratio = np.sqrt(np.trace(loud, axis1=1, axis2=2) / np.trace(quiet, axis1=1, axis2=2))
    assert np.abs(ratio - 2.0).max() < 0.1


def test_eval_reports_the_ratios(result):
    assert "bound" not in result.metrics  # the run itself takes no time for it
    metrics = evaluate_result(result.folder, with_bound=True)
    bound = metrics["bound"]
    assert bound["noise"] == {"flow_px": 0.1, "disparity_px": 0.5}
    for key in ("motion_only_ba", "object_motion", "batch_camera_step", "batch_object_motion"):
        assert bound[key]["n"] >= N_FRAMES - 1, key
        for name in ("trans", "rot"):
            # The smoothness of motions, which the bound does not know of, helps weak objects
            assert 0.5 < bound[key][f"{name}_ratio"] < 4.0, (key, name)
    text = metrics_text(metrics)
    assert "Over the Cramer-Rao bound" in text and "Batch: object motion" in text
    assert json.loads((result.folder / "metrics.json").read_text())["bound"] == bound


def test_no_bound_where_the_noise_is_not_known(result, street, tmp_path):
    assert street.ground_truth().noise is None
    assert "bound" not in evaluate_result(result.folder)
    noise = result.folder / names.NOISE_GT
    kept = noise.read_text()
    try:
        noise.write_text('{"sigma": 1.0}')
        with pytest.raises(FormatError, match="expected flow_px and disparity_px"):
            evaluate_result(result.folder, with_bound=True)
        noise.unlink()
        assert "bound" not in evaluate_result(result.folder, with_bound=True)
    finally:
        noise.write_text(kept)
