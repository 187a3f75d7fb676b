"""Annotated frames as JPEG: for one request, or all of them within a number of bytes.

Owns how they are made smaller. Draws nothing.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from pipelines.types import Image

SERVED = (1280, 88)  # width in pixels, quality
LIVE = (1280, 82)
# From the best to the smallest that still tells anything; then pictures are left out.
EMBEDDED = ((960, 82), (800, 80), (640, 78), (520, 74), (420, 70))
_SAMPLES = 5
_BASE64 = 4 / 3


def encode_jpeg(image: Image, width: int, quality: int) -> bytes:
    """An image (H, W, 3) RGB, no wider than `width`, as JPEG."""
    import cv2

    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    bgr = np.ascontiguousarray(image[..., ::-1])
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def read_jpeg(path: Path, width: int, quality: int) -> bytes | None:
    """A picture file as JPEG no wider than `width`; None where it cannot be read."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if image is None else encode_jpeg(image[..., ::-1], width, quality)


def embed_pictures(paths: Sequence[Path | None], max_bytes: float) -> list[str | None]:
    """Data URIs of pictures that take no more than `max_bytes` together, None where there is none.

    They are made smaller first; where that is not enough, only every n-th is kept.
    """
    there = [k for k, path in enumerate(paths) if path is not None]
    uris: list[str | None] = [None] * len(paths)
    if not there or max_bytes <= 0:
        return uris
    samples = [there[i] for i in np.linspace(0, len(there) - 1, _SAMPLES).round().astype(int)]
    for width, quality in EMBEDDED:
        sizes = [len(read_jpeg(Path(str(paths[k])), width, quality) or b"") for k in samples]
        needed = 1.08 * _BASE64 * float(np.mean(sizes)) * len(there)
        if needed <= max_bytes:
            break
    kept = there[:: max(1, int(np.ceil(needed / max_bytes)))]
    with ThreadPoolExecutor(thread_name_prefix="jpeg") as pool:
        answers = pool.map(lambda k: read_jpeg(Path(str(paths[k])), width, quality), kept)
        left = max_bytes - 8 * len(paths)  # of quotes, commas, nulls
        for k, data in zip(kept, answers, strict=True):
            if data is None:
                continue
            uri = f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}"
            left -= len(uri)
            if left < 0:
                break
            uris[k] = uri
    return uris
