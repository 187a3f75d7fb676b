"""Weights of PWC-Net for the tests: random ones under the published names, in a file."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def pwc_weights(tmp_path_factory) -> Path:
    """A file as torch saves it; the flow that it gives is of some pixels, and means nothing."""
    torch = pytest.importorskip("torch", reason="needs torch; `python3 -m app test` installs it")
    from pipelines.flow.pwc_layers import PwcNetwork

    torch.set_num_threads(1)  # on a busy machine two threads mostly wait for each other
    generator = torch.Generator().manual_seed(0)
    weights = {}
    for name, shape in ((name, value.shape) for name, value in PwcNetwork().state_dict().items()):
        spread = 0.1 if len(shape) == 1 else (2.0 / shape[1:].numel()) ** 0.5
        if name.startswith("deconv"):
            spread *= 2.0  # so that the coarse flow moves the warping on the finer levels
        weights[name] = torch.randn(shape, generator=generator) * spread
    path = tmp_path_factory.mktemp("pwc_net") / "pwc_net.pth.tar"
    torch.save(weights, path)
    return path
