"""The two forms in which a YOLO segmentation network answers, decoded to boxes and coefficients.

Owns the numbers' meaning (Ultralytics' YOLOv8 and YOLO11 segmentation heads); knows neither images
nor class names. Only candidates over the score are decoded: there are ten thousand cells, and a few
dozen of them see something.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ModelError

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Candidates:
    """Cells over the score (N of them), and what their masks are made of.

    boxes_px: (N, 4) x1 y1 x2 y2 in px of the network's input. scores: (N,) of the best class.
    classes: (N,) int64. coefficients: (N, K). prototypes: (K, h, w), of which a mask is the
    weighted sum: over zero inside (the sigmoid of it over one half). n_classes: of the network.
    """

    boxes_px: Floats
    scores: Floats
    classes: NDArray[np.int64]
    coefficients: Floats
    prototypes: Floats
    n_classes: int


def decode(outputs: dict[str, NDArray[Any]], min_score: float) -> Candidates:
    """Candidates of one image; raises ModelError where the outputs are of neither form.

    Ordinary export: [1, 4 + C + K, N] with centre, size, class scores and coefficients of each
    cell, and prototypes [1, K, h, w]. Raw heads: for each stride s dfl<s> [1, 4 x bins, H/s, W/s],
    cls<s> [1, C, H/s, W/s] and coef<s> [1, K, H/s, W/s], and proto [1, K, h, w].
    """
    strides = sorted(int(m[1]) for name in outputs if (m := re.fullmatch(r"dfl(\d+)", name)))
    raw = {f"{head}{s}" for s in strides for head in ("dfl", "cls", "coef")} | {"proto"}
    if strides and raw <= set(outputs):
        return _decode_raw(outputs, strides, min_score)
    cells = [array for array in outputs.values() if array.ndim == 3]
    prototypes = [array for array in outputs.values() if array.ndim == 4]
    if len(cells) == len(prototypes) == 1:
        n_classes = cells[0].shape[1] - 4 - prototypes[0].shape[1]
        if n_classes > 0:
            return _decode_plain(cells[0][0], prototypes[0][0], n_classes, min_score)
    found = ", ".join(f"{name} {list(array.shape)}" for name, array in outputs.items())
    raise ModelError(
        "expected the outputs of a YOLOv8 or YOLO11 segmentation network, [1, 4 + classes + K, N] "
        f"and [1, K, h, w], found {found}; export a '-seg' model, without its own NMS"
    )


def _decode_plain(
    cells: Floats, prototypes: Floats, n_classes: int, min_score: float
) -> Candidates:
    best = cells[4 : 4 + n_classes].max(axis=0)
    chosen = cells[:, best >= min_score]
    centre, half = chosen[:2].T, chosen[2:4].T / 2
    return Candidates(
        np.hstack([centre - half, centre + half]),
        chosen[4 : 4 + n_classes].max(axis=0),
        chosen[4 : 4 + n_classes].argmax(axis=0),
        np.ascontiguousarray(chosen[4 + n_classes :].T),
        prototypes,
        n_classes,
    )


def _decode_raw(
    outputs: dict[str, NDArray[Any]], strides: list[int], min_score: float
) -> Candidates:
    parts = []
    for stride in strides:
        scores = outputs[f"cls{stride}"][0]
        rows, columns = scores.shape[1:]
        scores = scores.reshape(len(scores), -1)
        cells = np.flatnonzero(scores.max(axis=0) >= min_score)
        dfl = outputs[f"dfl{stride}"][0].reshape(4, -1, rows * columns)[:, :, cells]
        centre = np.stack([cells % columns, cells // columns], axis=1) + np.float32(0.5)
        sides = _expected_bin(dfl).T  # left, top, right, bottom of the centre, in cells
        boxes = np.hstack([centre - sides[:, :2], centre + sides[:, 2:]]) * stride
        coefficients = outputs[f"coef{stride}"][0].reshape(-1, rows * columns)[:, cells]
        parts.append((boxes.astype(np.float32), scores[:, cells].T, coefficients.T))
    boxes, scores, coefficients = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Candidates(
        boxes,
        scores.max(axis=1),
        scores.argmax(axis=1),
        coefficients,
        outputs["proto"][0],
        scores.shape[1],
    )


def _expected_bin(dfl: Floats) -> Floats:
    """(4, n) mean over bins of the distributions that (4, bins, n) logits stand for."""
    weights = np.exp(dfl - dfl.max(axis=1, keepdims=True))
    bins = np.arange(dfl.shape[1], dtype=np.float32)
    return np.einsum("sbn,b->sn", weights, bins) / weights.sum(axis=1)
