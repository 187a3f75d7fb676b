"""The export of Mask R-CNN against torch's own answer, with random weights on a real-size image."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from pipelines.config import DetectorConfig
from pipelines.detection.mask_rcnn import MaskRcnn
from pipelines.errors import ModelError
from pipelines.types import Frame

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("torchvision") is None, reason="needs torch and torchvision"),
]
KITTI = (375, 1242, 3)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """A state dict of random weights, scaled so that some scores stand out from the others."""
    import torch
    from torchvision.models.detection import MaskRCNN
    from torchvision.models.detection.backbone_utils import resnet_fpn_backbone

    torch.manual_seed(1)
    backbone = resnet_fpn_backbone(backbone_name="resnet50", weights=None, trainable_layers=0)
    state = MaskRCNN(backbone, 91).state_dict()
    state["rpn.head.cls_logits.weight"] *= 0.05
    state["roi_heads.box_predictor.bbox_pred.weight"] *= 0.1
    state["roi_heads.box_predictor.cls_score.weight"] *= 0.2
    path = tmp_path_factory.mktemp("weights") / "random.pth"
    torch.save(state, path)
    return path


@pytest.fixture(scope="module")
def exported(weights: Path) -> Path:
    from pipelines.detection.mask_rcnn_export import export_mask_rcnn

    path = weights.with_name("random.onnx")
    export_mask_rcnn(weights, path, any_weights=True)
    return path


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """Smooth noise, of KITTI's size."""
    import cv2

    noise = np.random.default_rng(2).integers(0, 256, (25, 80, 3), dtype=np.uint8)
    return cv2.resize(noise, KITTI[1::-1], interpolation=cv2.INTER_CUBIC)


def answer_of_torch(weights: Path, image: np.ndarray) -> dict[str, np.ndarray]:
    """torchvision's whole network, with its own scaling; small masks besides the pasted ones."""
    import torch

    from pipelines.detection.mask_rcnn_export import load_mask_rcnn

    model = load_mask_rcnn(weights)
    kept, paste = {}, model.transform.postprocess

    def note_small_masks(result, *shapes):
        kept["small"] = result[0]["masks"].clone()
        return paste(result, *shapes)

    model.transform.postprocess = note_small_masks
    with torch.no_grad():
        (found,) = model([torch.from_numpy(image.transpose(2, 0, 1) / np.float32(255))])
    return {name: tensor.numpy() for name, tensor in {**found, **kept}.items()}


def test_onnxruntime_answers_as_torch_does(weights: Path, exported: Path, image) -> None:
    theirs = answer_of_torch(weights, image)
    detector = MaskRcnn(DetectorConfig(model=str(exported)))
    scaled = detector._scaled(image)
    assert scaled.shape == (3, 402, 1333)
    boxes, labels, scores, masks = detector._sorted(detector._network.run(scaled))
    boxes = boxes / np.tile([1333 / 1242, 402 / 375], 2)
    assert len(boxes) == len(theirs["boxes"]) > 50
    assert masks.shape[1:] == (28, 28)
    np.testing.assert_allclose(scores, theirs["scores"], atol=1e-3)
    # Rows of nearly the same score may change places, so each is looked up by its box.
    matched = 0
    for box, label, score, mask in zip(boxes, labels, scores, masks, strict=True):
        off_px = np.abs(theirs["boxes"] - box).max(axis=1)
        row = int(np.where(theirs["labels"] == label, off_px, np.inf).argmin())
        if off_px[row] < 0.05:
            matched += 1
            assert score == pytest.approx(theirs["scores"][row], abs=1e-4)
            np.testing.assert_allclose(mask, theirs["small"][row, 0], atol=2e-3)
    assert matched >= 0.97 * len(boxes)


def test_images_of_any_size_go_through(exported: Path) -> None:
    small = MaskRcnn(
        DetectorConfig(model=str(exported), input_width_px=160, min_score=0.0, classes=("cat",))
    )
    for shape in ((97, 333), (500, 120)):
        image = np.random.default_rng(3).integers(0, 255, (*shape, 3), dtype=np.uint8)
        assert small.detect(Frame(0, 0.0, image)).labels.shape == shape


def test_other_weights_are_refused_unless_one_says_so(weights: Path, tmp_path: Path) -> None:
    from pipelines.detection.mask_rcnn_export import export_mask_rcnn

    with pytest.raises(ModelError, match="to have the sha256 bf2d0c1e, found"):
        export_mask_rcnn(weights, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()


@pytest.mark.parametrize("content", ["cut", "another", "nothing"])
def test_what_is_no_state_dict_of_this_network_is_refused(weights, tmp_path, content) -> None:
    import torch

    from pipelines.detection.mask_rcnn_export import load_mask_rcnn

    path = tmp_path / "bad.pth"
    if content == "cut":
        path.write_bytes(weights.read_bytes()[:1000000])
    elif content == "another":
        torch.save({"layer.weight": torch.zeros(3)}, path)
    else:
        path.touch()
    with pytest.raises(ModelError, match="expected the weights of torchvision's maskrcnn") as said:
        load_mask_rcnn(path)
    assert "\n" not in str(said.value)


class Evil:
    """A pickle that would run code when loaded."""

    def __reduce__(self):
        return (Path.touch, (Path("evil-was-here"),))


def test_code_in_a_weights_file_is_not_run(tmp_path: Path, monkeypatch) -> None:
    import torch

    from pipelines.detection.mask_rcnn_export import load_mask_rcnn

    monkeypatch.chdir(tmp_path)
    torch.save({"layer.weight": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(ModelError):
        load_mask_rcnn(tmp_path / "evil.pth")
    assert not (tmp_path / "evil-was-here").exists()
