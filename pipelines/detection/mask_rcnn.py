"""Instance masks by torchvision's COCO Mask R-CNN in an ONNX file: exact, and slow without a GPU.

Owns the meaning of the network's inputs and outputs. How the file is made is in `mask_rcnn_export`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.config import DetectorConfig
from pipelines.detection.coco import COCO_91
from pipelines.detection.instances import PlacedMask, compose, place_mask, suppress_duplicates
from pipelines.detection.letterbox import to_rgb, to_tensor
from pipelines.detection.onnx_network import OnnxNetwork
from pipelines.errors import ModelError
from pipelines.models import find_model
from pipelines.object_types import Detections
from pipelines.types import Frame, Image

NAME = "mask_rcnn"
SIDES_KEY = "input_sides_px"  # metadata: shorter and longer side of an image, which is not scaled
_NMS_IOU = 0.5  # torchvision's own; within the network it has been applied already


class MaskRcnn:
    """Mask R-CNN with torchvision's outputs: boxes, labels (COCO's ids), scores and masks.

    Masks may be [N, 1, 28, 28] within each box, which is quick, or pasted into the image,
    [N, 1, H, W]. Files that `models export` makes leave the scaling of the image to this class:
    torchvision's rule, or `config.input_width_px`, which trades accuracy for time. Other files
    scale for themselves.
    """

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        self._network = OnnxNetwork(find_model(NAME, config.model), config.threads)

    def detect(self, frame: Frame) -> Detections:
        """Instances of `config.classes`, best first; see `pipelines.detection.Detector`."""
        shape = frame.image.shape
        scaled = self._scaled(frame.image)
        outputs = self._network.run(scaled[None] if self._takes_batches() else scaled)
        boxes, labels, scores, masks = self._sorted(outputs)
        scale_xy = scaled.shape[2] / shape[1], scaled.shape[1] / shape[0]
        boxes = (boxes / np.tile(scale_xy, 2)).astype(np.float32)
        names = np.array([COCO_91.get(int(label), "") for label in labels], dtype=np.str_)
        good = np.isin(names, self._config.classes) & (scores >= self._config.min_score)
        chosen = np.flatnonzero(good)
        kept = suppress_duplicates(boxes[chosen], scores[chosen], labels[chosen], _NMS_IOU)
        chosen = chosen[kept][: self._config.max_instances]
        placed = _masks(boxes[chosen], masks[chosen], scaled.shape[1:], scale_xy, shape)
        return compose(shape, names[chosen], scores[chosen], placed)

    def _takes_batches(self) -> bool:
        n_sides = len(self._network.input_shape)
        if n_sides not in (3, 4):
            raise ModelError(
                f"{self._network.path}: expected a network with the input [3, H, W] or "
                f"[1, 3, H, W], found {n_sides} sides; make it by `models export mask_rcnn`"
            )
        return n_sides == 4

    def _scaled(self, image: Image) -> NDArray[np.float32]:
        """(3, h, w) float32 in 0 to 1, at the size that the network is to see."""
        height, width = image.shape[:2]
        sides = self._network.metadata.get(SIDES_KEY, "").split()
        scale = self._config.input_width_px / width
        if not scale and len(sides) == 2:
            # torchvision: the shorter side, unless the longer one would get too long.
            shorter, longer = map(int, sides)
            scale = min(shorter / min(height, width), longer / max(height, width))
        size = (int(width * scale), int(height * scale)) if scale else (width, height)
        pixels = to_rgb(image)
        if size == (width, height):
            return to_tensor(pixels)
        # Not rounded to whole grey levels in between, as torchvision does not either.
        finer = cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return to_tensor(finer)

    def _sorted(self, outputs: dict[str, NDArray[Any]]) -> tuple[NDArray[Any], ...]:
        """boxes (N, 4), labels (N,), scores (N,) and masks (N, h, w), told by shape and type."""
        labels = [a for a in outputs.values() if a.ndim == 1 and a.dtype.kind in "iu"]
        scores = [a for a in outputs.values() if a.ndim == 1 and a.dtype.kind == "f"]
        boxes = [a for a in outputs.values() if a.ndim == 2 and a.shape[1] == 4]
        masks = [a for a in outputs.values() if a.ndim == 4 and a.shape[1] == 1]
        four = [*boxes, *labels, *scores, *masks]
        single = all(len(kind) == 1 for kind in (boxes, labels, scores, masks))
        if not single or len({len(array) for array in four}) != 1:
            found = ", ".join(f"{name} {a.dtype} {list(a.shape)}" for name, a in outputs.items())
            raise ModelError(
                f"{self._network.path}: expected Mask R-CNN's outputs, boxes [N, 4], "
                f"whole-numbered labels [N], scores [N] and masks [N, 1, h, w], found {found}; "
                "make the file by `python3 -m app models export mask_rcnn`"
            )
        return four[0], four[1].astype(np.int64), four[2], four[3][:, 0]


def _masks(
    boxes_px: NDArray[np.float32],
    masks: NDArray[np.float32],
    scaled_shape: tuple[int, ...],
    scale_xy: tuple[float, float],
    image_shape: tuple[int, ...],
) -> Iterator[PlacedMask]:
    """The mask of each instance within its box (N, 4), which is in px of the image."""
    pasted = masks.shape[1:] == scaled_shape
    rows, columns = masks.shape[1:]
    for box_px, mask in zip(boxes_px, masks, strict=True):
        if pasted:
            cell, origin = (1 / scale_xy[0], 1 / scale_xy[1]), (0.0, 0.0)
        else:
            width_px, height_px = box_px[2:] - box_px[:2]
            cell = (max(float(width_px), 1e-3) / columns, max(float(height_px), 1e-3) / rows)
            origin = (float(box_px[0]), float(box_px[1]))
        yield place_mask(mask, cell, origin, box_px, image_shape, 0.5, beyond=0.0)
