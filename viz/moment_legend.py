"""What explains the picture of one frame: its number and time, and what the lines and boxes are.

Owns these words; how a legend looks is `viz.legend`'s.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.io.result import Result
from pipelines.object_types import ObjectState
from pipelines.types import Image
from viz import style
from viz.boxes import ObjectBox
from viz.ground import grid_step_m
from viz.legend import KeyEntry, draw_key, draw_title, title_lines
from viz.moment import Stage
from viz.object_marks import Box, object_counts
from viz.scene import View


def draw_moment_legend(
    picture: Image,
    view: View,
    result: Result,
    stage: Stage,
    k: int,
    key: Sequence[KeyEntry],
    *,
    dark: bool = False,
) -> list[Box]:
    """Title with the frame's number and time, and the legend; the parts that they take."""
    playback = stage.playback
    facts = [f"frame {playback.frame_index[k]}", f"{playback.timestamps_s[k]:.2f} s"]
    boxes = playback.boxes[k]
    if counts := object_counts(result.objects[[box.row for box in boxes]]):
        facts.append(counts)
    if not playback.is_tracked[k]:
        facts.append("camera lost")
    lines = [title_lines(result)[0], ",  ".join(facts)]
    taken = [draw_title(picture, view, lines, dark=dark)]
    return taken + draw_key(picture, view, key, dark=dark)


def moment_key(stage: Stage, boxes: Sequence[ObjectBox]) -> list[KeyEntry]:
    """What explains the camera, these boxes and the grid on the ground."""
    key = [KeyEntry("camera and its path", (style.ESTIMATE,), 3.0)]
    for state, label, width_px in (
        (ObjectState.MOVING, "moving, and its path", 3.0),
        (ObjectState.COASTING, "hidden, predicted", 1.4),
        (ObjectState.STOPPED, "standing still", 1.0),
    ):
        colors = tuple(box.color for box in boxes if box.state == str(state))
        if colors:
            key.append(KeyEntry(label, colors, width_px, state is ObjectState.COASTING))
    if np.isfinite(stage.ground_m).any():
        step_m = grid_step_m(stage.reach_m)
        key.append(KeyEntry(f"ground, lines {step_m:g} m apart", (style.GREY,), 1.0))
    return key
