"""What real inputs suffer from, applied to exact ones: each fault can be chosen alone.

Owns the faults and their sizes. Truth is never touched; every fault is deterministic by seed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ConfigError
from pipelines.types import Array, Image, KnownNoise, StereoCamera

_ALL = ("disparity", "holes", "flow", "masks", "blur", "exposure", "noise")
_WHITE = "white"  # for measuring against the Cramer-Rao bound: nothing like it exists in nature


@dataclass(frozen=True, slots=True)
class Degradation:
    """Sizes of the faults; zero (or False) leaves that input exact."""

    disparity_sigma_px: float = 0.0  # Gaussian noise of stereo disparity
    depth_sigma_per_m: float = 0.0  # RGB-D instead: sigma_z = this * z^2, in 1/m
    hole_share: float = 0.0  # of the picture lost in blobs, besides a rim along depth edges
    computed_flow: bool = False  # DIS optical flow of the (degraded) pictures
    flow_sigma_px: float = 0.0  # or true flow with Gaussian noise, independent in each pixel
    mask_wear_px: int = 0  # masks eroded or dilated by up to this much
    mask_drop_share: float = 0.0  # of instances in frames missed wholly
    blur_share: float = 0.0  # exposure time as a share of the frame interval
    exposure_swing: float = 0.0  # largest change of the gain, slow and smooth
    noise_sigma: float = 0.0  # grey levels

    @classmethod
    def of(cls, words: str | Iterable[str] | Degradation | None, indoors: bool) -> Degradation:
        """Faults by name, "all" or e.g. "disparity,flow,masks", at their usual sizes.

        indoors: depth noise of an RGB-D camera (1.9 mm z^2) in place of disparity noise (0.3 px).
        "white", which stands alone: Gaussian noise of disparity and flow, independent in each pixel
        and so exactly known; pictures so noisy that aligning patches of them adds hardly anything.
        Raises ConfigError, naming the valid ones, where a name is unknown.
        """
        if isinstance(words, Degradation):
            return words
        listed = words.split(",") if isinstance(words, str) else list(words or ())
        names = {word.strip().lower() for word in listed} - {"", "none"}
        if names == {_WHITE}:
            return cls(disparity_sigma_px=0.5, flow_sigma_px=0.1, noise_sigma=40.0)
        if _WHITE in names:
            raise ConfigError(
                f"expected the degradation '{_WHITE}' alone, found it with "
                f"{', '.join(sorted(names - {_WHITE}))}: its noise is known only where all else is "
                "exact, so leave one of them out"
            )
        if "all" in names:
            names = (names - {"all"}) | set(_ALL)
        unknown = sorted(names - set(_ALL))
        if unknown:
            raise ConfigError(
                f"unknown degradation '{unknown[0]}': use all, or some of {', '.join(_ALL)}, or "
                f"{_WHITE} alone"
            )
        return cls(
            disparity_sigma_px=0.3 if "disparity" in names and not indoors else 0.0,
            depth_sigma_per_m=0.0019 if "disparity" in names and indoors else 0.0,
            hole_share=0.03 if "holes" in names else 0.0,
            computed_flow="flow" in names,
            mask_wear_px=4 if "masks" in names else 0,
            mask_drop_share=0.05 if "masks" in names else 0.0,
            blur_share=0.35 if "blur" in names else 0.0,
            exposure_swing=0.25 if "exposure" in names else 0.0,
            noise_sigma=2.5 if "noise" in names else 0.0,
        )

    @property
    def touches_depth(self) -> bool:
        return max(self.disparity_sigma_px, self.depth_sigma_per_m, self.hole_share) > 0

    @property
    def touches_image(self) -> bool:
        return max(self.blur_share, self.exposure_swing, self.noise_sigma) > 0

    @property
    def touches_masks(self) -> bool:
        return self.mask_wear_px > 0 or self.mask_drop_share > 0

    def known_noise(self, provide: Collection[str]) -> KnownNoise | None:
        """The noise of the inputs, where it is white and what bears it is provided.

        That of pictures may stand beside it.
        """
        only = Degradation(
            disparity_sigma_px=self.disparity_sigma_px,
            flow_sigma_px=self.flow_sigma_px,
            noise_sigma=self.noise_sigma,
        )
        is_white = self == only and min(self.disparity_sigma_px, self.flow_sigma_px) > 0
        if not is_white or not {"depth", "flow"} <= set(provide):
            return None
        return KnownNoise(self.flow_sigma_px, self.disparity_sigma_px)

    def stored(self) -> dict[str, Any]:
        """The sizes of all faults whose effects are kept on disk; others are applied when read."""
        return {key: size for key, size in asdict(self).items() if key != "flow_sigma_px"}

    @property
    def any(self) -> bool:
        return self != Degradation()


def worn_depth(
    depth_m: NDArray[np.float32], camera: StereoCamera, how: Degradation, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Depth with noise and holes; NaN stays NaN."""
    depth = depth_m.astype(float)
    if how.disparity_sigma_px > 0:
        disparity = camera.bf / depth + how.disparity_sigma_px * rng.standard_normal(depth.shape)
        # Below this disparity a matcher reports nothing.
        depth = np.where(disparity > 0.5, camera.bf / np.maximum(disparity, 0.5), np.nan)
    if how.depth_sigma_per_m > 0:
        sigma = how.depth_sigma_per_m * depth**2
        depth = np.maximum(depth + sigma * rng.standard_normal(depth.shape), 0.05)
    if how.hole_share > 0:
        depth[_holes(depth_m, how.hole_share, rng)] = np.nan
    return depth.astype(np.float32)


