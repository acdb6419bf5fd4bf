"""The run at toy scale that several files of tests read: its recipe, and copies of its folder."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flcav.reproductions.demo_arms.run import ArmsResult
from flcav.reproductions.fig6a_allocation.findings import AllocationResult
from flcav.runs.recipe import load_run_recipe
from flcav.runs.running import RESULTS

Studied = tuple[Path, ArmsResult, AllocationResult]
TOY = Path(__file__).parent / "toy.yaml"
RECIPE = load_run_recipe(TOY)


def without(finished: Path, out: Path, unwanted: Callable[[str], bool]) -> Path:
    """Return a copy of the run's steps in which those of some names have not begun."""
    shutil.copytree(finished / "work", out / "work", ignore=lambda _, names: [name for name in names if unwanted(name)])
    return out / "work"


def timeless(out: Path) -> dict[str, Any]:
    return json.loads((out / RESULTS).read_text()) | {"elapsed_s": 0.0}
