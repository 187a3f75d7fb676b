"""What the front-end sees of one frame: grey image, disparity, static pixels and features.

Owns the turning of a `Frame` into a `View`: a part that may run ahead in another thread, and a part
that needs what was learned of the sensor. Knows no poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.depth import to_gray
from pipelines.errors import FrameError
from pipelines.frontend.disparity_offset import corrected
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.sampling import sample_disparity
from pipelines.object_types import Detections
from pipelines.types import Array, Features, Frame, Image, StereoCamera

_CONTRAST_WINDOW_PX = 31  # neighbourhood that the corner detector's contrast is measured against
_CONTRAST_GAIN = np.float32(40.0)  # grey levels of standard deviation afterwards
_CONTRAST_FLOOR = 10.0  # grey levels of standard deviation below which contrast is noise


@dataclass(frozen=True, slots=True)
class View:
    """One frame, ready for tracking.

    image: as in `Frame`. gray: (H, W) uint8. disparity_px: (H, W) float32, corrected by the learned
    offset, NaN where unknown. static: (H, W) bool, False on movable objects and around them.
    features: ORB on static pixels, with depth in m. flow_prev_to_curr_px: (H, W, 2) on the previous
    frame's pixels, or None; flow_is_given: whether it came with the sequence.
    """

    frame_index: int
    timestamp_s: float
    image: Image
    gray: Image
    disparity_px: NDArray[np.float32]
    static: NDArray[np.bool_]
    features: Features
    flow_prev_to_curr_px: NDArray[np.float32] | None
    flow_is_given: bool = False

    def masked(self, labels: NDArray[np.int32], dilation_px: int) -> View:
        """The view without what lies on objects: labels (H, W), 0 where nothing moves.

        Masks grow by `dilation_px`; features on them are left out.
        """
        static = static_pixels(labels, self.gray.shape, dilation_px)
        column, row = np.rint(self.features.uv_px).astype(np.int64).T
        return replace(self, static=static, features=self.features[static[row, column]])

    def is_static(self, uv_px: Array) -> NDArray[np.bool_]:
        """Whether pixels (N, 2) lie in the image and off movable objects."""
        H, W = self.static.shape
        x = np.rint(np.nan_to_num(uv_px[:, 0], nan=-9.0)).astype(np.int64)
        y = np.rint(np.nan_to_num(uv_px[:, 1], nan=-9.0)).astype(np.int64)
        inside = (x >= 0) & (y >= 0) & (x < W) & (y < H)
        return inside & self.static[np.clip(y, 0, H - 1), np.clip(x, 0, W - 1)]

    def depth_of_static_m(self, camera: StereoCamera) -> NDArray[np.float32]:
        """(H, W) float32 depth, NaN where unknown or on movable objects."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.float32(camera.bf) / self.disparity_px
        return np.where(self.static & (self.disparity_px > 0), depth, np.float32(np.nan))


