"""Index values of palette PNGs, as instance masks often are (Virtual KITTI 2, DAVIS).

Owns that one step: image decoders turn indices into colours, and the indices are the labels.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

SIGNATURE = b"\x89PNG\r\n\x1a\n"
GREY, PALETTE = 0, 3  # colour types of a PNG's head


def is_palette_png(content: bytes) -> bool:
    """Whether the bytes of a file are a PNG of 8-bit palette indices."""
    is_png = content[:8] == SIGNATURE and content[12:16] == b"IHDR" and len(content) > 33
    return is_png and (content[24], content[25]) == (8, PALETTE)


def indices_as_grey(content: bytes) -> bytes:
    """The same PNG, its indices declared to be grey levels, so that a decoder leaves them alone.

    `content` is one that `is_palette_png`; one that is cut short stays so for the decoder to find.
    """
    parts = [SIGNATURE]
    for kind, body in _chunks(content):
        if kind == b"IHDR":
            body = body[:9] + bytes([GREY]) + body[10:]  # noqa: PLW2901
        elif kind in (b"PLTE", b"tRNS", b"bKGD", b"hIST"):
            continue  # a grey image has no palette to speak of
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        parts.append(struct.pack(">I", len(body)) + kind + body + checksum)
    return b"".join(parts)


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(SIGNATURE)
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        yield content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        at += 12 + length
