"""The folder of a run with recordings: the rounds of the committed demo, and a short drive in its first town."""

import shutil
import subprocess
import sys
from math import nan
from pathlib import Path

import numpy as np

from flcav.dataset.store import Dataset
from flcav.perception.errors import PerceptionError, save_errors
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.perception.weights import find_shipped, load_network, save_network
from flcav.runs.frames import Recorded
from flcav.runs.results.saved import WEIGHTS
from flcav.runs.results.tests import SweepComparison, SweepDetections

FLCAV = Path(sys.executable).with_name("flcav")
DEMO = Path(__file__).parents[2] / "reproductions" / "runs" / "demo"
RECIPE = """\
town: grid
seed: 4
scenes: 1
warmup_s: 10.0
spins_per_scene: 3
every_s: 2.0
cavs: 4
poles: []
vehicle_rig: car
"""


def make_run(folder: Path) -> Path:
    """Return the folder of a run whose first region has its drives, two misses, a compared sweep and pictures."""
    run = folder / "recorded"
    work = run / "work"
    work.mkdir(parents=True)
    shutil.copy(DEMO / "results.json", run)
    (folder / "drive.yaml").write_text(RECIPE)
    data = work / "grid-registry-objects" / "data"
    subprocess.run([FLCAV, "record", folder / "drive.yaml", "--out", data], check=True, capture_output=True)
    recorded = Dataset.open(data)
    frames = Recorded("data", tuple(range(len(recorded))), {}, 1)
    frames.save(data.parent)
    for name in ("grid-edge-objects", "grid-test-objects"):
        shutil.copytree(data.parent, work / name)
    _save_errors(recorded, work / "grid-errors-objects")
    _save_sweep(recorded, work / "look")
    _save_networks(work / "pretrain-objects", work / "grid-edge-fl-objects")
    return run


def _save_networks(before: Path, after: Path) -> None:
    """Save a network that has learned nothing, and the packaged one."""
    trained = load_network(OBJECTS, find_shipped(OBJECTS))
    save_network(OBJECTS, build_network(OBJECTS, trained.config, 1), before / WEIGHTS)
    save_network(OBJECTS, trained, after / WEIGHTS)


def _save_errors(data: Dataset, folder: Path) -> None:
    """Register as missed the two nearest cars that drive in the last frame, the second at an unknown distance."""
    folder.mkdir()
    frame = data.frame(len(data) - 1)
    truth = frame.annotations
    moves = np.hypot(*truth.velocity[:, :2].T) > 1.0
    here, cars = frame.world_from_agent[:2, 3], np.flatnonzero((truth.boxes.label == "car") & moves)
    far = np.hypot(*(truth.boxes.center[cars, :2] - here).T)
    near = cars[np.argsort(far)[:2]].tolist()
    missed = [
        PerceptionError(x, y, z, 1.0, "miss", "Car", 9, 0.2, frame.scene, str(track), metres)
        for (x, y, z), track, metres in zip(
            truth.boxes.center[near].tolist(), truth.track[near], (far.min(), nan), strict=True
        )
    ]
    save_errors(missed, folder / "errors.parquet")


def _save_sweep(data: Dataset, folder: Path) -> None:
    """Compare nothing found with one of two targets found and one false box."""
    folder.mkdir()
    targets = ((12.0, 2.0, -1.0, 4.5, 1.9, 1.6, 0.1), (25.0, -3.0, -1.0, 4.5, 1.9, 1.6, 3.1))
    before = SweepDetections((), (), (False, False))
    after = SweepDetections((targets[0], (30.0, 6.0, -1.0, 4.0, 1.8, 1.5, 0.0)), (True, False), (True, False))
    SweepComparison(0, targets, before, after).save(folder)
