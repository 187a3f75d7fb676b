"""The whole system on the same street as KITTI tracking and as a video: the trajectory is right.

Owns no layout's details; those are in `datasets/`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines import open_sequence, run


def poses_of(result) -> np.ndarray:
    Ts = result.Ts_world_camera
    return np.linalg.inv(Ts[0]) @ Ts


@pytest.fixture
def true_Ts(stereo_street) -> np.ndarray:
    Ts = stereo_street.ground_truth().Ts_world_camera[:6]
    return np.linalg.inv(Ts[0]) @ Ts


def test_kitti_tracking(kitti_folder: Path, tmp_path: Path, true_Ts: np.ndarray) -> None:
    root = tmp_path / "tracking"
    for old, new in (("image_2", "image_02"), ("image_3", "image_03")):
        (root / new).mkdir(parents=True)
        (kitti_folder / old).rename(root / new / "0007")
    for name, folder in (("calib.txt", "calib"), ("poses.txt", "poses")):
        (root / folder).mkdir()
        (kitti_folder / name).rename(root / folder / "0007.txt")
    result = run(open_sequence(root, name="0007"), output=tmp_path / "result")
    assert result.metrics["run"]["tracked"] == 6
    assert 1e-5 < result.metrics["camera"]["ate_rmse_m"] < 0.03
    error_m = np.linalg.norm(poses_of(result)[:, :3, 3] - true_Ts[:, :3, 3], axis=1)
    assert error_m.max() < 0.06


def test_video(stereo_street, tmp_path: Path, true_Ts: np.ndarray) -> None:
    camera = stereo_street.camera
    size = (2 * camera.width, camera.height)
    writer = cv2.VideoWriter(
        str(tmp_path / "drive.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size
    )
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 100)
    for k in range(6):
        frame = stereo_street.read(k)
        writer.write(np.concatenate([frame.image, frame.image_right], 1)[..., ::-1].copy())
    writer.release()
    (tmp_path / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\nbf: {camera.bf}\n"
        "stereo: left_right\n"
    )
    result = run(open_sequence(tmp_path / "drive.avi"), output=tmp_path / "result")
    assert result.metrics["run"]["tracked"] == 6
    error_m = np.linalg.norm(poses_of(result)[:, :3, 3] - true_Ts[:, :3, 3], axis=1)
    assert error_m[1:].min() > 1e-5
    assert error_m.max() < 0.1
