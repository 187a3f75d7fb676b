"""Errors of objects: exact estimates, known noise, spans of several frames, false and missed."""

import numpy as np
import pytest

from pipelines.evaluation.object_truth import ObjectLimits
from pipelines.evaluation.objects import evaluate_objects, pose_errors
from pipelines.geometry import exp_se3, invert_T
from pipelines.object_types import ObjectEstimates


def test_truth_as_estimate_is_faultless(world):
    found = evaluate_objects(world.estimates(), world.truth(), world.frames())
    assert found["object_frames"] == 2 * 29
    for block in ("motion", "pose"):
        assert found[block]["trans_max_m"] < 1e-9
        assert found[block]["rot_max_deg"] < 1e-9
    assert found["pose"]["tracks"] == 2  # the parked car has no part in it
    assert found["speed"]["error_max_kmh"] < 1e-9
    assert found["smoothed_speed"]["error_max_kmh"] < 1e-9
    assert found["speed"]["inside_95_share"] == 1.0
    assert found["coverage"]["truth"] > 40  # both cars, until they are 25 m away
    assert found["coverage"]["share"] == 1.0
    assert found["false_movers"] == found["ghosts"] == found["id_switches_while_moving"] == 0
    for block in ("tracking", "tracking_moving"):
        assert found[block]["mota"] == found[block]["idf1"] == 1.0
        assert found[block]["motp_overlap"] == pytest.approx(1.0)
    assert found["per_object"]["2"]["estimated_ids"] == [12]
    assert not found["per_object"]["3"]["moves"]


def test_known_noise_gives_its_rmse(world):
    """Noise in the object's frame before: sigma a metre axis, so RMSE is sqrt(3) sigma."""
    rng, truth, exact = np.random.default_rng(3), world.truth(), world.estimates()
    Hs = exact.Hs_world_curr_prev.copy()
    for i in np.flatnonzero(np.isfinite(Hs).all((1, 2))):
        k, j = exact.frame_index[i], exact.object_id[i] - 10
        L = world.poses[j][k - 1]
        xi = np.concatenate([rng.normal(0, np.radians(0.2), 3), rng.normal(0, 0.03, 3)])
        Hs[i] = Hs[i] @ L @ exp_se3(xi) @ invert_T(L)
    noisy_kmh = rng.normal(0.5, 0.7, len(exact))
    noisy = world.changed(
        exact,
        Hs_world_curr_prev=Hs,
        speed_mps=exact.speed_mps + noisy_kmh / 3.6,
        speed_std_mps=np.full(len(exact), 0.7 / 3.6),
    )
    found = evaluate_objects(noisy, truth, world.frames())
    assert found["motion"]["trans_rmse_m"] == pytest.approx(np.sqrt(3) * 0.03, rel=0.15)
    assert found["motion"]["rot_rmse_deg"] == pytest.approx(np.sqrt(3) * 0.2, rel=0.15)
    own = noisy_kmh[(exact.state == "moving")]
    assert found["speed"]["signed_mean_kmh"] == pytest.approx(own.mean())
    assert found["speed"]["error_mean_kmh"] == pytest.approx(np.abs(own).mean())
    assert found["speed"]["error_rmse_kmh"] == pytest.approx(np.sqrt(np.mean(own**2)))
    assert found["speed"]["inside_95_share"] == pytest.approx(np.mean(np.abs(own) < 1.96 * 0.7))
    vdo = found["vdo_compatible"]
    assert vdo["trans_mean_m"] == found["motion"]["trans_mean_m"]
    assert set(vdo["per_object"]) == {"1", "2"}


def test_a_world_origin_far_away_changes_nothing(world):
    """Errors are in the object's frame: the same noise at another place gives the same figures."""
    T = exp_se3(np.array([0.3, 2.0, -0.4, 900.0, -300.0, 40.0]))
    rng, truth, exact = np.random.default_rng(0), world.truth(), world.estimates()
    Hs = exact.Hs_world_curr_prev.copy()
    Hs[:, :3, 3] += rng.normal(0, 0.05, (len(Hs), 3))
    near = evaluate_objects(world.changed(exact, Hs_world_curr_prev=Hs), truth, world.frames())
    moved = world.changed(
        exact,
        Hs_world_curr_prev=T @ Hs @ invert_T(T),
        Ts_world_object=T @ exact.Ts_world_object,
    )
    far_truth = world.truth()
    far_truth.Ts_world_object[:] = T @ far_truth.Ts_world_object
    world.cameras = T @ world.cameras
    far = evaluate_objects(moved, far_truth, world.frames())
    assert near["motion"]["trans_rmse_m"] == pytest.approx(np.sqrt(3) * 0.05, rel=0.2)
    assert far["motion"]["trans_rmse_m"] == pytest.approx(near["motion"]["trans_rmse_m"], rel=1e-6)
    assert far["coverage"] == near["coverage"]


