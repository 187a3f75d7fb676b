"""Decoding of both forms of a YOLO network's answers, against a plain loop over cells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipelines.detection.yolo_heads import Candidates, decode
from pipelines.errors import ModelError

C, K, BINS = 5, 4, 16


@pytest.fixture
def raw() -> dict[str, np.ndarray]:
    """Random heads of an image of 64 x 96 px."""
    rng = np.random.default_rng(5)
    outputs = {"proto": rng.normal(size=(1, K, 16, 24)).astype(np.float32)}
    for stride in (8, 16, 32):
        grid = (64 // stride, 96 // stride)
        outputs[f"dfl{stride}"] = rng.normal(0, 2, (1, 4 * BINS, *grid)).astype(np.float32)
        outputs[f"cls{stride}"] = rng.uniform(0, 1, (1, C, *grid)).astype(np.float32)
        outputs[f"coef{stride}"] = rng.normal(size=(1, K, *grid)).astype(np.float32)
    return outputs


def decoded_by_loops(raw: dict[str, np.ndarray]) -> list[list[float]]:
    """[x1, y1, x2, y2, class scores ..., coefficients ...] of each cell, as the format says."""
    rows = []
    for stride in (8, 16, 32):
        dfl, scores, coefficients = (raw[f"{name}{stride}"][0] for name in ("dfl", "cls", "coef"))
        for y in range(scores.shape[1]):
            for x in range(scores.shape[2]):
                sides = []
                for side in range(4):
                    weights = [math.exp(dfl[side * BINS + b, y, x]) for b in range(BINS)]
                    mean = sum(b * w for b, w in enumerate(weights)) / sum(weights)
                    sides.append(mean)
                left, top, right, bottom = sides
                box = [x + 0.5 - left, y + 0.5 - top, x + 0.5 + right, y + 0.5 + bottom]
                cell = [side * stride for side in box]
                rows.append([*cell, *scores[:, y, x], *coefficients[:, y, x]])
    return rows


def as_ordinary(rows: list[list[float]]) -> np.ndarray:
    """[1, 4 + C + K, N] with centre and size."""
    table = np.array(rows, np.float32).T
    corner, opposite = table[:2].copy(), table[2:4].copy()
    table[:2], table[2:4] = (corner + opposite) / 2, opposite - corner
    return table[None]


def assert_is(found: Candidates, rows: list[list[float]], min_score: float) -> None:
    expected = [row for row in rows if max(row[4 : 4 + C]) >= min_score]
    assert 3 < len(expected) < len(rows)
    table = np.array(expected)
    np.testing.assert_allclose(found.boxes_px, table[:, :4], atol=2e-4)
    np.testing.assert_allclose(found.scores, table[:, 4 : 4 + C].max(axis=1), rtol=1e-6)
    np.testing.assert_array_equal(found.classes, table[:, 4 : 4 + C].argmax(axis=1))
    np.testing.assert_allclose(found.coefficients, table[:, 4 + C :], rtol=1e-6)
    assert found.n_classes == C


def test_raw_heads(raw) -> None:
    found = decode(raw, 0.9)
    assert_is(found, decoded_by_loops(raw), 0.9)
    np.testing.assert_array_equal(found.prototypes, raw["proto"][0])


def test_ordinary_export_in_any_order_of_outputs(raw) -> None:
    rows = decoded_by_loops(raw)
    outputs = {"output1": raw["proto"], "output0": as_ordinary(rows)}
    assert_is(decode(outputs, 0.9), rows, 0.9)


def test_nothing_over_the_score_is_no_candidate(raw) -> None:
    rows = as_ordinary(decoded_by_loops(raw))
    for outputs in (raw, {"output0": rows, "output1": raw["proto"]}):
        found = decode(outputs, 1.0)
        assert len(found.scores) == len(found.boxes_px) == len(found.coefficients) == 0


def test_outputs_of_another_network_are_refused_with_what_was_found(raw) -> None:
    detection = {"output0": np.zeros((1, 84, 100), np.float32)}
    with pytest.raises(ModelError, match=r"found output0 \[1, 84, 100\]; export a '-seg' model"):
        decode(detection, 0.5)
    without_head = {name: array for name, array in raw.items() if name != "coef16"}
    with pytest.raises(ModelError, match="expected the outputs of a YOLOv8"):
        decode(without_head, 0.5)
    with_own_nms = {"output0": np.zeros((1, 3, 38)), "output1": np.zeros((1, 32, 16, 24))}
    with pytest.raises(ModelError, match="without its own NMS"):
        decode(with_own_nms, 0.5)
