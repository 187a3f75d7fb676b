"""The self-contained page of a finished run, and the data that its served sister asks for.

Owns what fits into the file: pictures are made smaller, and large maps thinned.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from pipelines.io.files import write_text
from pipelines.io.result import Result
from viz.browser.cloud import MAX_POINTS, Cloud, build_cloud
from viz.browser.page import embedded_page
from viz.browser.pictures import embed_pictures
from viz.browser.records import page_setup, playback_records
from viz.playback import Playback, build_playback

MB = 1e6
PICTURE_NOTE = "as it was live, before the global batch"
_BYTES_A_POINT = 15 * 4 / 3  # position and colour, in base64
_SHARE_OF_POINTS = 0.3  # of the page, at most


def scene_html(
    result: Result, *, images: bool = True, max_mb: float = 10.0, theme: str = "dark"
) -> str:
    """The run as one page of about `max_mb` million bytes at most: scene, time slider, pictures.

    It holds all that it needs and asks for nothing from outside. images: whether the annotated
    frames are in it. Pictures and points are fitted to the size; frames are never left out, so that
    a run of thousands may take more. theme: "dark" or "light"; ValueError for another.
    """
    playback = build_playback(result)
    most = int(_SHARE_OF_POINTS * max_mb * MB / _BYTES_A_POINT)
    data, cloud = page_data(result, playback, theme=theme, max_points=min(most, MAX_POINTS))
    encoded = base64.b64encode(cloud.message).decode("ascii")
    data["pictures"] = []
    if images:
        bare = len(embedded_page(data, encoded, theme).encode())
        data["pictures"] = embed_pictures(playback.pictures, max_mb * MB - bare)
    return embedded_page(data, encoded, theme)


def export_scene(
    result: Result, path: Path | str, *, images: bool = True, max_mb: float = 10.0
) -> Path:
    """Write `scene_html` to a file; its path. Raises DyObError where the disk refuses."""
    path = Path(path)
    write_text(path, scene_html(result, images=images, max_mb=max_mb))
    return path


def page_data(
    result: Result, playback: Playback, *, theme: str = "dark", max_points: int = MAX_POINTS
) -> tuple[dict[str, Any], Cloud]:
    """What both pages show, but for the pictures: setup, frames and facts of the map; the map."""
    scene = playback.scene
    axes = (scene.up, scene.forward)
    cloud = build_cloud(scene.points_m, scene.colors, scene.path_m, axes, max_points)
    title = str(result.metrics.get("run", {}).get("sequence", result.folder.name))
    notes = ["the map is thinned"] if cloud.n_points < cloud.n_all else []
    data = {
        "setup": page_setup(
            title,
            scene,
            playback.camera,
            theme=theme,
            notes=notes,
            picture_note=PICTURE_NOTE if playback.is_optimised else "",
        ),
        "map": cloud.facts,
        "frames": playback_records(playback),
    }
    return data, cloud