@pytest.mark.parametrize("index", [np.arange(3, 30, 3), np.array([4, 5, 9, 10, 17])])
def test_motions_span_the_frames_between(world, index):
    """A run with a start and a stride, and one with frames that could not be read."""
    found = evaluate_objects(world.estimates(index), world.truth(), world.frames(index))
    assert found["object_frames"] == 2 * (len(index) - 1)
    assert found["motion"]["trans_max_m"] < 1e-9
    assert found["speed"]["error_max_kmh"] < 1e-9
    assert found["tracking"]["mota"] == 1.0
    # Taken as motions of one frame the same estimates would be badly wrong.
    wrong = evaluate_objects(world.estimates(index), world.truth(), world.frames())
    assert wrong["motion"]["trans_max_m"] > 0.5


def test_missed_false_and_ghosts_are_counted(world):
    exact = world.estimates()
    state = exact.state.copy()
    boxes = exact.boxes_px.copy()
    parked, first = exact.object_id == 13, exact.object_id == 11
    Hs = exact.Hs_world_curr_prev
    state[parked & np.isin(exact.frame_index, [4, 5, 6])] = "moving"
    state[first & np.isin(exact.frame_index, [7, 8])] = "stopped"
    boxes[first & (exact.frame_index == 9)] = [800.0, 300.0, 860.0, 340.0]  # over nothing
    objects = world.changed(exact, state=state, boxes_px=boxes, Hs_world_curr_prev=Hs)
    found = evaluate_objects(objects, world.truth(), world.frames())
    assert found["false_movers"] == 3
    assert found["ghosts"] == 1
    exact_found = evaluate_objects(exact, world.truth(), world.frames())["coverage"]
    assert found["coverage"]["truth"] == exact_found["truth"]
    assert found["coverage"]["found"] == exact_found["found"] - 3
    assert found["tracking"]["missed"] == 1
    assert found["tracking"]["false"] == 1
    assert found["tracking"]["fragmentations"] == 1


@pytest.mark.parametrize(("deg_a_frame", "n_false"), [(0.0, 3), (1.5, 3), (3.0, 0)])
def test_what_turns_on_the_spot_does_not_stand_still(world, deg_a_frame, n_false):
    """At 30 deg/s its matter moves, though its origin does not; 15 may be the labels' noise."""
    spin = exp_se3(np.array([0.0, np.radians(deg_a_frame), 0.0, 0.0, 0.0, 0.0]))
    for k in (5, 6, 7):
        world.poses[2][k] = world.poses[2][k - 1] @ spin
    found = evaluate_objects(world.estimates(), world.truth(), world.frames())
    assert found["false_movers"] == n_false


def test_what_is_too_small_or_too_far_is_not_wanted(world):
    truth = world.truth()
    truth.n_pixels[truth.object_id == 2] = 149
    found = evaluate_objects(world.estimates(), truth, world.frames())
    assert set(found["per_object"]) == {"1", "3"}
    assert found["object_frames"] == 29
    assert found["ghosts"] == 0  # an estimate over truth too small to judge is no ghost
    assert found["tracking"]["false"] == 0
    near = evaluate_objects(
        world.estimates(), world.truth(), world.frames(), ObjectLimits(max_distance_m=10.5)
    )
    whole = evaluate_objects(world.estimates(), world.truth(), world.frames())
    assert 10 < near["coverage"]["truth"] < whole["coverage"]["truth"] - 10
    assert near["object_frames"] == 2 * 29  # errors count at any distance


def test_without_masks_boxes_say_what_is_large_enough(world):
    truth = world.truth()
    bare = type(truth)(*(getattr(truth, name) for name in truth.__slots__[:-1]))
    assert bare.n_pixels is None
    found = evaluate_objects(world.estimates(), bare, world.frames())
    assert found["object_frames"] == 2 * 29
    strict = ObjectLimits(min_pixels=60 * 40 + 1)
    assert evaluate_objects(world.estimates(), bare, world.frames(), strict)["object_frames"] == 0


def test_nothing_estimated_and_nothing_true(world):
    none = evaluate_objects(ObjectEstimates.empty(), world.truth(), world.frames())
    assert none["coverage"]["share"] == 0.0
    assert none["motion"]["trans_rmse_m"] is None
    assert none["tracking"]["mota"] == 0.0
    empty = world.truth()[np.zeros(90, bool)]
    found = evaluate_objects(world.estimates(), empty, world.frames())
    assert found["coverage"]["share"] is None
    assert found["ghosts"] == 2 * 29
    assert found["tracking"]["mota"] is None


def test_the_frame_of_an_object_may_sit_anywhere_in_it(world):
    gt = world.poses[2]
    D = exp_se3(np.array([0.5, 1.0, -0.3, 0.4, -0.2, 0.9]))
    t, r = pose_errors(gt @ D, gt)
    assert t.max() < 1e-9
    assert r.max() < 1e-6
    rng = np.random.default_rng(1)
    noise = np.array([exp_se3(rng.normal(0, s, 6)) for s in [0.02] * len(gt)])
    t, r = pose_errors(gt @ D @ noise, gt)
    assert np.sqrt(np.mean(t**2)) == pytest.approx(np.sqrt(3) * 0.02, rel=0.25)
    assert np.sqrt(np.mean(r**2)) == pytest.approx(np.degrees(np.sqrt(3) * 0.02), rel=0.25)
