"""Dense optical flow previous -> current: the table of methods, and which one the settings mean.

Adding one is one file and one line here; the contract tests then run on it.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.config import FlowConfig
from pipelines.errors import ConfigError
from pipelines.types import Image

FLOWS = {
    "dis": "pipelines.flow.dis:DisFlow",
    "files": "pipelines.flow.files:FilesFlow",
    "pwc_net": "pipelines.flow.pwc_net:PwcNetFlow",
}
# The settings that a method's constructor takes, by their own names.
_SETTINGS = {"dis": ("preset",), "pwc_net": ("model",)}
AUTO = "auto"


class Flow(Protocol):
    """What every method of the table offers."""

    def compute(
        self, previous: Image, image: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32] | None:
        """Flow (H, W, 2) float32 in pixels on the grid of the previous image, NaN where unknown.

        previous, image: (H, W) grey or (H, W, 3) RGB, uint8, both in the same form. given: the
        flow that the frame brings, or None. None where there is no flow to be had.
        """
        ...


def choose_flow(config: FlowConfig, sequence_has_flow: bool) -> str:
    """The name of the method: what `auto` stands for, else the name itself.

    sequence_has_flow: whether frames bring a flow of their own. Raises ConfigError for a name that
    the table lacks.
    """
    if config.name == AUTO:
        return "files" if sequence_has_flow else "dis"
    if config.name not in FLOWS:
        names = [AUTO, *FLOWS]
        nearest = difflib.get_close_matches(config.name, names, 1, 0.4)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        raise ConfigError(f"Unknown flow {config.name!r}; {hint}There are: {', '.join(names)}.")
    return config.name


def load_flow(config: FlowConfig, sequence_has_flow: bool = False) -> Flow:
    """The method that the settings ask for, with the check of flow against flow back if they do.

    Raises ConfigError for an unknown name or preset, ModelError where a network's file is missing
    or is not the expected one.
    """
    from pipelines.flow.consistency import CheckedFlow

    name = choose_flow(config, sequence_has_flow)
    method = _make(name, config)
    if not config.check:
        return method
    # A sequence brings the flow there only; the way back is then computed.
    back = _make("dis", config) if name == "files" else method
    return CheckedFlow(method, back, config.max_miss_px)


def _make(name: str, config: FlowConfig) -> Flow:
    module, method = FLOWS[name].split(":")
    settings = {setting: getattr(config, setting) for setting in _SETTINGS.get(name, ())}
    made: Flow = getattr(import_module(module), method)(**settings)
    return made
