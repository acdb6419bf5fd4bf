from collections.abc import Iterator

import pytest

from flcav.carla.server.calls import Calls
from flcav.carla.server.maps import Maps


@pytest.fixture(scope="package")
def maps() -> Maps:
    return Maps()


@pytest.fixture
def calls(maps: Maps) -> Iterator[Calls]:
    """Calls on an empty town."""
    made = Calls(maps, "suburb", seed=3, traffic=0, port=2000)
    yield made
    made.episode.close()
