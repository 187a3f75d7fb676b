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


def write_virtual_kitti2(root: Path) -> Path:
    """One variation; object 12 of the masks is track 11. The world is the first camera."""
    heads = {
        "intrinsic": "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]",
        "extrinsic": "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1",
        "bbox": "frame cameraID trackID left right top bottom number_pixels truncation_ratio "
        "occupancy_ratio isMoving",
        "pose": "frame cameraID trackID alpha width height length world_space_X world_space_Y "
        "world_space_Z rotation_world_space_y rotation_world_space_x rotation_world_space_z "
        "camera_space_X camera_space_Y camera_space_Z rotation_camera_space_y "
        "rotation_camera_space_x rotation_camera_space_z",
        "info": "trackID label model color",
    }
    rows: dict[str, list[str]] = {name: [head] for name, head in heads.items()}
    rows["info"] += ["0 Van Hatchback Red", "11 Truck Big Blue"]
    frames = root / "frames"
    for k in range(N):
        for camera in (0, 1):
            name = f"Camera_{camera}"
            write_image(frames / f"rgb/{name}/rgb_{k:05d}.jpg", k + 100 * camera)
            write_raw(frames / f"depth/{name}/depth_{k:05d}.png", virtual_depth(k))
            write_palette(
                frames / f"instanceSegmentation/{name}/instancegt_{k:05d}.png", labels_of(k)
            )
            if k < N - 1:
                write_virtual_flow(frames / f"forwardFlow/{name}/flow_{k:05d}.png", flow_of(k))
            x_m, z_m = -camera * BF / FX, -STEP_M * k
            rows["intrinsic"].append(f"{k} {camera} {FX} {FY} {CX} {CY}")
            rows["extrinsic"].append(f"{k} {camera} 1 0 0 {x_m} 0 1 0 0 0 0 1 {z_m} 0 0 0 1")
            ahead_m = 10.0 + OBJECT_STEP_M * k
            for track, x, y, z, ry, box, moves in (
                (0, 1.0, 1.5, ahead_m, -np.pi / 2, f"{20 + k} {31 + k} 10 19", k < N - 1),
                (11, -2.0, 1.5, 9.0, 0.3, "5 8 30 35", False),
            ):
                rows["bbox"].append(f"{k} {camera} {track} {box} 120 0 0.9 {moves}")
                rows["pose"].append(
                    f"{k} {camera} {track} 0 1.7 1.4 4.0 {x} {y} {z} {ry} 0 0 "
                    f"{x + x_m} {y} {z + z_m} {ry} 0 0"
                )
    for name, lines in rows.items():
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return root


def virtual_depth(k: int) -> np.ndarray:
    """Centimetres, the corner of the sky saturated."""
    values = depth_of(k) * 100
    return np.where(values > 0, values, 65535)


def write_palette(path: Path, labels: np.ndarray) -> None:
    """A PNG of palette indices, by another program than the one that will read it."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(labels.astype(np.uint8), mode="P")
    image.putpalette(np.random.default_rng(5).integers(0, 255, 768).astype(np.uint8).tolist())
    image.save(path)


def write_virtual_flow(path: Path, flow: np.ndarray) -> None:
    """16-bit RGB of normalised flow; the first pixel has none."""
    pixels = np.ones((HEIGHT, WIDTH, 3))  # blue, green, red
    for channel, component, size in ((2, 0, WIDTH), (1, 1, HEIGHT)):
        pixels[..., channel] = (flow[..., component] / (size - 1) + 1) / 2 * 65535
    pixels[0, 0] = 0
    write_raw(path, pixels)


def write_omd(root: Path) -> Path:
    """RGB-D images with Vicon at 200 Hz; the rig's x looks right, y ahead, z up."""
    stamp = 1_500_000_000
    listed = ["frame_num,time_sec,time_nsec"]
    for k in range(N):
        write_image(root / f"rgbd/{k:06d}_color.png", k)
        write_raw(root / f"rgbd/{k:06d}_aligned_depth.png", depth_of(k) * 1000)
        listed.append(f"{k},{stamp},{k * 33_000_000}")
    (root / "rgbd/rgbd.csv").write_text("\n".join(listed) + "\n")
    identity = "[[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    camera = "  intrinsics: [{}]\n  resolution: [{}]\n  distortion_coeffs: [0, 0, 0, 0]\n"
    own = camera.format(f"{FX}, {FY}, {CX}, {CY}", f"{WIDTH}, {HEIGHT}")
    stereo = camera.format("900, 900, 640, 480", "1280, 960")
    (root / "manufacturer.yaml").write_text(f"cam0:\n{own}")
    (root / "kalibr.yaml").write_text(
        f"cam0:\n{stereo}cam1:\n{stereo}  T_cn_cnm1: {identity.format(-0.12)}\n"
        f"cam2:\n{own}  T_cn_cnm1: {identity.format(0.05)}\n"
    )
    (root / "vicon.yaml").write_text(
        "T_apparatus_left: [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]]\n"
    )
    rows = ["time_sec,time_nsec,object,qx,qy,qz,qw,tx,ty,tz"]
    for tick in range(-2, 25):
        t_s = tick * 0.005
        at = f"{stamp - 1},{round(1e9 + t_s * 1e9)}" if tick < 0 else f"{stamp},{round(t_s * 1e9)}"
        frame = t_s / 0.033
        rows.append(f"{at},box3,0,0,0,1,0.5,{4 + OBJECT_STEP_M * frame:.9f},0.2")
        rows.append(f"{at},box7,0,0,0.6,0.8,-1,5,0.2")
        rows.append(f"{at},sensor_payload,0,0,0,1,0,{STEP_M * frame:.9f},1")
    (root / "vicon.csv").write_text("\n".join(rows) + "\n")
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
    "virtual_kitti2": write_virtual_kitti2,
    "omd": write_omd,
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
