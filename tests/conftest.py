import gc
import signal
from collections.abc import Generator

import pytest

from flcav.machine.threads import use_threads

use_threads(1)  # of each of the two workers and its children: threads that wait for a core burn time

LONGEST = ("test_runs.py", "test_run_recipes.py", "test_wheel.py", "test_stopped_runs.py")  # of make test-runs
FIRST = ("test_record.py", "test_cli_allocate.py", "test_record_sensors.py", "test_allocation.py")  # of make test


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
    """Put the longest files first, so that the workers end together.

    In `make test` one worker compiles the functions of LiDARs and cameras while the other does what needs none of them:
    the rest finds them in Numba's cache.
    """
    order = (*LONGEST, *FIRST)
    items.sort(key=lambda item: order.index(item.path.name) if item.path.name in order else len(order))
