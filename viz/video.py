"""A run as a video: its annotated frames above, the map with cameras and boxes below.

Owns what is in a picture of the video and how long it lasts. The file is `viz.mp4`'s.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipelines.errors import DyObError
from pipelines.io.result import Result
from pipelines.types import Array, Image
from viz import style
from viz.chase import chase_views
from viz.legend import draw_key_and_scale, draw_title
from viz.moment import build_stage, draw_moment, draw_moment_labels
from viz.moment_legend import draw_moment_title, moment_key
from viz.mp4 import open_mp4
from viz.playback import Playback, build_playback
from viz.points import check_names, draw_points
from viz.scene import View
from viz.views import choose_view

logger = logging.getLogger("dyob.viz")

WIDTH_PX = 1280
MOST_FRAME_SHARE = 0.47  # of the width: height of the frame in the widest video
MAP_SHARE = 0.42  # of the width: height of the map below a frame
ALONE_SHARE = 0.5625  # and of a map alone
BOTH_HALVES = "after the global batch  (the picture above: as it was live)"
LONGEST_S, ONLY_S = 2.0, 1.0  # a gap in the data is played so long; a run of one frame lasts this


def write_video(
    result: Result,
    path: Path | str,
    *,
    view: str = "chase",
    width: int = WIDTH_PX,
    background: str = "white",
    renderer: str = "splat",
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a video of a result to `path`, an .mp4 that browsers play at the speed of the data.

    view: "chase" follows the camera; "top" and "iso" show the whole. width: of the widest video in
    pixels; upright frames make a narrower one. renderer: of the points; the software renderer draws
    the same picture in a tenth of Open3D's time. progress: called with frames done and their
    number. Raises DyObError where there is no frame or the file cannot be written, ValueError for
    an unknown name.
    """
    check_names(background, renderer)
    playback = build_playback(result)
    if len(playback) == 0:
        raise DyObError(
            f"{result.folder}: expected frames to make a video of, found a result without any; "
            "run the sequence again"
        )
    frames = _AnnotatedFrames(playback)
    size, frame_px = _sizes(frames.size, width)
    map_size = size[0], size[1] - frame_px
    views = _views(view, playback, map_size)
    dark = background != "white"
    still = len({id(v) for v in views}) == 1
    pictures = draw_points(
        playback.scene, views[:1] if still else views, background=background, renderer=renderer
    )
    ground, stage = next(pictures), build_stage(playback)
    # One legend for all frames: it must not jump about.
    key = moment_key(stage, views[0], [box for boxes in playback.boxes for box in boxes])
    with open_mp4(path, size, durations_s(playback.timestamps_s)) as video:
        for k, own in enumerate(views):
            if k and not still:
                ground = next(pictures)
            picture = ground.copy()
            draw_moment(picture, own, stage, k, dark=dark)
            taken = draw_key_and_scale(picture, own, key, playback.scene, dark=dark)
            if not frame_px:
                taken.append(draw_moment_title(picture, own, result, playback, k, dark=dark))
            elif playback.is_optimised:
                taken.append(draw_title(picture, own, [BOTH_HALVES], large=False, dark=dark))
            draw_moment_labels(picture, own, playback, k, taken)
            if frame_px:
                picture = np.concatenate([frames.at(k, (size[0], frame_px)), picture])
            video.add(picture)
            if progress is not None:
                progress(k + 1, len(playback))
    return Path(path)


def durations_s(timestamps_s: Array) -> Array:
    """How long each frame is shown: until the next one's time, the last as long as most are."""
    steps = np.diff(timestamps_s)
    good = steps[np.isfinite(steps) & (steps > 0)]
    usual = float(np.median(good)) if len(good) else ONLY_S
    steps = np.where(np.isfinite(steps) & (steps > 0), steps, usual)
    return np.minimum(np.append(steps, usual), LONGEST_S)


def _views(name: str, playback: Playback, size: tuple[int, int]) -> list[View]:
    if name == "chase":
        return chase_views(playback, size)
    return [choose_view(name, playback.scene, size)] * len(playback)


def _sizes(frame_size: tuple[int, int] | None, width: int) -> tuple[tuple[int, int], int]:
    """Size of the video and height of the frame in it, all even; 0 where there are no frames."""
    if frame_size is None:
        return (_even(width), _even(ALONE_SHARE * width)), 0
    aspect = frame_size[0] / frame_size[1]
    wide = _even(min(width, MOST_FRAME_SHARE * width * aspect))
    frame_px = _even(wide / aspect)
    return (wide, frame_px + _even(MAP_SHARE * width)), frame_px


def _even(length: float) -> int:
    return max(2, 2 * round(length / 2))


class _AnnotatedFrames:
    """The pictures in frames/; one that is missing is stood in for by the one before it."""

    def __init__(self, playback: Playback) -> None:
        self._paths = list(playback.pictures)
        self._last: Image | None = None
        first = next((path for path in self._paths if path is not None), None)
        image = _read(first) if first is not None else None
        self.size = None if image is None else (image.shape[1], image.shape[0])
        missing = sum(path is None for path in self._paths)
        if self.size is None:
            logger.warning(
                "there are no annotated frames (the run had --pictures 0), so the map fills the "
                "video alone"
            )
        elif missing:
            logger.warning(
                "%d of %d annotated frames are missing; the ones before them stay in the video",
                missing,
                len(self._paths),
            )
            self._last = image

    def at(self, k: int, size: tuple[int, int]) -> Image:
        """The k-th frame, (H, W, 3) of that (W, H)."""
        import cv2

        path = self._paths[k]
        image = _read(path) if path is not None else None
        if image is None:
            image = self._last
        self._last = image
        if image is None:
            return np.full((size[1], size[0], 3), style.BACKGROUNDS["black"], np.uint8)
        way = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC
        return np.asarray(cv2.resize(image, size, interpolation=way))


def _read(path: Path) -> Image | None:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if image is None else np.ascontiguousarray(image[..., ::-1])
