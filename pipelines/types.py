"""The nouns that the steps of the system hand to each other: frozen bundles of numpy arrays.

Owns shapes, units and frames of the data; those of moving objects are in `object_types`. Imports
numpy alone, and knows no algorithm.

Conventions: `T_world_camera` is 4x4 float64 with `p_world = T_world_camera @ p_camera`; camera axes
are OpenCV's (x right, y down, z forward); the world is the first camera; pixels are (u, v) with the
centre of the top left pixel at (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import FrameObservations
from pipelines.object_types import ObjectEstimates
from pipelines.shapes import check_shape

Array = NDArray[np.floating[Any]]
Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class StereoCamera:
    """A rectified pinhole pair, or an RGB-D camera with a virtual right one.

    width, height, fx, fy, cx, cy: px. `bf` is baseline times fx in px * m, so that
    disparity [px] = bf / depth [m]. Where depth comes from a depth sensor the right camera is
    virtual: `bf` is then a convention, not a measurement.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    bf: float
    is_rgbd: bool = False

    def __post_init__(self) -> None:
        if min(self.width, self.height, self.fx, self.fy, self.bf) <= 0:
            raise ValueError(f"StereoCamera: expected positive size, focal lengths and bf: {self}")

    @property
    def baseline_m(self) -> float:
        """Distance of the two cameras; by convention where the right one is virtual."""
        return self.bf / self.fx

    @property
    def K(self) -> Array:
        """(3, 3) float64 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class Frame:
    """What the estimator gets of one moment. There is no ground truth in it, by design.

    image: (H, W) grey or (H, W, 3) RGB, uint8.
    image_right: the rectified right image in the same form, or None.
    depth_m: (H, W) float32, registered to `image`, NaN where unknown, or None.
    flow_prev_to_curr_px: (H, W, 2) float32 (du, dv) on the pixel grid of the *previous* frame of
        this sequence, pointing into this one; NaN where unknown, or None.
    instance_labels: (H, W) int32, 0 = background, > 0 = instances of movable classes as they come
        with the sequence; labels need not be the same from frame to frame. None if there are none.
    instance_classes: class name of some or all labels, None where the sequence does not say.
    """

    index: int
    timestamp_s: float
    image: Image
    image_right: Image | None = None
    depth_m: NDArray[np.float32] | None = None
    flow_prev_to_curr_px: NDArray[np.float32] | None = None
    instance_labels: NDArray[np.int32] | None = None
    instance_classes: dict[int, str] | None = None

    def __post_init__(self) -> None:
        if self.image.ndim not in (2, 3) or self.image.dtype != np.uint8:
            raise ValueError(
                "Frame.image: expected (H, W) or (H, W, 3) uint8, "
                f"found {self.image.shape} {self.image.dtype}"
            )
        H, W = self.image.shape[:2]
        if self.image_right is not None:
            check_shape("Frame", "image_right", self.image_right, self.image.shape)
        if self.depth_m is not None:
            check_shape("Frame", "depth_m", self.depth_m, (H, W))
        if self.flow_prev_to_curr_px is not None:
            check_shape("Frame", "flow_prev_to_curr_px", self.flow_prev_to_curr_px, (H, W, 2))
        if self.instance_labels is not None:
            check_shape("Frame", "instance_labels", self.instance_labels, (H, W))


@dataclass(frozen=True, slots=True)
class ObjectTruth:
    """True object states, one row per object and frame (parallel arrays of length M).

    frame_index, object_id: (M,) int64. class_name: (M,) str. Ts_world_object: (M, 4, 4).
    boxes_px: (M, 4) float64 x1 y1 x2 y2 of the visible part, NaN where out of sight.
    moving: (M,) bool, whether the object ever moves in the sequence. n_pixels: (M,) int64, how many
    pixels of it are seen, or None where the truth has no masks.
    """

    frame_index: NDArray[np.int64]
    object_id: NDArray[np.int64]
    class_name: NDArray[np.str_]
    Ts_world_object: Array
    boxes_px: Array
    moving: NDArray[np.bool_]
    n_pixels: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        M = len(self.frame_index)
        if self.n_pixels is not None:
            check_shape("ObjectTruth", "n_pixels", self.n_pixels, (M,))
        for name in ("frame_index", "object_id", "class_name", "moving"):
            check_shape("ObjectTruth", name, getattr(self, name), (M,))
        check_shape("ObjectTruth", "Ts_world_object", self.Ts_world_object, (M, 4, 4))
        check_shape("ObjectTruth", "boxes_px", self.boxes_px, (M, 4))

    def __len__(self) -> int:
        return len(self.frame_index)

    @classmethod
    def empty(cls) -> ObjectTruth:
        """No object at all."""
        whole = np.empty(0, np.int64)
        boxes, moving = np.empty((0, 4)), np.empty(0, bool)
        return cls(whole, whole, np.empty(0, "U16"), np.empty((0, 4, 4)), boxes, moving)

    def __getitem__(self, which: NDArray) -> ObjectTruth:
        """The rows chosen by a boolean mask or an index array."""
        names = [f.name for f in fields(self) if getattr(self, f.name) is not None]
        return ObjectTruth(**{name: getattr(self, name)[which] for name in names})


@dataclass(frozen=True, slots=True)
class KnownNoise:
    """Standard deviations in px of white Gaussian noise, per pixel and axis, in given inputs.

    flow_px: of dense flow. disparity_px: of disparity, or of depth seen as disparity.
    """

    flow_px: float
    disparity_px: float


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What the evaluator alone may see.

    timestamps_s: (N,) of the frames. Ts_world_camera: (N, 4, 4), NaN where unknown, in any world
    frame (the evaluator aligns). objects: true object states, or None. noise: of the inputs, where
    they are exact but for it.
    """

    timestamps_s: Array
    Ts_world_camera: Array
    objects: ObjectTruth | None = None
    noise: KnownNoise | None = None

    def __post_init__(self) -> None:
        N = len(self.timestamps_s)
        check_shape("GroundTruth", "timestamps_s", self.timestamps_s, (N,))
        check_shape("GroundTruth", "Ts_world_camera", self.Ts_world_camera, (N, 4, 4))