def static_pixels(
    instance_labels: NDArray[np.int32] | None, shape: tuple[int, int], dilation_px: int
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels off all movable instances, which grow by `dilation_px` on each side.

    Masks are worn at their edges, and an ORB patch there would see the object.
    """
    if instance_labels is None:
        return np.ones(shape, bool)
    movable = (instance_labels > 0).astype(np.uint8)
    size = 2 * dilation_px + 1
    return cv2.dilate(movable, np.ones((size, size), np.uint8)) == 0


def normalise_contrast(gray: Image) -> Image:
    """(H, W) uint8 with even local contrast, so that corners in shade or on asphalt count too.

    Only for detection: the gain changes across a patch, and with it what is brighter than what.
    Deviation: the paper detects ORB on the plain image, which leaves the ground nearly bare.
    """
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # smooth anyway
    size = (_CONTRAST_WINDOW_PX // 2, _CONTRAST_WINDOW_PX // 2)
    mean = cv2.boxFilter(half, cv2.CV_32F, size)
    variance = cv2.sqrBoxFilter(half, cv2.CV_32F, size) - mean * mean
    gain = _CONTRAST_GAIN / (np.sqrt(np.maximum(variance, 0.0)) + np.float32(_CONTRAST_FLOOR))
    shift = 128.0 - mean * gain
    gain, shift = (
        cv2.resize(field, gray.shape[::-1], interpolation=cv2.INTER_LINEAR)
        for field in (gain, shift)
    )
    return cv2.add(cv2.multiply(gray, gain, dtype=cv2.CV_32F), shift, dtype=cv2.CV_8U)


@dataclass(frozen=True, slots=True)
class PreparedFrame:
    """What can be said of a frame before anything is known of its pose, or of the sensor's errors.

    gray: (H, W) uint8. disparity_px: (H, W) float32 as measured, NaN where unknown. features: ORB,
    without depth. detections: masks of movable things, None where there is no answer for this
    frame. flow_prev_to_curr_px: (H, W, 2) from the frame prepared before, or None; flow_is_given:
    whether it came with the sequence. timings_ms: wall time of each stage so far. perception: what
    detector and flow remember after this frame, for whoever wants to go on from here.
    """

    frame: Frame
    gray: Image
    disparity_px: NDArray[np.float32]
    features: Features
    detections: Detections | None = None
    flow_prev_to_curr_px: NDArray[np.float32] | None = None
    flow_is_given: bool = False
    timings_ms: dict[str, float] = field(default_factory=dict)
    perception: tuple[Any, ...] = ()


def check_size(camera: StereoCamera, frame: Frame) -> None:
    """Raise FrameError unless a frame's image has its camera's size."""
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"expected an image of {camera.width} x {camera.height}, found {width} x {height}; "
            "all images of a sequence must have the calibrated size"
        )


def prepare_frame(
    camera: StereoCamera,
    frame: Frame,
    depth_m: NDArray[np.float32] | None,
    orb: OrbExtractor,
    detections: Detections | None = None,
    movable_below: float = 0.0,
) -> PreparedFrame:
    """Grey image, disparities and features of a frame with depth (H, W) in m.

    movable_below: static share of the image below which movable things get features as well, as
    what stands still may then have to serve as a landmark.
    """
    gray = to_gray(frame.image)
    if depth_m is None:
        disparity = np.full(gray.shape, np.nan, np.float32)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            disparity = np.where(depth_m > 0, np.float32(camera.bf) / depth_m, np.float32(np.nan))
        disparity = disparity.astype(np.float32, copy=False)
    labels = None if detections is None else detections.labels
    static = static_pixels(labels, gray.shape, orb.config.mask_dilation_px)
    movable_too = float(static.mean()) < movable_below
    features = orb.extract(gray, static, movable_too, detect_on=normalise_contrast(gray))
    return PreparedFrame(frame, gray, disparity, features, detections)


def complete_view(
    camera: StereoCamera,
    prepared: PreparedFrame,
    sigma_disparity_px: float,
    disparity_offset_px: float,
) -> View:
    """The view of a prepared frame, by what is known of the sensor's disparities now.

    sigma_disparity_px: their noise. disparity_offset_px: true minus measured. Everything counts as
    static so far; see `View.masked`.
    Deviation: the paper matches ORB features of both images for their depth; here it is read off
    the dense disparities, which serves stereo and RGB-D alike.
    """
    disparity, features = prepared.disparity_px, prepared.features
    if disparity_offset_px != 0.0:
        disparity = corrected(camera, disparity, disparity_offset_px)
    disparity_at = sample_disparity(disparity, features.uv_px, sigma_disparity_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        features = features.with_depth(np.where(disparity_at > 0, camera.bf / disparity_at, np.nan))
    frame = prepared.frame
    return View(
        frame.index,
        frame.timestamp_s,
        frame.image,
        prepared.gray,
        disparity,
        np.ones(prepared.gray.shape, bool),
        features,
        prepared.flow_prev_to_curr_px,
        prepared.flow_is_given,
    )
