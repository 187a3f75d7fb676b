"""A picture of each step that a frame goes through: depth, masks, flow, features, motion.

Owns how the intermediate nouns of `DyObSlam` look. Every function returns a new image (h, w, 3)
uint8 RGB, enlarged where the frame is small, so that marks and words stay sharp.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.view import PreparedFrame
from pipelines.geometry import backproject, invert_T, project_stereo, transform_points
from pipelines.object_types import Detections, ObjectEstimates, ObjectState
from pipelines.types import Array, Features, FrameResult, Image, StereoCamera
from viz import style
from viz.object_marks import draw_mask
from viz.overlay import stamp_marks

LEAST_WIDTH_PX = 1200  # smaller frames are enlarged by a whole number to about this
SCALE_PX = 30  # height of the strip that explains colours
TEXT_PX = 16
VOID: style.Color = (40, 42, 48)  # where nothing is known
STILL: style.Color = (120, 200, 235)
MOVES: style.Color = (235, 90, 50)
_TICKS_M = (0.5, 1, 2, 3, 5, 8, 12, 20, 30, 50, 80)


def depth_picture(depth_m: Array) -> Image:
    """Depth (H, W) in metres: near is warm, far is cold, unknown (NaN or <= 0) is dark.

    A strip below says which colour is how far.
    """
    import cv2

    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        return _enlarge(np.full((*depth_m.shape, 3), VOID, np.uint8))
    low, high = np.log(np.quantile(depth_m[known], [0.01, 0.98]))
    high = max(high, low + 0.1)

    def colors(log_m: Array) -> Image:
        share = np.clip((high - log_m) / (high - low), 0.0, 1.0)
        level = np.round(20 + 220 * share).astype(np.uint8)  # both ends of it are nearly black
        return cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1]

    picture = colors(np.log(np.where(known, depth_m, 1.0)))
    picture[~known] = VOID
    picture = _enlarge(np.ascontiguousarray(picture), smooth=False)
    W = picture.shape[1]
    strip = np.ascontiguousarray(np.repeat(colors(np.linspace(low, high, W)[None]), SCALE_PX, 0))
    free = 0
    for tick in _TICKS_M:
        at = round((np.log(tick) - low) / (high - low) * (W - 1))
        text = f"{tick:g} m"
        if free <= at < W - style.text_size(text, TEXT_PX)[0] - 8:
            style.draw_panel(strip, (at, 0, at + 2, SCALE_PX), style.INK, 1.0)
            style.draw_text(strip, text, (at + 6, SCALE_PX - 9), TEXT_PX, style.INK, 600)
            free = at + style.text_size(text, TEXT_PX)[0] + 24
    return np.vstack([picture, strip])


def flow_picture(flow_px: Array, most_px: float | None = None) -> Image:
    """Optical flow (H, W, 2) in px: the hue is its direction, the strength of colour its length.

    most_px: length of the fullest colour, by default one that 98 % of the pixels stay below. White
    does not move in the image, unknown is dark; the wheel in the corner is the key.
    """
    known = np.isfinite(flow_px).all(axis=2)
    length = np.linalg.norm(np.where(known[..., None], flow_px, 0.0), axis=2)
    if most_px is None:
        most_px = max(float(np.quantile(length[known], 0.98)), 0.1) if known.any() else 1.0
    picture = _flow_colors(np.where(known[..., None], flow_px, 0.0) / most_px)
    picture[~known] = VOID
    picture = _enlarge(picture, smooth=False)
    _draw_wheel(picture, most_px)
    return picture


def _flow_colors(flow: Array) -> Image:
    """Colours (h, w, 3) of vectors (h, w, 2) whose length 1 has the fullest colour."""
    import cv2

    length = np.minimum(np.linalg.norm(flow, axis=2), 1.0)
    hue = np.degrees(np.arctan2(flow[..., 1], flow[..., 0])) % 360.0
    hsv = np.stack([hue, length, 1.0 - 0.12 * length], -1).astype(np.float32)
    return np.round(255 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)).astype(np.uint8)


def _draw_wheel(picture: Image, most_px: float) -> None:
    radius = max(min(picture.shape[0] // 8, 48), 8)
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] / radius
    inside = np.hypot(u, v) <= 1.0
    text = f"{most_px:.3g} px"
    width = max(2 * radius + 1, style.text_size(text, TEXT_PX, 600)[0]) + 16
    height = 2 * radius + 16 + TEXT_PX + 12
    style.draw_panel(picture, (0, 0, width, height), style.WHITE, 0.9)
    place = picture[8 : 9 + 2 * radius, 8 : 9 + 2 * radius]
    place[inside] = _flow_colors(np.stack([u, v], -1))[inside]
    style.draw_text(picture, text, (8, height - 9), TEXT_PX, style.INK, 600)


def masks_picture(image: Image, detections: Detections | None) -> Image:
    """The instances that a detector saw, each with its class; colours mean nothing yet."""
    picture, scale = _canvas(image)
    if detections is None:
        return picture
    large = _nearest(detections.labels, scale)
    for m, label in enumerate(detections.label_ids.tolist()):
        mask = large == label
        if mask.any():
            draw_mask(picture, mask, label)
            _write_at(picture, mask, str(detections.class_names[m]), style.object_color(label))
    return picture


def features_picture(image: Image, features: Features, movable: NDArray[np.bool_]) -> Image:
    """ORB features as rings, larger on coarser levels; movable pixels (H, W) are dark."""
    picture, scale = _canvas(image)
    large = _nearest(movable, scale)
    picture[large] = np.round(0.35 * picture[large]).astype(np.uint8)
    for octave in np.unique(features.octave):
        uv = _enlarged(features.uv_px[features.octave == octave], scale)
        stamp_marks(picture, uv, "ring", 1.4 * scale * 1.2 ** int(octave), style.INLIER)
    return picture


def association_picture(
    image: Image, labels_before: NDArray[np.int32], flow_px: Array, labels: NDArray[np.int32]
) -> Image:
    """Who is who: masks by lasting id, and dots that the flow brought from the frame before.

    labels_before, labels: (H, W) by lasting id, of the last frame and of this one. Dots have the
    colour of the object that they lay on in the last frame: they vote for the mask they fall in.
    """
    picture, scale = _canvas(image)
    large = _nearest(labels, scale)
    for object_id in _ids(labels):
        draw_mask(picture, large == object_id, object_id, ObjectState.UNKNOWN)
    for object_id in _ids(labels_before):
        uv = _some_pixels(labels_before == object_id, 150)
        to = uv + flow_px[uv[:, 1].astype(int), uv[:, 0].astype(int)]
        to = to[np.isfinite(to).all(axis=1)]
        stamp_marks(picture, _enlarged(to, scale), "dot", 1.9, style.object_color(object_id))
    for object_id in _ids(labels):
        _write_at(picture, large == object_id, str(object_id), style.object_color(object_id))
    return picture


def pose_picture(image: Image, result: FrameResult) -> Image:
    """Points of the map where they were found: green rings agree with the pose, crosses do not."""
    picture, scale = _canvas(image)
    uv = _enlarged(result.keypoints_px, scale)
    stamp_marks(picture, uv[~result.inliers], "cross", 5.0, style.OUTLIER)
    stamp_marks(picture, uv[result.inliers], "ring", 4.0, style.INLIER)
    return picture


def scene_flow_picture(
    image: Image, uv_px: Array, scene_flow_m: Array, threshold_m: float
) -> Image:
    """Dots at pixels (N, 2): blue where scene flow (N, 3) is short, red beyond the threshold in m.

    Unknown scene flow (NaN) leaves no dot. The strip below is the key.
    """
    picture, scale = _canvas(image)
    length_m = np.linalg.norm(scene_flow_m, axis=1)
    uv = _enlarged(uv_px, scale)
    stamp_marks(picture, uv[length_m <= threshold_m], "dot", 2.0, STILL)
    stamp_marks(picture, uv[length_m > threshold_m], "dot", 3.0, MOVES)
    words = ((STILL, f"up to {threshold_m:g} m a frame"), (MOVES, f"more than {threshold_m:g} m"))
    return np.vstack([picture, _key(picture.shape[1], words)])


def motion_picture(
    camera: StereoCamera,
    image: Image,
    before: PreparedFrame,
    labels_before: NDArray[np.int32],
    results: tuple[FrameResult, FrameResult],
) -> Image:
    """What H does: points of moving objects, from where they would be if still to where they are.

    before: the last frame, with its depth; labels_before: (H, W) its objects by lasting id.
    results: of the last frame and of this one. An arrow begins at pi(inv(X_k) P_{k-1}) and ends at
    pi(inv(X_k) H P_{k-1}), eq. (3): where the object's motion, estimated, puts the same matter.
    """
    import cv2

    picture, scale = _canvas(image)
    T_world_before, T_world_now = (result.T_world_camera for result in results)
    objects = results[1].objects
    for row in moving_rows(objects):
        object_id = int(objects.object_id[row])
        uv = _some_pixels(labels_before == object_id, 24)
        disparity = before.disparity_px[uv[:, 1].astype(int), uv[:, 0].astype(int)]
        uv, disparity = uv[disparity > 0], disparity[disparity > 0]
        P_before = transform_points(T_world_before, backproject(camera, uv, camera.bf / disparity))
        P_now = transform_points(objects.Hs_world_curr_prev[row], P_before)
        ends = [
            _enlarged(project_stereo(camera, points[good])[:, :2], scale)
            for points, good in _in_front(T_world_now, P_before, P_now)
        ]
        color = style.object_color(object_id)
        for start, end in zip(*(np.round(e).astype(int).tolist() for e in ends), strict=True):
            cv2.arrowedLine(picture, start, end, style.WHITE, 5, cv2.LINE_AA, tipLength=0.25)
            cv2.arrowedLine(picture, start, end, color, 2, cv2.LINE_AA, tipLength=0.25)
    return picture


def moving_rows(objects: ObjectEstimates) -> list[int]:
    """Rows that move, and whose motion since the last frame is known."""
    known = np.isfinite(objects.Hs_world_curr_prev).all(axis=(1, 2))
    return np.flatnonzero(known & (objects.state == str(ObjectState.MOVING))).tolist()


def _in_front(T_world_camera: Array, *points_m: Array) -> Iterable[tuple[Array, NDArray[np.bool_]]]:
    """Each set in the camera, with the rows at which all of them are before it."""
    seen = [transform_points(invert_T(T_world_camera), points) for points in points_m]
    good = np.logical_and.reduce([points[:, 2] > 0.1 for points in seen])
    return [(points, good) for points in seen]


# ------------------------------------------------------------------------------ canvas


def _canvas(image: Image) -> tuple[Image, int]:
    """The image in colour, enlarged, faded so that marks stand out; and by how much it grew."""
    color = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image
    large = _enlarge(color)
    faded = np.round(0.82 * large.astype(np.float32) + 0.18 * 235).astype(np.uint8)
    return faded, large.shape[1] // image.shape[1]


def _enlarge(image: Image, *, smooth: bool = True) -> Image:
    import cv2

    scale = max(1, round(LEAST_WIDTH_PX / image.shape[1]))
    method = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=method)


def _nearest(labels: NDArray, scale: int) -> NDArray:
    return labels.repeat(scale, axis=0).repeat(scale, axis=1)


def _enlarged(uv_px: Array, scale: int) -> Array:
    """Places (N, 2) of an image in its enlargement: pixels' centres, not corners, are whole."""
    return (uv_px + 0.5) * scale - 0.5


