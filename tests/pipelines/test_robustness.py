"""Inputs and moments that once broke a run: dark frames, damaged truth, late Ctrl-C, old files."""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.simulated.degrade import computed_flow
from pipelines.dyob_slam import DyObSlam
from pipelines.io.config import load_config
from pipelines.io.result import load_result
from pipelines.runner import run
from pipelines.types import TrackingStatus


def test_dark_frames_are_lost_though_flow_was_computed_of_them(street) -> None:
    """What `prepare`, or DIS in the loop, makes of black pictures: flow that means nothing."""

    def picture(k: int) -> np.ndarray:
        image = street.read(k).image
        return np.zeros_like(image) if 8 <= k < 11 else image

    slam, results = DyObSlam(street.camera), []
    for k in range(len(street)):
        frame, flow = street.read(k), None
        if k > 0:
            flow = computed_flow(picture(k - 1), picture(k))
        depth = np.full_like(frame.depth_m, np.nan) if 8 <= k < 11 else frame.depth_m
        worn = dataclasses.replace(
            frame, image=picture(k), flow_prev_to_curr_px=flow, depth_m=depth
        )
        results.append(slam.process(worn))
    assert [r.status for r in results[8:11]] == [TrackingStatus.LOST] * 3
    assert [r.status for r in results[12:]] == [TrackingStatus.OK] * 8


def test_dense_odometry_is_deterministic(real_data) -> None:
    """Open3D sums in parallel; a fresh process that loads it through us gets the same bits."""
    data = real_data("kitti_tracking_0003_vdo_format_10f")
    program = """
import sys, numpy
from pipelines import open_sequence
from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.frontend.view import to_gray
sequence = open_sequence(sys.argv[1])
a, b = ((to_gray(frame.image), frame.depth_m) for frame in map(sequence.read, (0, 1)))
for _ in range(4):
    print(estimate_rgbd_odometry(sequence.camera, a, b, numpy.eye(4), 25.0).tobytes().hex())
"""
    command = [sys.executable, "-c", program, str(data)]
    said = [subprocess.run(command, check=True, capture_output=True).stdout for _ in range(2)]
    lines = {line for output in said for line in output.split()}
    assert len(lines) == 1


@pytest.mark.parametrize("name", ["pose_gt.txt", "object_pose.txt"])
def test_damaged_truth_costs_the_errors_but_not_the_estimate(
    vdo_folder, tmp_path, caplog, name
) -> None:
    (vdo_folder / name).write_text("no numbers\n")
    result = run(open_sequence(vdo_folder), output=tmp_path / "result", frames=4)
    assert "no errors can be computed, the ground truth cannot be read" in caplog.text
    assert name in caplog.text
    assert not {"camera", "objects"} & set(result.metrics)
    assert len(load_result(tmp_path / "result").timestamps_s) == 4


def test_ctrl_c_while_results_are_written_loses_no_trajectory(street, tmp_path, altered) -> None:
    class Impatient(altered):
        def ground_truth(self):
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        run(Impatient(street), output=tmp_path / "result", frames=4)
    assert len(load_result(tmp_path / "result").timestamps_s) == 4


def test_an_older_result_in_the_folder_lends_no_truth(vdo_folder, tmp_path) -> None:
    run(open_sequence(vdo_folder), output=tmp_path / "result")
    for name in ("pose_gt.txt", "object_pose.txt"):
        (vdo_folder / name).unlink()
    again = run(open_sequence(vdo_folder), output=tmp_path / "result", frames=4)
    assert again.gt_timestamps_s is None
    assert "camera" not in again.metrics


def test_the_seed_is_heard(street) -> None:
    ends = []
    for seed in (0, 1, 2):
        slam = DyObSlam(street.camera, load_config(None, [f"tracking.seed={seed}"]))
        for k in range(len(street)):
            end = slam.process(street.read(k)).T_world_camera
        ends.append(end.tobytes())
    assert len(set(ends)) > 1
