"""Instance masks of movable things in one image: the table of detectors.

Adding one is one file and one line here; the contract tests then run on it. Which one `auto` means
is decided here too.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import Protocol

from pipelines.config import DetectorConfig
from pipelines.errors import ConfigError, ModelError
from pipelines.models import is_at_hand
from pipelines.object_types import Detections
from pipelines.types import Frame

AUTO = "auto"
DETECTORS = {
    "files": "pipelines.detection.files:FilesDetector",
    "yolo_seg": "pipelines.detection.yolo_seg:YoloSeg",
    "mask_rcnn": "pipelines.detection.mask_rcnn:MaskRcnn",
    "motion": "pipelines.detection.motion:MotionDetector",
}
NETWORKS = ("yolo_seg", "mask_rcnn")  # in the order in which `auto` prefers them


class Detector(Protocol):
    """What every detector of the table offers. It may be called from any thread."""

    def detect(self, frame: Frame) -> Detections:
        """The instances in `frame`, of the classes of the settings or of unnamed class.

        It changes nothing in the frame and remembers none: the same frame gives the same answer.
        Raises ModelError where the network's file turns out to be unusable.
        """
        ...


def load_detector(config: DetectorConfig) -> Detector:
    """The detector that `config.name` says, which must be one of the table, not `auto`.

    Raises ConfigError for an unknown name, and ModelError where the network's file is missing.
    """
    if config.name not in DETECTORS:
        raise _unknown(config.name)
    module, detector = DETECTORS[config.name].split(":")
    return getattr(import_module(module), detector)(config)


def choose_detector(config: DetectorConfig, sequence_has_masks: bool) -> str:
    """The name in the table that `config.name` stands for.

    `auto` is the network of `config.model` where that is given; else `files` where the sequence
    has masks; else the first network whose file is at hand; else `motion`. Raises ConfigError for
    an unknown name, and ModelError where `config.model` cannot be opened.
    """
    if config.name in DETECTORS:
        return config.name
    if config.name != AUTO:
        raise _unknown(config.name)
    if config.model:
        return _network_of(config.model)
    if sequence_has_masks:
        return "files"
    return next((name for name in NETWORKS if is_at_hand(name)), "motion")


def _network_of(model: str) -> str:
    """Mask R-CNN answers whole-numbered labels; a YOLO network answers nothing but scores."""
    from pipelines.detection.onnx_network import OnnxNetwork

    path = Path(model).expanduser()
    if not path.is_file():
        raise ModelError(
            f"detector.model: expected an ONNX file, found nothing at {path}; "
            "`python3 -m app models` lists the networks and says how to get them"
        )
    network = OnnxNetwork(path)
    return (
        "mask_rcnn" if any("int" in kind for kind in network.output_types.values()) else "yolo_seg"
    )


def _unknown(name: str) -> ConfigError:
    names = [AUTO, *DETECTORS]
    nearest = difflib.get_close_matches(name, names, 1, 0.4)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    return ConfigError(f"Unknown detector {name!r}; {hint}There are: {', '.join(names)}.")
