"""Camera errors against evo's own numbers and against errors of known size."""

import numpy as np
import pytest

from pipelines.evaluation.camera import align, associate, evaluate_camera
from pipelines.geometry import exp_se3, make_T


def drive(n: int, step_m: float = 0.8, turn_rad: float = 0.01) -> np.ndarray:
    step = exp_se3(np.array([0.0, turn_rad, 0.0, 0.0, 0.0, step_m]))
    Ts = np.tile(np.eye(4), (n, 1, 1))
    for k in range(1, n):
        Ts[k] = Ts[k - 1] @ step
    return Ts


def noisy_steps(Ts: np.ndarray, sigma_rad: float, sigma_m: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sigma = np.array([sigma_rad] * 3 + [sigma_m] * 3)
    out = Ts.copy()
    for k in range(1, len(Ts)):
        out[k] = out[k - 1] @ np.linalg.inv(Ts[k - 1]) @ Ts[k] @ exp_se3(rng.normal(size=6) * sigma)
    return out


ANYWHERE = make_T(exp_se3(np.array([0.4, -1.2, 0.3, 0, 0, 0]))[:3, :3], np.array([50.0, -7.0, 3.0]))


def test_no_error_is_no_error():
    Ts, stamps = drive(60), np.arange(60) * 0.1
    metrics = evaluate_camera(stamps, Ts, stamps, ANYWHERE @ Ts)
    assert metrics["frames_matched"] == 60
    assert metrics["rpe_pairs"] == 59
    assert metrics["ate_rmse_m"] < 1e-9
    assert metrics["rpe_trans_max_m"] < 1e-9
    assert metrics["rpe_rot_max_deg"] < 1e-8  # arccos of the trace would stop at 1e-6
    assert metrics["step_length_ratio"] == pytest.approx(1.0, abs=1e-12)
    assert metrics["path_length_m"] == pytest.approx(59 * 0.8, rel=1e-3)


def test_evo_agrees():
    evo_metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PoseTrajectory3D

    gt, stamps = ANYWHERE @ drive(150), np.arange(150) * 0.1
    est = noisy_steps(drive(150), 1e-3, 0.02)
    ours = evaluate_camera(stamps, est, stamps, gt)

    reference = PoseTrajectory3D(poses_se3=list(gt), timestamps=stamps)
    relation = evo_metrics.PoseRelation
    for name, unit, kind in (
        ("rpe_trans", "m", relation.translation_part),
        ("rpe_rot", "deg", relation.rotation_angle_deg),
    ):
        rpe = evo_metrics.RPE(kind, 1, evo_metrics.Unit.frames)
        rpe.process_data((reference, PoseTrajectory3D(poses_se3=list(est), timestamps=stamps)))
        theirs = rpe.get_all_statistics()
        for statistic in ("rmse", "mean", "median", "max"):
            assert ours[f"{name}_{statistic}_{unit}"] == pytest.approx(theirs[statistic], rel=1e-6)
    moved = PoseTrajectory3D(poses_se3=[T.copy() for T in est], timestamps=stamps)
    moved.align(reference)
    ape = evo_metrics.APE(relation.translation_part)
    ape.process_data((reference, moved))
    assert ours["ate_rmse_m"] == pytest.approx(ape.get_all_statistics()["rmse"], rel=1e-9)
    assert 0.05 < ours["ate_rmse_m"] < 3.0


def test_a_constant_step_error_is_found_exactly():
    E = exp_se3(np.array([0.0, 0.0, np.radians(0.003), 0.0, 0.004, 0.0]))
    gt = drive(50)
    est = np.array([np.linalg.matrix_power(np.linalg.inv(gt[0]) @ gt[1] @ E, k) for k in range(50)])
    metrics = evaluate_camera(np.arange(50), est, np.arange(50), gt)
    for statistic in ("rmse", "mean", "median", "max"):
        assert metrics[f"rpe_rot_{statistic}_deg"] == pytest.approx(0.003, rel=1e-6)
        assert metrics[f"rpe_trans_{statistic}_m"] == pytest.approx(0.004, rel=1e-3)


@pytest.mark.parametrize("scale", [0.98, 1.03])
def test_kitti_segments_see_a_scale_error(scale):
    gt = drive(5000, step_m=0.2, turn_rad=0.0)
    est = gt.copy()
    est[:, :3, 3] *= scale
    metrics = evaluate_camera(np.arange(5000) * 0.1, est, np.arange(5000) * 0.1, gt)
    assert metrics["kitti_t_rel_percent"] == pytest.approx(100 * abs(scale - 1), rel=3e-3)
    assert metrics["kitti_r_rel_deg_per_100m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["step_length_ratio"] == pytest.approx(scale, rel=1e-9)


def test_kitti_rotation_error_is_per_100_m():
    gt = drive(3000, step_m=0.2, turn_rad=0.0)
    drift = np.radians(0.5) / 500  # 0.5 deg in 100 m of 500 steps, about the direction of travel
    roll = exp_se3(np.array([0.0, 0.0, drift, 0.0, 0.0, 0.2]))
    est = np.array([np.linalg.matrix_power(roll, k) for k in range(3000)])
    metrics = evaluate_camera(np.arange(3000) * 0.1, est, np.arange(3000) * 0.1, gt)
    assert metrics["kitti_r_rel_deg_per_100m"] == pytest.approx(0.5, rel=5e-3)


def test_short_paths_have_no_kitti_error():
    Ts, stamps = drive(60), np.arange(60) * 0.1
    metrics = evaluate_camera(stamps, Ts, stamps, Ts)
    assert metrics["kitti_t_rel_percent"] is None
    assert metrics["kitti_r_rel_deg_per_100m"] is None


def test_pairs_never_span_a_lost_frame():
    gt, stamps = drive(30), np.arange(30) * 0.1
    est = gt.copy()
    est[12:, :3, 3] += [0.0, 5.0, 0.0]  # a jump hidden in the lost stretch
    tracked = np.r_[0:10, 12:30]
    metrics = evaluate_camera(stamps[tracked], est[tracked], stamps, gt)
    assert metrics["rpe_pairs"] == 26
    assert metrics["rpe_trans_max_m"] < 1e-9
    assert metrics["ate_rmse_m"] > 0.5


def test_unknown_truth_breaks_pairs_too():
    gt, stamps = drive(30), np.arange(30) * 0.1
    gt_holes = gt.copy()
    gt_holes[[5, 6]] = np.nan
    metrics = evaluate_camera(stamps, gt, stamps, gt_holes)
    assert metrics["frames_matched"] == 28
    assert metrics["rpe_pairs"] == 26
    assert metrics["ate_rmse_m"] < 1e-9


def test_association_is_one_to_one_and_close():
    a = np.array([0.0, 0.1, 0.205, 0.30, 0.5])
    b = np.array([0.019, 0.1, 0.195, 0.21, 0.33, 0.5])
    rows_a, rows_b = associate(a, b)
    assert rows_a.tolist() == [0, 1, 2, 4]
    assert rows_b.tolist() == [0, 1, 3, 5]
    rows_a, rows_b = associate(np.array([1.0, 1.001, 1.002]), np.array([1.0005]))
    assert len(rows_a) == len(rows_b) == 1
    assert associate(np.array([0.0]), np.array([0.02]))[0].tolist() == [0]
    assert associate(np.array([0.0]), np.array([0.0201]))[0].tolist() == []


def test_association_ignores_the_order_of_rows():
    rng = np.random.default_rng(2)
    b = rng.permutation(np.arange(50) * 0.1)
    a = np.arange(3, 40) * 0.1 + rng.uniform(-0.01, 0.01, 37)
    rows_a, rows_b = associate(a, b)
    assert len(rows_a) == 37
    np.testing.assert_allclose(b[rows_b], a[rows_a], atol=0.011)


def test_a_perfectly_straight_path_can_be_aligned():
    gt = drive(20, turn_rad=0.0)
    metrics = evaluate_camera(np.arange(20), ANYWHERE @ gt, np.arange(20), gt)
    assert metrics["ate_rmse_m"] < 1e-9
    standing = np.tile(np.eye(4), (5, 1, 1))
    metrics = evaluate_camera(np.arange(5), standing, np.arange(5), standing)
    assert metrics["ate_rmse_m"] < 1e-12
    assert metrics["step_length_ratio"] is None


def test_alignment_never_mirrors():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(30, 3))
    mirrored = points * [1.0, 1.0, -1.0]
    assert np.linalg.norm(align(mirrored, points) - points, axis=1).mean() > 0.1


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_frames_give_none(n):
    metrics = evaluate_camera(np.arange(n), drive(n), np.arange(10), drive(10))
    assert metrics["frames_matched"] == n
    assert metrics["ate_rmse_m"] is None
    assert metrics["rpe_trans_rmse_m"] is None
    assert metrics["step_length_ratio"] is None


def test_inputs_are_not_changed():
    est, gt, stamps = noisy_steps(drive(20), 1e-3, 0.01), drive(20), np.arange(20) * 0.1
    gt[4] = np.nan
    copies = est.copy(), gt.copy()
    evaluate_camera(stamps, est, stamps, gt)
    np.testing.assert_array_equal(est, copies[0])
    np.testing.assert_array_equal(gt, copies[1])
