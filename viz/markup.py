"""HTML that needs nothing from outside: pictures inside the page, tables, a page in a page.

Owns escaping and the encoding of pictures. What a report or a notebook says is theirs.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.types import Image

JPEG_QUALITY = 88
WIDEST_PX = 1920  # of a photo; finer ones stay files


def picture_uri(picture: Image | Path | str, *, photo: bool = False) -> str:
    """A picture as a data: address: an image (H, W, 3) uint8 RGB, or a PNG or JPEG file.

    photo: make it a JPEG of some width at most, which is far smaller than a PNG of a camera's
    image. Images in memory become one always. A file goes in as it is otherwise.
    Raises ValueError where a photo's file is no picture.
    """
    import cv2

    if not isinstance(picture, np.ndarray):
        path = Path(picture)
        if not photo:
            is_jpeg = path.suffix.lower() in (".jpg", ".jpeg")
            return _uri("jpeg" if is_jpeg else "png", path.read_bytes())
        bgr = cv2.imread(str(path))
        if bgr is None:
            raise ValueError(f"picture_uri: expected a PNG or JPEG file, found {path}")
    else:
        bgr = np.ascontiguousarray(picture[..., ::-1])
    if bgr.shape[1] > WIDEST_PX:
        share = WIDEST_PX / bgr.shape[1]
        bgr = cv2.resize(bgr, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    _, content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return _uri("jpeg", content.tobytes())


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


class Html(str):
    """Text that is HTML already, and goes into a cell as it is."""


def cell(content: Any) -> str:
    """The content of a cell, escaped unless it is `Html`."""
    return content if isinstance(content, Html) else escape(str(content))


def table(heading: Sequence[Any], rows: Iterable[Sequence[Any]]) -> Html:
    """A table: column names, then rows of as many cells; an empty heading has none.

    Columns of numbers have the class "number", for style sheets to set them to the right.
    """
    rows = [[cell(content) for content in row] for row in rows]
    numbers = [_is_of_numbers(column) for column in zip(*rows, strict=True)]

    def line(tag: str, cells: Iterable[str], kinds: Iterable[bool]) -> str:
        marks = (' class="number"' if kind else "" for kind in kinds)
        pairs = zip(cells, marks, strict=True)
        return f"<tr>{''.join(f'<{tag}{mark}>{text}</{tag}>' for text, mark in pairs)}</tr>"

    names = [cell(name) for name in heading]
    top = f"<thead>{line('th', names, numbers or [False] * len(names))}</thead>" if names else ""
    body = "".join(line("td", row, numbers) for row in rows)
    return Html(f'<div class="wide"><table>{top}<tbody>{body}</tbody></table></div>')


def _is_of_numbers(column: Sequence[str]) -> bool:
    """Whether all cells that are not empty begin as a number does and are short."""
    filled = [text.strip() for text in column if text.strip()]
    return bool(filled) and all(
        len(text) < 20 and text.lstrip("+-±").lstrip(".")[:1].isdigit() for text in filled
    )


def figure(picture: Image | Path | str, caption: str = "", *, photo: bool = False) -> Html:
    """A picture with a sentence below it."""
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    uri = picture_uri(picture, photo=photo)
    return Html(f'<figure><img alt="{escape(caption)}" src="{uri}">{below}</figure>')


def page_frame(page: str, height_px: int, title: str) -> Html:
    """A whole page of its own inside this one, so that the styles of neither touch the other."""
    return Html(
        f'<iframe srcdoc="{escape(page)}" title="{escape(title)}" '
        f'style="width:100%;height:{height_px}px;border:0"></iframe>'
    )
