"""What every flow method of the table promises."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.errors import ConfigError
from pipelines.flow import FLOWS, load_flow


@pytest.mark.parametrize("name", FLOWS)
def test_flow_lies_on_the_grid_of_the_previous_image(name: str) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, 48, 64), dtype=np.uint8)
    before = images.copy()
    given = np.ones((48, 64, 2), np.float32)
    flow = load_flow(name).compute(images[0], images[1], given)
    assert flow is not None
    assert (flow.shape, flow.dtype) == ((48, 64, 2), np.float32)
    assert flow.flags.c_contiguous
    np.testing.assert_array_equal(images, before)
    assert (given == 1).all()


@pytest.mark.parametrize("name", FLOWS)
def test_flow_has_no_memory(name: str) -> None:
    """The same pair gives the same flow, whatever was computed before."""
    a, b, c = np.random.default_rng(1).integers(0, 255, (3, 48, 64), dtype=np.uint8)
    method = load_flow(name)
    first = method.compute(a, b)
    method.compute(b, c)
    np.testing.assert_array_equal(first, method.compute(a, b))


def test_unknown_method_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"'diss'; did you mean 'dis'\? There are: dis, files"):
        load_flow("diss")
