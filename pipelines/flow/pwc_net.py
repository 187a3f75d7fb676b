"""Flow by PWC-Net: images in, the network of `pwc_layers`, pixels out.

Owns the reading of published weights and the conventions around the network. torch is imported when
the method is made, so that the table and the other methods do without it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ModelError
from pipelines.flow.images import check_pair
from pipelines.models import find_model, how_to_get
from pipelines.types import Image

if TYPE_CHECKING:
    import torch

    from pipelines.flow.pwc_layers import PwcNetwork

_MODEL = "pwc_net"  # its name in the table of models
_MULTIPLE_PX = 64  # the pyramid halves the image six times


class PwcNetFlow:
    """PWC-Net (Sun et al., CVPR 2018) with the weights that its authors publish for PyTorch.

    model: path of the weights. sha256: what their file must hash to, "" = anything. It runs on the
    GPU where torch finds one. Conventions of the published weights: channels are BGR in 0 to 1
    without further normalisation; images are resized to multiples of 64 pixels; the flow comes at a
    quarter of that size, in units of 20 pixels.
    """

    def __init__(self, model: str | Path = "", sha256: str = "") -> None:
        torch = _import_torch()
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._network = load_network(model, sha256).to(self._device)

    def compute(
        self, previous: Image, image: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Flow (H, W, 2) float32 in pixels from `previous` to `image`, known at every pixel.

        previous, image: (H, W, 3) RGB uint8; grey (H, W) is taken for three equal channels. `given`
        is not used. Raises ValueError where the images do not fit together.
        """
        from pipelines.flow.pwc_layers import FLOW_UNIT_PX

        torch = _import_torch()
        check_pair("PwcNetFlow", previous, image)
        height, width = image.shape[:2]
        with torch.inference_mode():
            first, second = (self._to_tensor(each) for each in (previous, image))
            flow = self._network(first, second)[0].permute(1, 2, 0).cpu().numpy()
        # Pixels of the resized image become pixels of the given one.
        scale = np.array([width / first.shape[3], height / first.shape[2]], np.float32)
        flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(flow * (FLOW_UNIT_PX * scale), np.float32)

    def _to_tensor(self, image: Image) -> torch.Tensor:
        """(1, 3, H', W') float32 BGR in 0 to 1, both sides rounded up to multiples of 64."""
        height, width = (-(-side // _MULTIPLE_PX) * _MULTIPLE_PX for side in image.shape[:2])
        resized = cv2.resize(np.ascontiguousarray(image), (width, height))
        bgr = (
            np.repeat(resized[None], 3, 0)
            if image.ndim == 2
            else resized[..., ::-1].transpose(2, 0, 1)
        )
        tensor = _import_torch().from_numpy(np.ascontiguousarray(bgr)).to(self._device)
        return tensor[None].float() / 255.0


def load_network(path: str | Path, sha256: str = "") -> PwcNetwork:
    """The network with the weights of the file, on the CPU and ready to run.

    path: a state dict as torch saves it, or one under "state_dict". It is read without running any
    code in it. Raises ModelError where the file is missing, damaged, of another hash, or holds
    other weights than this network's.
    """
    from pipelines.flow.pwc_layers import PwcNetwork

    path = find_model(_MODEL, path)
    weights = _read_weights(path, sha256)
    network = PwcNetwork()
    _check_weights(weights, network.state_dict(), path)
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)


def _read_weights(path: Path, sha256: str) -> dict[str, Any]:
    torch = _import_torch()
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ModelError(f"PWC-Net's weights {path}: cannot read: {error.strerror}") from error
    if sha256 and digest != sha256.lower():
        raise ModelError(
            f"PWC-Net's weights {path}: expected sha256 {sha256}, found {digest}, so the file is "
            f"damaged or another one; {how_to_get(_MODEL)}"
        )
    try:
        held = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can raise anything
        reason = (str(error) or type(error).__name__).strip().splitlines()[0]
        raise ModelError(
            f"PWC-Net's weights {path}: expected a state dict saved by torch, and it cannot be "
            f"read ({reason[:120]}); {how_to_get(_MODEL)}"
        ) from error
    if isinstance(held, dict) and isinstance(held.get("state_dict"), dict):
        held = held["state_dict"]
    if not isinstance(held, dict) or not all(isinstance(v, torch.Tensor) for v in held.values()):
        raise ModelError(
            f"PWC-Net's weights {path}: expected names with tensors, or these under 'state_dict', "
            f"found {type(held).__name__}; {how_to_get(_MODEL)}"
        )
    return held


def _check_weights(weights: dict[str, Any], wanted: dict[str, Any], path: str | Path) -> None:
    missing = [key for key in wanted if key not in weights]
    extra = [str(key) for key in weights if key not in wanted]
    faults = [f"{_list(missing)} missing"] if missing else []
    faults += [f"{_list(extra)} unknown"] if extra else []
    for key in wanted if not faults else ():
        found, expected = tuple(weights[key].shape), tuple(wanted[key].shape)
        if found != expected:
            faults = [f"{key} has shape {found}, expected {expected}"]
            break
        if not weights[key].isfinite().all():
            faults = [f"{key} holds values that are no numbers"]
            break
    if faults:
        raise ModelError(
            f"PWC-Net's weights {path} do not fit this network: {'; '.join(faults)}; "
            f"{how_to_get(_MODEL)}"
        )


def _list(keys: list[str], n: int = 3) -> str:
    more = f" and {len(keys) - n} more" if len(keys) > n else ""
    return ", ".join(keys[:n]) + more


def _import_torch() -> Any:
    try:
        import torch
    except ImportError as error:
        raise ModelError(
            f"PWC-Net needs torch, which this Python cannot import ({error}): install the packages "
            "under [torch] in environment.txt, or choose --set flow.name=dis"
        ) from error
    return torch
