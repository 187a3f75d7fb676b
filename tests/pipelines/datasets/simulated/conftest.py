"""Small simulated sequences, rendered once for all tests of this folder."""

import pytest

from pipelines.datasets.simulated import SimulatedSequence

SMALL = {"street": 0.3, "room": 0.35}


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture(scope="session", params=["street", "room"])
def exact(request, cache):
    """Four exact frames with everything provided."""
    return SimulatedSequence(
        request.param,
        frames=4,
        scale=SMALL[request.param],
        provide=("depth", "flow", "masks", "right"),
        cache=cache,
    )


@pytest.fixture(scope="session")
def street(cache):
    return SimulatedSequence("street", frames=4, scale=SMALL["street"], cache=cache)