def _ids(labels: NDArray[np.int32]) -> list[int]:
    return [int(i) for i in np.unique(labels) if i > 0]


def _some_pixels(mask: NDArray[np.bool_], about: int) -> Array:
    """Pixels (N, 2) of a mask on an even grid, about as many as asked for."""
    step = max(2, round(np.sqrt(mask.sum() / about)))
    v, u = np.nonzero(mask[step // 2 :: step, step // 2 :: step])
    return np.column_stack([u, v]) * float(step) + step // 2


def _write_at(picture: Image, mask: NDArray[np.bool_], text: str, color: style.Color) -> None:
    """A small label in the middle of a mask, none where the mask is smaller than it."""
    v, u = np.nonzero(mask)
    width = style.text_size(text, TEXT_PX, 600)[0] + 8
    if len(u) == 0 or np.ptp(u) < width or np.ptp(v) < TEXT_PX + 6:
        return
    u0, v0 = round(float(np.median(u))) - width // 2, round(float(np.median(v))) - TEXT_PX // 2 - 3
    u0, v0 = max(min(u0, picture.shape[1] - width), 0), max(v0, 0)
    style.draw_panel(picture, (u0, v0, u0 + width, v0 + TEXT_PX + 6), color, 1.0)
    style.draw_text(picture, text, (u0 + 4, v0 + TEXT_PX), TEXT_PX, style.ink_on(color), 600)


def _key(width: int, words: Iterable[tuple[style.Color, str]]) -> Image:
    strip = np.full((SCALE_PX, width, 3), 255, np.uint8)
    u = 10
    for color, text in words:
        stamp_marks(strip, np.array([[u, SCALE_PX / 2]]), "dot", 5.0, color)
        style.draw_text(strip, text, (u + 14, SCALE_PX - 9), TEXT_PX, style.INK)
        u += 14 + style.text_size(text, TEXT_PX)[0] + 34
    return strip
