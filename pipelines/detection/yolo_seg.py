"""Instance masks by a YOLO segmentation network in an ONNX file: fast on a CPU.

Owns the way from an image to the network and from its candidates to instances. How the network's
numbers are meant is in `yolo_heads`. No weights come with the project: Ultralytics' own are under
AGPL-3.0.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

import numpy as np

from pipelines.config import DetectorConfig
from pipelines.detection.coco import COCO_80
from pipelines.detection.instances import PlacedMask, compose, place_mask, suppress_duplicates
from pipelines.detection.letterbox import Letterbox, to_tensor
from pipelines.detection.onnx_network import OnnxNetwork
from pipelines.detection.yolo_heads import Candidates, decode
from pipelines.errors import ModelError
from pipelines.models import find_model
from pipelines.object_types import Detections
from pipelines.types import Frame

NAME = "yolo_seg"
MAX_WIDTH_PX = 1280  # of an image for a network that takes any size; trained ones know 640
_STRIDE = 32  # the coarsest of the network's cells: sides are multiples of it
_NMS_IOU = 0.6


class YoloSeg:
    """Any YOLOv8- or YOLO11-style segmentation network; see `yolo_heads.decode` for its forms.

    The image is scaled to `config.input_width_px`, else to the fixed size of the network, else, for
    one of any size, it keeps its own up to MAX_WIDTH_PX. Class names come from the file's metadata,
    else they are COCO's.
    """

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        self._network = OnnxNetwork(find_model(NAME, config.model), config.threads)

    def detect(self, frame: Frame) -> Detections:
        """Instances of `config.classes`, best first; see `pipelines.detection.Detector`."""
        shape = frame.image.shape
        letterbox = self._letterbox(shape)
        outputs = self._network.run(to_tensor(letterbox.apply(frame.image))[None])
        try:
            found = decode(outputs, self._config.min_score)
        except ModelError as error:
            raise ModelError(f"{self._network.path}: {error}") from error
        names = self._class_names(found.n_classes)
        movable = np.isin(names, self._config.classes)
        of_movable = np.flatnonzero(movable[found.classes])
        boxes = letterbox.to_image(found.boxes_px[of_movable])
        kept = suppress_duplicates(
            boxes, found.scores[of_movable], found.classes[of_movable], _NMS_IOU
        )[: self._config.max_instances]
        chosen = of_movable[kept]
        masks = _masks(found, chosen, boxes[kept], letterbox, shape)
        return compose(shape, names[found.classes[chosen]], found.scores[chosen], masks)

    def _letterbox(self, image_shape: tuple[int, ...]) -> Letterbox:
        input_shape = self._network.input_shape
        if len(input_shape) != 4:
            raise ModelError(
                f"{self._network.path}: expected a network with the input [1, 3, H, W], "
                f"found {list(input_shape)}; export a YOLO '-seg' model"
            )
        height, width = input_shape[2:]
        if height is not None and width is not None:
            return Letterbox.fixed(image_shape, (width, height))
        wanted = self._config.input_width_px or min(image_shape[1], MAX_WIDTH_PX)
        return Letterbox.flexible(image_shape, wanted, _STRIDE)

    def _class_names(self, n_classes: int) -> np.ndarray:
        """(n_classes,) str."""
        text = self._network.metadata.get("names", "")
        try:
            stated = ast.literal_eval(text) if text else dict(enumerate(COCO_80))
            names = [str(stated[i]) for i in range(n_classes)]
        except (ValueError, SyntaxError, LookupError, TypeError) as error:
            raise ModelError(
                f"{self._network.path}: expected the names of its {n_classes} classes in the "
                f"metadata 'names', found {text[:80]!r}; export it anew with its names"
            ) from error
        return np.array(names)


def _masks(
    found: Candidates,
    chosen: np.ndarray,
    boxes_px: np.ndarray,
    letterbox: Letterbox,
    image_shape: tuple[int, ...],
) -> Iterator[PlacedMask]:
    """The mask of each chosen candidate within its box (N, 4), which is in px of the image."""
    rows, columns = found.prototypes.shape[1:]
    scale, offset = np.array(letterbox.scale_xy), np.array(letterbox.offset_xy)
    cell = np.array(letterbox.size) / (columns, rows)  # px of the network's input, 4 as a rule
    for candidate, box_px in zip(chosen, boxes_px, strict=True):
        corners = (box_px.reshape(2, 2) * scale + offset) / cell
        # One cell more on each side, to read between.
        x1, y1 = np.clip(np.floor(corners[0]) - 1, 0, (columns, rows)).astype(int)
        x2, y2 = np.clip(np.ceil(corners[1]) + 1, 0, (columns, rows)).astype(int)
        crop = found.prototypes[:, y1:y2, x1:x2]
        logits = np.tensordot(found.coefficients[candidate], crop, axes=1)
        cell_px = cell / scale
        origin_px = (np.array([x1, y1]) * cell - offset) / scale
        # The sigmoid is over one half where its argument is over zero.
        yield place_mask(logits, tuple(cell_px), tuple(origin_px), box_px, image_shape, 0.0)
