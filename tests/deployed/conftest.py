"""A fleet that is up, for all tests of a worker: a SuperLink, a proxy, and vehicles in processes of this machine."""

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
VEHICLES = 3


@pytest.fixture(scope="session", autouse=True)
def importable():
    """Let the vehicles' processes, and this one, import the clients of these tests."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE), *([before] if before else [])])
    sys.path.insert(0, str(HERE))
    yield
    sys.path.remove(str(HERE))
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@pytest.fixture(scope="session")
def deployment(importable):
    from flcav.federation.links.flower import start_fleet

    with start_fleet(VEHICLES) as found:
        yield found
        if kept := os.environ.get("FLCAV_KEEP_FLEET"):
            shutil.copytree(found.folder, kept, dirs_exist_ok=True)


@pytest.fixture
def weights():
    rng = np.random.default_rng(0)
    return {"w": rng.normal(size=(20, 10)).astype(np.float32), "b": rng.normal(size=7)}


@pytest.fixture
def clients():
    from fleet_clients import Walker

    return {f"town/cav{number}": Walker(number + 1) for number in range(VEHICLES)}
