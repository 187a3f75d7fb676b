"""Pictures, tables and the scene of a result as a notebook shows them.

Owns the way into a cell's output: put one of these on the last line of a cell. Nothing is fetched
from outside, as images and scene are part of the output. IPython is imported when first needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pipelines.io.result import Result
from pipelines.types import Image
from viz import markup

# JupyterLab sets all cells to the right, words as well.
_TABLE_STYLE = (
    "<style>.wide th, .wide td {text-align: left !important} "
    ".wide .number {text-align: right !important}</style>"
)
_PICTURE_STYLE = "<style>figure {margin: 0} figure img {width: 100%; max-width: 1242px}</style>"


def show_picture(picture: Image | Path | str, caption: str = "") -> Any:
    """An image (H, W, 3) uint8 RGB, or a PNG or JPEG file, as wide as the notebook.

    caption: a sentence below it.
    """
    from IPython.display import HTML

    return HTML(_PICTURE_STYLE + markup.figure(picture, caption))


def show_table(heading: Sequence[str], rows: Iterable[Sequence[Any]]) -> Any:
    """A plain table: column names, then rows of as many cells each, numbers as you format them."""
    from IPython.display import HTML

    return HTML(_TABLE_STYLE + markup.table(heading, rows))


def show_scene(result: Result, height: int = 560) -> Any:
    """The run in 3D, to turn, zoom and play: map, camera, and objects as boxes with their trails.

    result: of `run` or `load_result`. height: of the view, in px. It works without a network.
    """
    from IPython.display import HTML

    from viz.browser import scene_html

    # In a box of its own, since IPython warns of pages in a page that it did not make itself
    return HTML(f"<div>{markup.page_frame(scene_html(result), height, 'the run in 3D')}</div>")