class TrackingStatus(StrEnum):
    """Whether the pose of a frame was measured (OK) or only predicted (LOST).

    The pose that a map starts from counts as OK: the world's origin, or where tracking starts anew.
    """

    OK = "OK"
    LOST = "LOST"


class MotionHypothesis(StrEnum):
    """Where the initial camera pose of a frame came from; see `frontend/hypotheses.py`."""

    FIRST_FRAME = "first_frame"  # or the first one of a new start
    CONSTANT_VELOCITY = "constant_velocity"
    PNP_RANSAC = "pnp_ransac"
    RGBD_ODOMETRY = "rgbd_odometry"
    RELOCALISATION = "relocalisation"
    NONE = "none"  # the frame is LOST


@dataclass(frozen=True, slots=True)
class Features:
    """ORB features of one image (parallel arrays of length N).

    uv_px: (N, 2) float64, at full size. octave: (N,) int32, pyramid level, 0 the finest.
    angle_deg: (N,) float32. response: (N,) float32, strength of the corner. descriptors: (N, 32)
    uint8. depth_m: (N,) float64, NaN where unknown.
    """

    uv_px: Array
    octave: NDArray[np.int32]
    angle_deg: NDArray[np.float32]
    response: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    depth_m: Array

    def __post_init__(self) -> None:
        N = len(self.uv_px)
        check_shape("Features", "uv_px", self.uv_px, (N, 2))
        for name in ("octave", "angle_deg", "response", "depth_m"):
            check_shape("Features", name, getattr(self, name), (N,))
        check_shape("Features", "descriptors", self.descriptors, (N, 32))

    def __len__(self) -> int:
        return len(self.uv_px)

    def __getitem__(self, which: NDArray) -> Features:
        """The features chosen by a boolean mask or an index array."""
        return Features(*(getattr(self, f.name)[which] for f in fields(self)))

    def with_depth(self, depth_m: Array) -> Features:
        """The same features with depths (N,) in metres."""
        return replace(self, depth_m=depth_m)

    @classmethod
    def empty(cls) -> Features:
        """No features at all."""
        return cls(
            np.empty((0, 2)),
            np.empty(0, np.int32),
            np.empty(0, np.float32),
            np.empty(0, np.float32),
            np.empty((0, 32), np.uint8),
            np.empty(0),
        )


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What the estimator says of one frame.

    T_world_camera: (4, 4); measured when status is OK, predicted when LOST.
    pose_covariance: (6, 6) of the right perturbation [omega (rad), v (m)], NaN when LOST, zero
        where a map starts.
    is_keyframe: whether the map keeps this frame as one.
    keypoints_px: (N, 2) places where points of the map were found. point_ids: (N,) int64, these
        points; -1 would stand for a keypoint of none. inliers: (N,) bool, whether the observation
        agreed with the pose.
    n_inliers: how many; counted where it is not given.
    reprojection_rmse_px: of the inliers' pixels (u_L, v), NaN where there are none.
    objects: rows of all objects that are being tracked. object_labels: (H, W) int32, pixels of each
        by its lasting id, 0 elsewhere; None where there are no objects.
    observations: what the batch will want to know of this frame.
    timings_ms: time of each stage of this frame; "total", their sum; in a run also "wall", the time
        since the result before this one, which is less as frames are prepared ahead.
    """

    frame_index: int
    timestamp_s: float
    status: TrackingStatus
    T_world_camera: Array
    pose_covariance: Array
    hypothesis: MotionHypothesis
    is_keyframe: bool
    keypoints_px: Array
    point_ids: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    reprojection_rmse_px: float
    objects: ObjectEstimates = field(default_factory=ObjectEstimates.empty)
    object_labels: NDArray[np.int32] | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)
    observations: FrameObservations | None = None
    n_inliers: int = -1

    def __post_init__(self) -> None:
        N = len(self.keypoints_px)
        if self.n_inliers < 0:
            object.__setattr__(self, "n_inliers", int(self.inliers.sum()))
        check_shape("FrameResult", "T_world_camera", self.T_world_camera, (4, 4))
        check_shape("FrameResult", "pose_covariance", self.pose_covariance, (6, 6))
        check_shape("FrameResult", "keypoints_px", self.keypoints_px, (N, 2))
        check_shape("FrameResult", "point_ids", self.point_ids, (N,))
        check_shape("FrameResult", "inliers", self.inliers, (N,))

    def summary(self) -> FrameResult:
        """What a run keeps of each frame: all but points, pixels and observations."""
        return replace(
            self,
            keypoints_px=np.empty((0, 2)),
            point_ids=np.empty(0, np.int64),
            inliers=np.zeros(0, bool),
            object_labels=None,
            observations=None,
        )


@dataclass(frozen=True, slots=True)
class StaticMap:
    """The sparse static map as the outside sees it (parallel arrays of length N).

    points_m: (N, 3) in the world. colors: (N, 3) uint8 RGB. n_observations: (N,) int32, frames
    that found the point. keyframe_Ts_world_camera: (K, 4, 4). keyframe_indices: (K,) int64 frame
    indices. track_ids: (N,) int64, the points' lasting numbers in the observation log, or None.
    """

    points_m: Array
    colors: NDArray[np.uint8]
    n_observations: NDArray[np.int32]
    keyframe_Ts_world_camera: Array
    keyframe_indices: NDArray[np.int64]
    track_ids: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        N, K = len(self.points_m), len(self.keyframe_indices)
        if self.track_ids is not None:
            check_shape("StaticMap", "track_ids", self.track_ids, (N,))
        check_shape("StaticMap", "points_m", self.points_m, (N, 3))
        check_shape("StaticMap", "colors", self.colors, (N, 3))
        check_shape("StaticMap", "n_observations", self.n_observations, (N,))
        check_shape(
            "StaticMap", "keyframe_Ts_world_camera", self.keyframe_Ts_world_camera, (K, 4, 4)
        )

    def __len__(self) -> int:
        return len(self.points_m)
