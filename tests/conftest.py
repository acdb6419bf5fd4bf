import signal

import pytest


@pytest.fixture(scope="session", autouse=True)
def _children_can_be_interrupted():
    """Give child processes the default SIGINT, which a test run started in the background inherits as ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
