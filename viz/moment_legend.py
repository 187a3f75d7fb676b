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
from viz.legend import KeyEntry, draw_title, title_lines
from viz.moment import Stage
from viz.object_marks import Box, object_counts
from viz.playback import Playback
from viz.scene import View


def draw_moment_title(
    picture: Image, view: View, result: Result, playback: Playback, k: int, *, dark: bool = False
) -> Box:
    """Title with the frame's number and time at the top left; the part that it takes."""
    facts = [f"frame {playback.frame_index[k]}", f"{playback.timestamps_s[k]:.2f} s"]
    if counts := object_counts(result.objects[[box.row for box in playback.boxes[k]]]):
        facts.append(counts)
    if not playback.is_tracked[k]:
        facts.append("camera lost")
    return draw_title(picture, view, [title_lines(result)[0], ",  ".join(facts)], dark=dark)


def moment_key(stage: Stage, view: View, boxes: Sequence[ObjectBox]) -> list[KeyEntry]:
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
    if view.px_per_m is None and np.isfinite(stage.ground_m).any():
        step_m = grid_step_m(stage.reach_m)
        key.append(KeyEntry(f"ground, lines {step_m:g} m apart", (style.GREY,), 1.0))
    return key
