"""Sequences of the system tests: a small rendered street, and the same one as folders on disk.

Owns the folders' writing, and sequences that alter frames on their way. Rendered once a session.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.geometry import q_xyzw_from_T
from pipelines.types import Frame, GroundTruth

N_FRAMES = 20
SCALE = 0.4  # 497 x 150 pixels


class Altered(Sequence):
    """A sequence whose frames pass through `alter`; it notes which were read, and truth's use."""

    def __init__(self, inner: Sequence, alter: Callable[[Frame], Frame] = lambda frame: frame):
        self.inner, self.alter = inner, alter
        self.name, self.dataset, self.root = inner.name, inner.dataset, inner.root
        self.camera, self.timestamps_s = inner.camera, inner.timestamps_s
        self.events: list[int | str] = []

    def read(self, index: int) -> Frame:
        self.events.append(index)
        return self.alter(self.inner.read(index))

    def ground_truth(self) -> GroundTruth | None:
        self.events.append("truth")
        return self.inner.ground_truth()


@pytest.fixture(scope="session")
def altered() -> type[Altered]:
    """The class itself: test modules cannot import from a conftest."""
    return Altered


@pytest.fixture(scope="session")
def render_cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("rendered")


@pytest.fixture(scope="session")
def street(render_cache) -> Sequence:
    """20 frames of a street with traffic: exact depth, flow and masks."""
    return open_sequence("simulated:street", frames=N_FRAMES, scale=SCALE, cache=render_cache)


@pytest.fixture(scope="session")
def short_street(street) -> Altered:
    """Its first ten frames, where many runs are made."""
    short = Altered(street)
    short.timestamps_s = short.timestamps_s[:10]
    return short


@pytest.fixture(scope="session")
def other_place(render_cache) -> Sequence:
    """Six frames of another street, which shares no landmark with the first."""
    options = {"frames": 6, "scale": SCALE, "seed": 3, "cache": render_cache}
    return open_sequence("simulated:street", **options)


@pytest.fixture(scope="session")
def stereo_street(render_cache) -> Sequence:
    """Six pairs of a street without traffic."""
    options = {"frames": 6, "scale": SCALE, "provide": "right", "cache": render_cache}
    return open_sequence("simulated:static", **options)


@pytest.fixture(scope="session")
def board_frames(street) -> Callable[..., list[Frame]]:
    """A standing camera before the street, with a painted board that slides; see `paste_board`."""

    def make(n_frames: int, **board) -> list[Frame]:
        return paste_board(street.read(0), n_frames, **board)

    return make


def paste_board(
    still: Frame,
    n_frames: int,
    *,
    size: tuple[int, int] = (60, 90),
    at: tuple[int, int] = (60, 150),
    depth_m: float = 8.0,
    step_px: Callable[[int], int] = lambda k: 0,
) -> list[Frame]:
    """Frames, 0.1 s apart, of one picture with a board of (height, width) before it.

    at: row and column of its corner in the first frame. step_px: columns that it moves by until
    frame k. Depth, flow and mask (label 5, a car; all else is background) are exact.
    """
    rng, frames = np.random.default_rng(1), []
    noise = rng.normal(size=(*size, 3)).astype(np.float32)
    paint = cv2.GaussianBlur(noise, (0, 0), 1.2) + 2 * cv2.GaussianBlur(noise, (0, 0), 4)
    paint = np.clip(120 + 40 * paint / paint.std(), 0, 255).astype(np.uint8)
    rows, column = slice(at[0], at[0] + size[0]), at[1]
    for k in range(n_frames):
        step = step_px(k) if k > 0 else 0
        flow = np.zeros((*still.image.shape[:2], 2), np.float32)
        flow[rows, column : column + size[1], 0] = step
        column += step
        columns = slice(column, column + size[1])
        image, depth = still.image.copy(), still.depth_m.copy()
        labels = np.zeros(depth.shape, np.int32)
        image[rows, columns], depth[rows, columns], labels[rows, columns] = paint, depth_m, 5
        frames.append(
            Frame(k, 0.1 * k, image, None, depth, flow if k > 0 else None, labels, {5: "car"})
        )
    return frames


@pytest.fixture
def vdo_folder(street: Sequence, tmp_path: Path) -> Path:
    """The street's first ten frames in VDO-SLAM's layout, free to be damaged."""
    return write_vdo(street, tmp_path / "vdo_street", 10)


@pytest.fixture
def kitti_folder(stereo_street: Sequence, tmp_path: Path) -> Path:
    return write_kitti_odometry(stereo_street, tmp_path / "kitti_street", 6)


@pytest.fixture
def tum_folder(street: Sequence, tmp_path: Path) -> Path:
    return write_tum_rgbd(street, tmp_path / "tum_street", 6)


