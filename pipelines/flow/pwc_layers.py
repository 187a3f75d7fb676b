"""PWC-Net as a network: feature pyramid, warping, cost volume, dense decoders, context network.

Sun et al., "PWC-Net: CNNs for Optical Flow Using Pyramid, Warping, and Cost Volume", CVPR 2018, in
the form with dense connections whose weights its authors publish for PyTorch. Owns the layers under
the names of those weights. Knows no images and no files.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

PYRAMID = {1: 16, 2: 32, 3: 64, 4: 96, 5: 128, 6: 196}  # level -> channels, at size / 2^level
DECODER = (128, 128, 96, 64, 32)  # channels that each layer of a decoder adds
CONTEXT = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))  # channels, dilation
COARSEST, FINEST = 6, 2  # levels at which flow is estimated
RADIUS_PX = 4  # of the search, in pixels of a level
FLOW_UNIT_PX = 20.0  # the network says 1 for so many pixels of the full size
_SLOPE = 0.1  # of the leaky ReLU
_INSIDE = 0.9999  # share of a bilinear sample that must lie inside the image


def correlate(first: Tensor, second: Tensor, radius_px: int = RADIUS_PX) -> Tensor:
    """Cost volume (B, (2r + 1)^2, H, W): mean over channels of first(x) * second(x + d), eq. (2).

    first, second: (B, C, H, W). The displacement d runs over rows of dx within dy, both from -r to
    r; outside, `second` is 0. A product per displacement beats `unfold` and banded matrix products:
    24 ms against 410 and 240 ms at (32, 96, 320) on one core.
    """
    height, width = first.shape[-2:]
    padded = functional.pad(second, (radius_px,) * 4)
    side = range(2 * radius_px + 1)
    costs = [
        (first * padded[..., dy : dy + height, dx : dx + width]).mean(1, keepdim=True)
        for dy in side
        for dx in side
    ]
    return torch.cat(costs, 1)


def warp(features: Tensor, flow: Tensor) -> Tensor:
    """`features` (B, C, H, W) read at x + flow(x), bilinear, eq. (1); 0 where that goes outside.

    flow: (B, 2, H, W), (du, dv) in pixels of this level.
    """
    height, width = features.shape[-2:]
    u = torch.arange(width, dtype=flow.dtype, device=flow.device)
    v = torch.arange(height, dtype=flow.dtype, device=flow.device)[:, None]
    # grid_sample counts from -1 to 1 between the centres of the outermost pixels.
    x = 2.0 * (u + flow[:, 0]) / max(width - 1, 1) - 1.0
    y = 2.0 * (v + flow[:, 1]) / max(height - 1, 1) - 1.0
    grid = torch.stack([x, y], -1)
    share = functional.grid_sample(torch.ones_like(flow[:, :1]), grid, align_corners=True)
    sampled = functional.grid_sample(features, grid, align_corners=True)
    return sampled * (share >= _INSIDE)


class PwcNetwork(nn.Module):
    """The network; a state dict of the published weights fits it key by key."""

    def __init__(self) -> None:
        super().__init__()
        before = 3
        for level, channels in PYRAMID.items():
            for place, name in enumerate(_pyramid_names(level)):
                self.add_module(name, _conv(before, channels, stride=1 if place else 2))
                before = channels
        for level in range(COARSEST, FINEST - 1, -1):
            self._add_decoder(level)
        before = _decoder_inputs(FINEST) + sum(DECODER)
        for number, (channels, dilation) in enumerate(CONTEXT, 1):
            self.add_module(f"dc_conv{number}", _conv(before, channels, dilation=dilation))
            before = channels
        self.add_module(f"dc_conv{len(CONTEXT) + 1}", nn.Conv2d(before, 2, 3, padding=1))

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Flow (B, 2, H / 4, W / 4) from `first` to `second`, in FLOW_UNIT_PX of the full size.

        first, second: (B, 3, H, W) float32, BGR in 0 to 1; H and W are multiples of 64.
        """
        size = len(first)
        pyramid = self._extract(torch.cat([first, second]))
        features = _volume(pyramid[COARSEST][:size], pyramid[COARSEST][size:])
        features, flow = self._decode(COARSEST, features)
        for level in range(COARSEST - 1, FINEST - 1, -1):
            upsampled = self._run(f"deconv{level + 1}", flow)
            hints = self._run(f"upfeat{level + 1}", features)
            own = pyramid[level][:size]
            warped = warp(pyramid[level][size:], upsampled * (FLOW_UNIT_PX / 2**level))
            features = torch.cat([_volume(own, warped), own, upsampled, hints], 1)
            features, flow = self._decode(level, features)
        for number in range(1, len(CONTEXT) + 2):
            features = self._run(f"dc_conv{number}", features)
        return flow + features  # the context network refines the flow

    def _add_decoder(self, level: int) -> None:
        before = _decoder_inputs(level)
        for number, channels in enumerate(DECODER):
            self.add_module(f"conv{level}_{number}", _conv(before, channels))
            before += channels
        self.add_module(f"predict_flow{level}", nn.Conv2d(before, 2, 3, padding=1))
        # deconv2 is in the published weights, though nothing uses it.
        self.add_module(f"deconv{level}", _double(2))
        if level > FINEST:
            self.add_module(f"upfeat{level}", _double(before))

    def _extract(self, images: Tensor) -> dict[int, Tensor]:
        pyramid, features = {}, images
        for level in PYRAMID:
            for name in _pyramid_names(level):
                features = self._run(name, features)
            pyramid[level] = features
        return pyramid

    def _decode(self, level: int, features: Tensor) -> tuple[Tensor, Tensor]:
        """The features with those that the level's dense layers put before them, and its flow."""
        for number in range(len(DECODER)):
            features = torch.cat([self._run(f"conv{level}_{number}", features), features], 1)
        return features, self._run(f"predict_flow{level}", features)

    def _run(self, name: str, features: Tensor) -> Tensor:
        output: Tensor = self.get_submodule(name)(features)
        return output


def _volume(first: Tensor, second: Tensor) -> Tensor:
    return functional.leaky_relu(correlate(first, second), _SLOPE)


def _pyramid_names(level: int) -> Iterator[str]:
    """Names of a level's three layers in their order, which the last level's weights swap."""
    order = ("aa", "a", "b") if level == COARSEST else ("a", "aa", "b")
    return (f"conv{level}{name}" for name in order)


def _decoder_inputs(level: int) -> int:
    """Channels: the cost volume, and below the coarsest level features, flow and hints as well."""
    volume = (2 * RADIUS_PX + 1) ** 2
    return volume if level == COARSEST else volume + PYRAMID[level] + 4


def _conv(before: int, after: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    layer = nn.Conv2d(before, after, 3, stride, padding=dilation, dilation=dilation)
    return nn.Sequential(layer, nn.LeakyReLU(_SLOPE))


def _double(before: int) -> nn.ConvTranspose2d:
    """Two channels at twice the size."""
    return nn.ConvTranspose2d(before, 2, 4, stride=2, padding=1)
