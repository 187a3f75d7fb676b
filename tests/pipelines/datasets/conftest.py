"""Tiny sequences in each layout, written by the tests: 4 frames of 64 x 48, with truth.

Owns the truth that these folders are made of, so that tests can compare.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

N, WIDTH, HEIGHT = 4, 64, 48
FX, FY, CX, CY, BF = 50.0, 51.0, 31.0, 23.0, 25.0
STEP_M = 0.5  # the camera moves so far forward a frame
OBJECT_STEP_M = 0.8


def depth_of(k: int) -> np.ndarray:
    """(H, W) metres: a slanted plane, unknown in its corner."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = 4.0 + 0.02 * u + 0.01 * v + 0.1 * k
    depth[:4, :4] = 0.0
    return depth


def write_image(path: Path, k: int, color: bool = True) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = (HEIGHT, WIDTH, 3) if color else (HEIGHT, WIDTH)
    pixels = np.random.default_rng(k).integers(0, 255, shape, dtype=np.uint8)
    if color:
        pixels[0, 0] = (10, 20, 200)  # BGR on disk: red above all
    assert cv2.imwrite(str(path), pixels)


def write_raw(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.clip(np.round(values), 0, 65535).astype(np.uint16))


def disparity_values(k: int, factor: float) -> np.ndarray:
    depth = depth_of(k)
    return np.where(depth > 0, BF / np.maximum(depth, 1e-6) * factor, 0)


def flow_of(k: int) -> np.ndarray:
    """Flow from frame k to k + 1."""
    flow = np.full((HEIGHT, WIDTH, 2), 0.25, np.float32)
    flow[..., 0] = k + 1
    return flow


def labels_of(k: int) -> np.ndarray:
    labels = np.zeros((HEIGHT, WIDTH), np.int32)
    labels[10:20, 20 + k : 32 + k] = 1
    labels[30:36, 5:9] = 12
    return labels


def write_vdo(root: Path) -> Path:
    """VDO-SLAM's layout of KITTI; object 1 drives ahead, object 12 stands."""
    poses, objects = [], []
    for k in range(N):
        write_image(root / f"image_0/{k:06d}.png", k)
        write_raw(root / f"depth/{k:06d}.png", disparity_values(k, 256.0))
        (root / "flow").mkdir(exist_ok=True)
        cv2.writeOpticalFlow(str(root / f"flow/{k:06d}.flo"), flow_of(k))
        (root / "semantic").mkdir(exist_ok=True)
        np.savetxt(root / f"semantic/{k:06d}.txt", labels_of(k), fmt="%d")
        T = np.eye(4)
        T[2, 3] = STEP_M * k
        poses.append([k, *T.ravel()])
        ahead_m = 10.0 + (OBJECT_STEP_M - STEP_M) * k
        objects.append([k, 1, 20 + k, 10, 31 + k, 19, 1.0, 1.5, ahead_m, -np.pi / 2])
        objects.append([k, 12, 5, 30, 8, 35, -2.0, 1.5, 9.0 - STEP_M * k, 0.3])
    np.savetxt(root / "pose_gt.txt", poses, fmt=["%d"] + ["%.9f"] * 16)
    np.savetxt(root / "object_pose.txt", objects, fmt=["%d", "%d"] + ["%.9f"] * 8)
    np.savetxt(root / "times.txt", np.arange(N) / 10, fmt="%.6f")
    write_vdo_settings(root / "settings.yaml")
    return root


def write_vdo_settings(path: Path, data: int = 2, factor: float = 256.0) -> None:
    path.write_text(
        f"%YAML:1.0\n# camera\nCamera.fx: {FX}\nCamera.fy: {FY}\nCamera.cx: {CX}\n"
        f"Camera.cy: {CY} # principal point\nCamera.width: {WIDTH}\nCamera.height: {HEIGHT}\n"
        f"Camera.fps: 10.0\nCamera.bf: {BF}\nChooseData: {data}\nDepthMapFactor: {factor}\n"
    )