def write_vdo(sequence: Sequence, root: Path, n_frames: int) -> Path:
    """All of VDO-SLAM's inputs and truth; disparity * 256 as KITTI's."""
    camera = sequence.camera
    for name in ("image_0", "depth", "flow", "semantic"):
        (root / name).mkdir(parents=True)
    for k in range(n_frames):
        frame = sequence.read(k)
        _write_png(root / f"image_0/{k:06d}.png", frame.image[..., ::-1])
        _write_png(root / f"depth/{k:06d}.png", _to_16_bits(camera.bf / frame.depth_m * 256.0))
        _write_png(root / f"semantic/{k:06d}.png", frame.instance_labels.astype(np.uint8))
        if k > 0:
            flow = frame.flow_prev_to_curr_px
            cv2.writeOpticalFlow(str(root / f"flow/{k - 1:06d}.flo"), np.nan_to_num(flow, nan=2e9))
    truth = sequence.ground_truth()
    Ts = truth.Ts_world_camera[:n_frames].reshape(n_frames, 16)
    np.savetxt(root / "pose_gt.txt", np.column_stack([np.arange(n_frames), Ts]), fmt="%.9f")
    _write_object_truth(root / "object_pose.txt", truth, n_frames)
    np.savetxt(root / "times.txt", sequence.timestamps_s[:n_frames], fmt="%.6f")
    (root / "settings.yaml").write_text(
        f"%YAML:1.0\nCamera.fx: {camera.fx}\nCamera.fy: {camera.fy}\nCamera.cx: {camera.cx}\n"
        f"Camera.cy: {camera.cy}\nCamera.width: {camera.width}\nCamera.height: {camera.height}\n"
        f"Camera.fps: 10.0\nCamera.bf: {camera.bf}\nChooseData: 2\nDepthMapFactor: 256\n"
    )
    return root


def write_tum_rgbd(sequence: Sequence, root: Path, n_frames: int) -> Path:
    """Colour and depth at 1 / 500 m, so that 16 bits reach over 100 m."""
    camera, Ts = sequence.camera, sequence.ground_truth().Ts_world_camera
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    pairs, poses = [], []
    for k in range(n_frames):
        frame, t = sequence.read(k), sequence.timestamps_s[k]
        _write_png(root / f"rgb/{k}.png", frame.image[..., ::-1])
        _write_png(root / f"depth/{k}.png", _to_16_bits(frame.depth_m * 500.0))
        pairs.append(f"{t:.6f} rgb/{k}.png {t:.6f} depth/{k}.png\n")
        numbers = [t, *Ts[k, :3, 3], *q_xyzw_from_T(Ts[k])]
        poses.append(" ".join(f"{value:.9f}" for value in numbers) + "\n")
    (root / "associations.txt").write_text("".join(pairs))
    (root / "groundtruth.txt").write_text("".join(poses))
    (root / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\n"
        f"bf: {camera.bf}\ndepth_scale: 500\n"
    )
    return root


def write_kitti_odometry(sequence: Sequence, root: Path, n_frames: int) -> Path:
    """Colour pairs, image_2 and image_3, whose left camera is camera 0."""
    camera, Ts = sequence.camera, sequence.ground_truth().Ts_world_camera
    for k in range(n_frames):
        frame = sequence.read(k)
        for name, image in (("image_2", frame.image), ("image_3", frame.image_right)):
            (root / name).mkdir(parents=True, exist_ok=True)
            _write_png(root / f"{name}/{k:06d}.png", image[..., ::-1])
    shift = {"P0": 0.0, "P1": -camera.bf, "P2": 0.0, "P3": -camera.bf}
    (root / "calib.txt").write_text(
        "".join(
            f"{name}: {camera.fx} 0 {camera.cx} {x} 0 {camera.fy} {camera.cy} 0 0 0 1 0\n"
            for name, x in shift.items()
        )
    )
    np.savetxt(root / "times.txt", sequence.timestamps_s[:n_frames], fmt="%.6f")
    np.savetxt(root / "poses.txt", Ts[:n_frames, :3].reshape(n_frames, 12), fmt="%.9f")
    return root


def _write_object_truth(path: Path, truth: GroundTruth, n_frames: int) -> None:
    """Rows `frame id x y z rx ry rz 0 0` in the world, with no rotation: only its being counts."""
    objects = truth.objects
    rows = objects.frame_index < n_frames
    T = objects.Ts_world_object[rows]
    zeros = np.zeros((rows.sum(), 5))
    numbers = [objects.frame_index[rows], objects.object_id[rows], T[:, :3, 3], zeros]
    np.savetxt(path, np.column_stack(numbers), fmt="%.6f")


def _to_16_bits(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values) & (values > 0) & (values < 65535)
    return np.where(known, np.round(np.nan_to_num(values)), 0).astype(np.uint16)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels))
