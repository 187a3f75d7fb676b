"""The settings of every step: nested frozen dataclasses with the paper's values as defaults.

Each step gets its own section only. Owns the values' meaning; reading and overriding is below.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Step 0: depth from stereo, and which depths count as near."""

    close_baselines: float = 40.0  # a point is close when z < this many baselines (paper, ORB)
    max_depth_m: float = 0.0  # ThDepth: ignore depths beyond this, 0 = the close rule alone
    sgbm_num_disparities: int = 96  # px, search range of the stereo matcher, multiple of 16
    sgbm_block_size: int = 5  # px, odd
    left_right_max_px: float = 1.0  # px, left-right check of disparities


@dataclass(frozen=True, slots=True)
class OrbConfig:
    """Step 3: ORB features on static pixels."""

    n_features: int = 2000  # per image, after even spreading
    n_levels: int = 8  # pyramid levels (paper)
    scale_factor: float = 1.2  # between levels (paper, as ORB-SLAM)
    fast_threshold: int = 12  # grey levels, FAST corner threshold
    mask_dilation_px: int = 7  # px, movable masks grow by this before features are kept off them


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Step 4: camera pose."""

    seed: int = 0  # of RANSAC and every other random choice


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Step 10: sparse map."""


@dataclass(frozen=True, slots=True)
class Config:
    """The whole system's settings."""

    depth: DepthConfig = field(default_factory=DepthConfig)
    orb: OrbConfig = field(default_factory=OrbConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
