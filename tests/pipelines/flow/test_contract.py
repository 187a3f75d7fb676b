"""What every flow method of the table promises, and how the settings choose one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.config import FlowConfig
from pipelines.errors import ConfigError
from pipelines.flow import FLOWS, Flow, choose_flow, load_flow

Load = Callable[..., Flow]


@pytest.fixture
def load(request) -> Load:
    """Makes a method by its name; PWC-Net's random weights are made when it is asked for."""

    def make(name: str, **settings: object) -> Flow:
        model = str(request.getfixturevalue("pwc_weights")) if name == "pwc_net" else ""
        return load_flow(FlowConfig(name=name, model=model, **settings))

    return make


def noise(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


@pytest.mark.parametrize("channels", [(), (3,)], ids=["grey", "colour"])
@pytest.mark.parametrize("name", FLOWS)
def test_flow_lies_on_the_grid_of_the_previous_image(load: Load, name: str, channels) -> None:
    images = noise(0, 2, 48, 72, *channels)
    before = images.copy()
    given = np.ones((48, 72, 2), np.float32)
    flow = load(name).compute(images[0], images[1], given)
    assert flow is not None
    assert (flow.shape, flow.dtype) == ((48, 72, 2), np.float32)
    assert flow.flags.c_contiguous
    np.testing.assert_array_equal(images, before)
    assert (given == 1).all()


@pytest.mark.parametrize("name", FLOWS)
def test_flow_has_no_memory(load: Load, name: str) -> None:
    """The same pair gives the same flow, whatever was computed before."""
    a, b, c = noise(1, 3, 48, 64)
    method = load(name)
    first = method.compute(a, b)
    method.compute(b, c)
    np.testing.assert_array_equal(first, method.compute(a, b))


@pytest.mark.parametrize("name", FLOWS)
def test_a_checked_flow_is_the_same_flow_or_unknown(load: Load, name: str) -> None:
    a, b = noise(2, 2, 48, 64)
    given = np.zeros((48, 64, 2), np.float32)
    flow = load(name).compute(a, b, given)
    strict = load(name, check=True, max_miss_px=0.2).compute(a, b, given)
    lenient = load(name, check=True, max_miss_px=5.0).compute(a, b, given)
    assert (strict.shape, strict.dtype) == (flow.shape, np.float32)
    kept, kept_by_lenient = np.isfinite(strict).all(axis=2), np.isfinite(lenient).all(axis=2)
    np.testing.assert_array_equal(strict[kept], flow[kept])
    assert (kept <= kept_by_lenient).all()
    assert kept.sum() < kept_by_lenient.sum()  # noise on noise has no true flow
    assert np.isnan(strict[~kept]).all()


@pytest.mark.parametrize("name", [name for name in FLOWS if name != "files"])
def test_images_that_do_not_fit_together(load: Load, name: str) -> None:
    gray, method = noise(3, 48, 64), load(name)
    colour = np.dstack([gray] * 3)
    for previous, image in [
        (gray, gray[:-1]),
        (gray, colour),
        (colour, gray),
        (np.dstack([gray] * 4), np.dstack([gray] * 4)),
        (gray[None, None], gray[None, None]),
        (gray / 255.0, gray / 255.0),
        (gray, gray.astype(np.float32)),
    ]:
        with pytest.raises(ValueError, match="two uint8 images of one size"):
            method.compute(previous, image)


def test_auto_takes_the_flow_that_the_sequence_brings() -> None:
    assert choose_flow(FlowConfig(), sequence_has_flow=True) == "files"
    assert choose_flow(FlowConfig(), sequence_has_flow=False) == "dis"
    for name in FLOWS:
        assert choose_flow(FlowConfig(name=name), sequence_has_flow=True) == name
        assert choose_flow(FlowConfig(name=name), sequence_has_flow=False) == name
    a, b = noise(4, 2, 48, 64)
    assert load_flow(FlowConfig(), sequence_has_flow=True).compute(a, b) is None
    assert load_flow(FlowConfig(), sequence_has_flow=False).compute(a, b) is not None


def test_the_preset_reaches_dis() -> None:
    a, b = noise(5, 2, 48, 64)
    medium, fast = (load_flow(FlowConfig(preset=p)).compute(a, b) for p in ("medium", "fast"))
    assert not np.array_equal(medium, fast)
    with pytest.raises(ConfigError, match="expected ultrafast, fast, medium, found 'slow'"):
        load_flow(FlowConfig(preset="slow"))


def test_unknown_method_names_the_nearest() -> None:
    words = r"'pwcnet'; did you mean 'pwc_net'\? There are: auto, dis, files, pwc_net"
    with pytest.raises(ConfigError, match=words):
        load_flow(FlowConfig(name="pwcnet"))
    with pytest.raises(ConfigError, match=r"Unknown flow 'xyz'; There are"):
        choose_flow(FlowConfig(name="xyz"), sequence_has_flow=True)


def test_the_table_and_the_other_methods_do_without_torch(repository: Path) -> None:
    code = (
        "import sys; from pipelines.config import FlowConfig; import pipelines.flow.pwc_net\n"
        "from pipelines.flow import load_flow; load_flow(FlowConfig(check=True))\n"
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, check=False)
    assert done.returncode == 0
