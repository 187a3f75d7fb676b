"""Small networks with the inputs and outputs of the real ones, and a frame that they can read.

Owns the building of the ONNX graphs. Their boxes are constants; their masks see what is red, so
that scaling, padding and the way back are tested on pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.types import Frame

RED = (slice(20, 61), slice(30, 91))  # rows and columns of the red rectangle
SHAPE = (96, 128)
K = 32  # mask coefficients

Row = tuple[tuple[float, float, float, float], int, float]  # centre and size, class, score


def red_image(shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Blue (H, W, 3) uint8 with a rectangle that is red."""
    image = np.zeros((*shape, 3), np.uint8)
    image[..., 2] = 200
    image[RED] = (255, 0, 0)
    return image


@pytest.fixture
def frame() -> Frame:
    """The red rectangle, also as the sequence's own mask: label 7, a car; 9 of no known class."""
    labels = np.zeros(SHAPE, np.int32)
    labels[RED] = 7
    labels[70:80, 5:25] = 9
    labels[2:9, 100:110] = 4
    classes = {7: "car", 4: "toaster"}
    return Frame(3, 0.3, red_image(), instance_labels=labels, instance_classes=classes)


def _save(path: Path, nodes: list, inputs: list, outputs: list, names: dict[int, str] | None):
    onnx = pytest.importorskip("onnx")
    graph = onnx.helper.make_graph(nodes, "small", inputs, outputs)
    network = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8
    )
    if names is not None:
        onnx.helper.set_model_props(network, {"names": str(names)})
    onnx.checker.check_model(network)
    onnx.save(network, path)
    return path


def _constant(name: str, array: np.ndarray) -> Any:
    onnx = pytest.importorskip("onnx")
    return onnx.helper.make_node(
        "Constant", [], [name], value=onnx.numpy_helper.from_array(array, name)
    )


@pytest.fixture
def make_yolo(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a network with the ordinary outputs of a YOLO '-seg' export.

    rows: its candidates. size: (H, W) of its input, None for any. names: in its metadata.
    """

    def make(
        rows: list[Row],
        size: tuple[int, int] | None = None,
        names: dict[int, str] | None = None,
        n_classes: int = 80,
    ) -> Path:
        onnx = pytest.importorskip("onnx")
        value = onnx.helper.make_tensor_value_info
        cells = np.zeros((1, 4 + n_classes + K, max(len(rows), 1)), np.float32)
        for i, (box, kind, score) in enumerate(rows):
            cells[0, :4, i] = box
            cells[0, 4 + kind, i] = score
            cells[0, 4 + n_classes, i] = 1.0
        # The first prototype is positive where a cell of 4 x 4 px is more red than not.
        weights, bias = np.zeros((K, 3, 4, 4), np.float32), np.zeros(K, np.float32)
        weights[0, 0], bias[0] = 1.0, -8.0
        nodes = [
            _constant("output0", cells),
            _constant("w", weights),
            _constant("b", bias),
            onnx.helper.make_node("Conv", ["images", "w", "b"], ["output1"], strides=[4, 4]),
        ]
        height, width = size or ("height", "width")
        inputs = [value("images", onnx.TensorProto.FLOAT, [1, 3, height, width])]
        outputs = [
            value("output0", onnx.TensorProto.FLOAT, list(cells.shape)),
            value("output1", onnx.TensorProto.FLOAT, [1, K, None, None]),
        ]
        return _save(tmp_path / "yolo.onnx", nodes, inputs, outputs, names)

    return make


@pytest.fixture
def make_mask_rcnn(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a network with torchvision's outputs.

    boxes, labels, scores: its answer. pasted: masks as large as the image (what is red), else
    28 x 28 (the left half of each box).
    """

    def make(boxes: list, labels: list[int], scores: list[float], pasted: bool = False) -> Path:
        onnx = pytest.importorskip("onnx")
        value, node = onnx.helper.make_tensor_value_info, onnx.helper.make_node
        n = len(boxes)
        nodes = [
            _constant("boxes", np.array(boxes, np.float32).reshape(n, 4)),
            _constant("labels", np.array(labels, np.int64)),
            _constant("scores", np.array(scores, np.float32)),
        ]
        if pasted:
            nodes += [
                _constant("zero", np.array([0])),
                node("Gather", ["image", "zero"], ["red"], axis=0),
                _constant("four", np.array([0])),
                node("Unsqueeze", ["red", "four"], ["one"]),
                node("Concat", ["one"] * n, ["masks"], axis=0),
            ]
        else:
            masks = np.zeros((n, 1, 28, 28), np.float32)
            masks[..., :14] = 1.0
            nodes.append(_constant("masks", masks))
        inputs = [value("image", onnx.TensorProto.FLOAT, [3, "height", "width"])]
        outputs = [
            value("boxes", onnx.TensorProto.FLOAT, [n, 4]),
            value("labels", onnx.TensorProto.INT64, [n]),
            value("scores", onnx.TensorProto.FLOAT, [n]),
            value("masks", onnx.TensorProto.FLOAT, [n, 1, None, None]),
        ]
        return _save(tmp_path / "mask_rcnn.onnx", nodes, inputs, outputs, None)

    return make
