import gc
import signal
from collections.abc import Generator

import pytest

from flcav.machine.threads import use_threads

use_threads(1)  # of each of the two workers and its children: threads that wait for a core burn time

LONGEST = ("test_runs.py", "test_run_recipes.py", "test_examples.py", "test_wheel.py", "test_stopped_runs.py")


@pytest.fixture(scope="session", autouse=True)
def _children_can_be_interrupted():
    """Give child processes the default SIGINT, which a test run started in the background inherits as ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests without the collector of cyclic garbage, and spare it all modules afterwards: they stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, so that the workers of `make test` end together.

    The first compiles the LiDAR's functions, the second the cameras': the others find them in Numba's cache.
    """
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