def _holes(
    depth_m: NDArray[np.float32], share: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Blobs over `share` of the picture, and half of the rim of the farther side of depth edges."""
    H, W = depth_m.shape
    noise = rng.standard_normal((H // 12 + 3, W // 12 + 3)).astype(np.float32)
    rough = cv2.resize(noise, (W, H), interpolation=cv2.INTER_CUBIC)
    blobs = rough > np.quantile(rough, 1 - share)
    inverse = np.nan_to_num(1 / depth_m).astype(np.float32)
    kernel = np.ones((5, 5), np.uint8)
    near = cv2.dilate(inverse, kernel)
    rim = near > 1.12 * inverse + 0.004
    patches = cv2.resize(
        rng.random((H // 6 + 2, W // 6 + 2)).astype(np.float32),
        (W, H),
        interpolation=cv2.INTER_LINEAR,
    )
    return blobs | (rim & (patches > 0.5))


def noisy_flow(
    flow_px: NDArray[np.float32], how: Degradation, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Flow (H, W, 2) with noise that is independent in each pixel and axis."""
    if how.flow_sigma_px == 0:
        return flow_px
    noise = rng.standard_normal(flow_px.shape, np.float32)
    return flow_px + np.float32(how.flow_sigma_px) * noise


def worn_masks(
    labels: NDArray[np.int32], how: Degradation, rng: np.random.Generator
) -> NDArray[np.int32]:
    """Instances eroded or dilated by 0 to `mask_wear_px`, and some missed wholly.

    A dilated mask never covers another instance. Labels that stay keep their number.
    """
    out = np.zeros_like(labels)
    for label in np.unique(labels[labels > 0]):
        missed = rng.random() < how.mask_drop_share
        wear = int(rng.integers(-how.mask_wear_px, how.mask_wear_px + 1))
        if missed:
            continue
        mask = (labels == label).astype(np.uint8)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(wear) + 1,) * 2)
        if wear < 0:
            mask = cv2.erode(mask, kernel, borderValue=1)
        elif wear > 0:
            mask = cv2.dilate(mask, kernel)
        out[(mask > 0) & ((labels == label) | ((labels == 0) & (out == 0)))] = label
    return out


def exposure_gain(timestamps_s: Array, how: Degradation, seed: int) -> Array:
    """Gain (N,) of each frame, 1 on average, with a period of some seconds."""
    phase = np.random.default_rng([seed, 77]).uniform(0, 2 * np.pi, 2)
    slow = np.sin(2 * np.pi * timestamps_s / 5.3 + phase[0])
    slower = np.sin(2 * np.pi * timestamps_s / 12.7 + phase[1])
    return 1 + how.exposure_swing * (0.7 * slow + 0.3 * slower)


def worn_image(image: Image, gain: float, how: Degradation, rng: np.random.Generator) -> Image:
    """Picture with another exposure and sensor noise."""
    out = image.astype(np.float32) * np.float32(gain)
    if how.noise_sigma > 0:
        out += how.noise_sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(out + 0.5, 0, 255).astype(np.uint8)


def computed_flow(previous: Image, current: Image) -> NDArray[np.float32]:
    """DIS optical flow (preset medium) between two RGB pictures, (H, W, 2)."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (previous, current)]
    return np.asarray(dis.calc(grey[0], grey[1], None), np.float32)
