"""torchvision's Mask R-CNN written as an ONNX file, from its published weights.

Owns what is left out of the file: scaling the image, which `mask_rcnn` does, and pasting the masks
into it, which is most of the work where there is no GPU. Needs torch, torchvision and onnx;
nothing is downloaded here.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from pipelines.detection.mask_rcnn import SIDES_KEY
from pipelines.errors import ModelError
from pipelines.models import check_model

WEIGHTS = "mask_rcnn_weights"
N_CLASSES = 91  # COCO's ids, 0 for background
SIDES_PX = (800, 1333)  # torchvision's: shorter side, and the limit of the longer one
_OPSET = 17
_OUTPUTS = ("boxes", "labels", "scores", "masks")
_SAMPLE_SHAPE = (3, 224, 320)  # of the image that the network is traced with; any size works after


def export_mask_rcnn(weights_path: Path, onnx_path: Path, any_weights: bool = False) -> None:
    """Write Mask R-CNN R50-FPN with the weights of a torchvision state dict to `onnx_path`.

    The file takes an image float32 [3, H, W], RGB, 0 to 1, any size, and gives boxes [N, 4] in px
    of that, labels [N], scores [N] and masks [N, 1, 28, 28], each over its box. any_weights: also
    take weights that are not the published ones, of one's own training say. Raises ModelError where
    the weights are not what they should be.
    """
    if not any_weights:
        check_model(WEIGHTS, weights_path)
    model = load_mask_rcnn(weights_path)
    _leave_out_scaling_and_pasting(model)
    _write_onnx(model, onnx_path)
    _note_sides(onnx_path)


def load_mask_rcnn(weights_path: Path) -> Any:
    """torchvision's network with these weights, ready to be used, as torchvision itself loads it.

    Raises ModelError where the file is no state dict of this network.
    """
    import pickle

    import torch
    from torchvision.models.detection import MaskRCNN
    from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
    from torchvision.ops.misc import FrozenBatchNorm2d

    backbone = resnet_fpn_backbone(backbone_name="resnet50", weights=None, trainable_layers=0)
    model = MaskRCNN(backbone, N_CLASSES)
    for module in model.modules():
        if isinstance(module, FrozenBatchNorm2d):
            module.eps = 0.0  # these weights were trained so; torchvision sets it too
    try:
        state = torch.load(weights_path, map_location="cpu", weights_only=True)
        model.load_state_dict(state)
    except (OSError, RuntimeError, EOFError, ValueError, TypeError, AttributeError,
            pickle.UnpicklingError) as error:  # fmt: skip
        reason = " ".join(str(error).split())[:200]
        raise ModelError(
            f"{weights_path}: expected the weights of torchvision's maskrcnn_resnet50_fpn, found "
            f"something else ({reason}); get them by `python3 -m app models fetch {WEIGHTS}`"
        ) from error
    return model.eval()


def _leave_out_scaling_and_pasting(model: Any) -> None:
    """Change the network so that it takes images as they are, and hands masks on as 28 x 28."""

    def as_it_is(image: Any, target: Any = None) -> tuple[Any, Any]:
        return image, target

    def boxes_and_small_masks(result: Any, image_shapes: Any, original_sizes: Any) -> Any:
        return result

    model.transform.resize = as_it_is
    model.transform.postprocess = boxes_and_small_masks


def _write_onnx(model: Any, path: Path) -> None:
    import torch

    class Plain(torch.nn.Module):
        """One image in, four tensors out."""

        def __init__(self) -> None:
            super().__init__()
            self.network = model

        def forward(self, image: Any) -> tuple[Any, ...]:
            (found,) = self.network([image])
            return tuple(found[name] for name in _OUTPUTS)

    sample = torch.rand(_SAMPLE_SHAPE, generator=torch.Generator().manual_seed(0))
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer, about sizes that are constant by intent
        torch.onnx.export(
            Plain().eval(),
            (sample,),
            str(path),
            input_names=["image"],
            output_names=list(_OUTPUTS),
            dynamic_axes={"image": {1: "height", 2: "width"}, **{n: {0: "n"} for n in _OUTPUTS}},
            opset_version=_OPSET,
            dynamo=False,  # the newer exporter cannot do this network
        )


def _note_sides(path: Path) -> None:
    """Write into the file which sides images are to be scaled to, since it does not do that."""
    import onnx

    network = onnx.load(path)
    onnx.helper.set_model_props(network, {SIDES_KEY: " ".join(map(str, SIDES_PX))})
    onnx.save(network, path)