def write_kitti_odometry(root: Path) -> Path:
    for k in range(N):
        write_image(root / f"image_0/{k:06d}.png", k, color=False)
        write_image(root / f"image_1/{k:06d}.png", 100 + k, color=False)
    row = f"{FX} 0 {CX} {{}} 0 {FY} {CY} 0 0 0 1 0"
    shifts = (0.0, -BF, 3.0, 3.0 - BF)
    lines = [f"P{i}: {row.format(x)}" for i, x in enumerate(shifts)]
    (root / "calib.txt").write_text("\n".join([*lines, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n")
    np.savetxt(root / "times.txt", 0.104 * np.arange(N))
    poses = np.tile(np.eye(4)[:3].ravel(), (N, 1))
    poses[:, 11] = STEP_M * np.arange(N)
    np.savetxt(root / "poses.txt", poses)
    return root


def write_kitti_tracking(root: Path) -> Path:
    """One sequence, 0003, whose frames drive east by oxts; the car gains on the camera."""
    for k in range(N):
        write_image(root / f"image_02/0003/{k:06d}.png", k)
        write_image(root / f"image_03/0003/{k:06d}.png", 100 + k)
    row = f"{FX} 0 {CX} {{}} 0 {FY} {CY} 0 0 0 1 0"
    shifts = (0.0, -BF, 3.0, 3.0 - BF)
    lines = [f"P{i}: {row.format(x)}" for i, x in enumerate(shifts)]
    # x of the inertial unit and the laser scanner is ahead, y to the left, z up.
    lines += ["R_rect 1 0 0 0 1 0 0 0 1", "Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0"]
    lines += ["Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8"]
    for folder in ("calib", "label_02", "oxts"):
        (root / folder).mkdir()
    (root / "calib/0003.txt").write_text("\n".join(lines) + "\n")
    labels, oxts = [], np.zeros((N, 30))
    size = "1.4 1.7 4.0"  # height, width, length
    for k in range(N):
        labels.append(f"{k} -1 DontCare -1 -1 -10 1 1 4 4 -1 -1 -1 -1000 -1000 -1000 -10")
        ahead_m = 10.0 + (OBJECT_STEP_M - STEP_M) * k
        box = f"{20 + k} 10 {31 + k} 19"
        labels.append(f"{k} 1 Car 0 0 0 {box} {size} 1.0 1.5 {ahead_m:.6f} {-np.pi / 2:.12f}")
        still_m = 9.0 - STEP_M * k
        labels.append(f"{k} 12 Pedestrian 0 0 0 5 30 8 35 1.8 0.5 0.5 -2 1.5 {still_m:.6f} 0.3")
    metres_a_degree = np.radians(1.0) * 6378137.0 * np.cos(np.radians(49.0))
    oxts[:, 0], oxts[:, 1] = 49.0, 8.4 + STEP_M * np.arange(N) / metres_a_degree
    (root / "label_02/0003.txt").write_text("\n".join(labels) + "\n")
    np.savetxt(root / "oxts/0003.txt", oxts, fmt="%.14f")
    return root


def write_tum_rgbd(root: Path) -> Path:
    """Lists in TUM's form; one colour image has no depth within 0.02 s and drops out."""
    colours, depths, poses = [], [], []
    for k in range(N + 1):
        t = 100.0 + k / 30
        write_image(root / f"rgb/{t:.6f}.png", k)
        colours.append(f"{t:.6f} rgb/{t:.6f}.png")
        if k < N:
            write_raw(root / f"depth/{t + 0.005:.6f}.png", depth_of(k) * 5000)
            depths.append(f"{t + 0.005:.6f} depth/{t + 0.005:.6f}.png")
        poses.append(f"{t - 0.003:.6f} 0 0 {STEP_M * k} 0 0 0 1")
    (root / "rgb.txt").write_text("# colour\n" + "\n".join(colours) + "\n")
    (root / "depth.txt").write_text("# depth\n" + "\n".join(depths) + "\n")
    (root / "groundtruth.txt").write_text("# truth\n" + "\n".join(poses) + "\n")
    write_camera_yaml(root / "camera.yaml", depth_scale=None, fps=None)
    return root


def write_camera_yaml(path: Path, **changes: float | str | None) -> None:
    keys: dict[str, float | str | None] = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "bf": BF}
    keys |= {"fps": 20, "depth_scale": 1000} | changes
    path.write_text("".join(f"{k}: {v}\n" for k, v in keys.items() if v is not None))


def write_folder(root: Path) -> Path:
    poses = []
    for k in range(N):
        write_image(root / f"images/{k}.png", k)
        write_raw(root / f"depth/{k}.png", depth_of(k) * 1000)
        (root / "flow").mkdir(exist_ok=True)
        np.save(root / f"flow/{k}.npy", flow_of(k))
        (root / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(root / f"masks/{k}.png"), labels_of(k).astype(np.uint8))
        poses.append(f"{k / 20:.6f} 0 0 {STEP_M * k} 0 0 0 1")
    (root / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    write_camera_yaml(root / "camera.yaml")
    return root


WRITERS = {
    "vdo": write_vdo,
    "kitti_odometry": write_kitti_odometry,
    "kitti_tracking": write_kitti_tracking,
    "tum_rgbd": write_tum_rgbd,
    "folder": write_folder,
}


@pytest.fixture
def write_tree(tmp_path: Path) -> Callable[[str], Path]:
    """A function data set name -> new folder with a tiny sequence in its layout."""

    def write(dataset: str) -> Path:
        root = tmp_path / f"{dataset}_tree"
        root.mkdir()
        return WRITERS[dataset](root)

    return write
