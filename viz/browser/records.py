"""What the page is told of a run, as plain values that go into JSON: its setting and its frames.

Owns the form in which frames travel to the browser; `page/frames.js` reads it. Draws nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pipelines.types import Array, StereoCamera
from viz import style
from viz.boxes import ObjectBox
from viz.object_paths import OBJECT_GAP_S
from viz.playback import Playback
from viz.scene import Scene

THEMES = ("dark", "light")
_APERTURE = {"left": -0.6, "right": 0.6, "top": -0.4, "bottom": 0.4}  # where none is known
_MM = 3  # decimals of lengths in m; directions get two more


def page_setup(
    title: str,
    scene: Scene | None,
    camera: StereoCamera | None,
    *,
    theme: str = "dark",
    notes: Sequence[str] = (),
    picture_note: str = "",
) -> dict[str, Any]:
    """All that holds for the whole run. scene: None for a run that has just begun.

    notes: words below the title. picture_note: words below each annotated frame.

    Raises ValueError for an unknown theme.
    """
    if theme not in THEMES:
        raise ValueError(f"page_setup: expected theme {' or '.join(THEMES)}, found '{theme}'")
    up = np.array([0.0, -1.0, 0.0]) if scene is None else scene.up
    forward = np.array([0.0, 0.0, 1.0]) if scene is None else scene.forward
    true_paths = () if scene is None else scene.true_paths
    return {
        "title": title,
        "live": scene is None,
        "theme": theme,
        "up": _rounded(up, 6),
        "forward": _rounded(forward, 6),
        "camera": _aperture(camera),
        "truth": [_rows(path) for path in true_paths],
        "trail_gap_s": OBJECT_GAP_S,
        "palette": {
            "frustum": style.hex_color(style.FRUSTUM),
            "truth": {
                "light": style.hex_color(style.TRUTH),
                "dark": style.hex_color(style.on_dark(style.TRUTH)),
            },
        },
        "notes": list(notes),
        "picture_note": picture_note,
    }


def frame_record(
    index: int,
    timestamp_s: float,
    T_world_camera: Array,
    boxes: Iterable[ObjectBox],
    *,
    is_tracked: bool,
) -> dict[str, Any]:
    """One frame: the camera, and the boxes of the objects in it."""
    return {
        "index": int(index),
        "time": round(float(timestamp_s), 4),
        "tracked": bool(is_tracked),
        "camera": _pose(T_world_camera),
        "boxes": [_box(box) for box in boxes],
    }


def playback_records(playback: Playback) -> list[dict[str, Any]]:
    """All frames of a finished run."""
    return [
        frame_record(
            playback.frame_index[k],
            playback.timestamps_s[k],
            playback.Ts_world_camera[k],
            playback.boxes[k],
            is_tracked=bool(playback.is_tracked[k]),
        )
        for k in range(len(playback))
    ]


def _box(box: ObjectBox) -> dict[str, Any]:
    return {
        "id": box.object_id,
        "state": box.state,
        "words": box.words,
        "pose": _pose(box.T_world_box),
        "size": _rounded(box.size_m, _MM),
        "color": style.hex_color(box.color),
    }


def _aperture(camera: StereoCamera | None) -> dict[str, float]:
    """Where the image's edges lie at a depth of 1."""
    if camera is None:
        return dict(_APERTURE)
    return {
        "left": round(-camera.cx / camera.fx, 5),
        "right": round((camera.width - camera.cx) / camera.fx, 5),
        "top": round(-camera.cy / camera.fy, 5),
        "bottom": round((camera.height - camera.cy) / camera.fy, 5),
    }


def _pose(T: Array) -> list[float]:
    """The upper three rows of a pose, row by row."""
    rounded = np.round(T[:3], _MM + 2)
    rounded[:, 3] = np.round(T[:3, 3], _MM)
    return [float(value) for value in rounded.ravel()]


def _rounded(values: Array, decimals: int) -> list[float]:
    return [float(value) for value in np.round(values, decimals)]


def _rows(points_m: Array) -> list[list[float]]:
    return [_rounded(point, _MM) for point in points_m]
