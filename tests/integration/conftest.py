"""The run at toy scale, done once for all files and workers of a test run."""

import fcntl
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from toy_run import Studied

    from flcav.runs.results.run import Run


@pytest.fixture(scope="session")
def studied(tmp_path_factory: pytest.TempPathFactory) -> "Studied":
    """Return the folder of both comparisons of one seed, and their results."""
    from toy_run import RECIPE

    from flcav.report.pages.run_page import write_report
    from flcav.reproductions.demo_arms.run import compare_arms
    from flcav.reproductions.fig6a_allocation.run import compare_plans
    from flcav.runs.results.run import Run
    from flcav.runs.running import run_seeds

    base = tmp_path_factory.getbasetemp()
    folder = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base  # the workers' own lie in one
    out = folder / "studies"
    with (folder / "studies.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the first worker does it, another one waits
        if not (out / "summary.json").exists():
            run_seeds(RECIPE, out, seeds=1)
            write_report(Run.load(out / "seed1"), out / "seed1")
    runs = (Run.load(out / "seed1"),)
    return out, compare_arms(RECIPE, runs), compare_plans(RECIPE, {1.0: runs})


@pytest.fixture(scope="session")
def finished(studied: "Studied") -> Path:
    """Return the folder of the run, with its report."""
    return studied[0] / "seed1"


@pytest.fixture(scope="session")
def result(finished: Path) -> "Run":
    """Return the results of the run."""
    from flcav.runs.results.run import Run

    return Run.load(finished)
