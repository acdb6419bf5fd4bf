"""Runs whose vehicles' poses are estimated from what they recorded: from the recipe to labels, and what is refused."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flcav.config import InputError
from flcav.dataset.layout import navigation_path
from flcav.dataset.store import Dataset
from flcav.geometry import yaw_of
from flcav.runs.frames import Frames
from flcav.runs.labels.sightings import draw_clock_offset, navigate
from flcav.runs.labels.tracks import load_tracks
from flcav.runs.recipe import EDGE, MAIN, RunRecipe
from flcav.runs.running import run
from flcav.runs.stages.graph import Graph

pytestmark = pytest.mark.slow

ONE = {"scenes": 1, "spins": 1, "cavs": 1}
RECIPE: dict[str, Any] = {
    "tasks": {
        "objects": {
            "network": "tiny",
            "labels": "tracks",
            "plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1},
            "recording": {"warmup_s": 40.0},
        }
    },
    "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 2}},
    "budgets_mb": {"wireless": 60, "wireline": 60},
    "splits": {
        "pool": {**ONE, "cavs": 4},
        "validation": ONE,
        "registry": ONE,
        "edge": ONE,
        "test": {**ONE, "scenes": 2},
    },
    "training": {"steps": 1, "local_steps": 1},
    "placement": {"rule": "none"},
    "navigation": "estimated",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "estimated"
    found = run(RunRecipe.model_validate(RECIPE), out)
    assert any(each.stage == EDGE and each.labels for each in found.arms[MAIN].stages)
    return out


def test_vehicles_label_by_estimated_poses(folder: Path) -> None:
    split = Frames.open(folder / "work" / "grid-edge-objects")
    data = split.data
    assert set(data.navigation_logs(data.keys[0].scene)) == {"cav0", "cav1"}
    assert set(data.frame(0).gnss) == {"gnss"}  # the task's own rig has none
    assert set(load_tracks(folder / "work" / "grid-tracks-objects")) == set(split.vehicles)
    for agent in ("cav0", "cav1"):
        off = []
        for i in data.select(agents=[agent]):
            pose, stated = navigate(data, i, "estimated")
            true = data.world_from_agent(i)
            off.append((*(pose - true)[:3, 3], yaw_of(pose) - yaw_of(true)))
            assert np.hypot(*off[-1][:2]) < 5 * stated.position_m
            assert draw_clock_offset(data, i, "estimated") == 0
        assert np.abs(off)[:, 2].max() < 0.3  # the map knows the height
        assert 0 < np.ptp(off, axis=0)[:2].max() < 0.3  # nearly the same error in all sweeps of two seconds


def test_what_a_dataset_lacks_is_refused_before_the_run_begins(folder: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(folder / "work" / "grid-edge-objects" / "data", bare)
    recorded = RECIPE | {"regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "data": {}}}}
    recorded["regions"]["grid"]["data"] = dict.fromkeys(("validation", "registry", "edge", "test"), str(bare))
    Graph(RunRecipe.model_validate(recorded), tmp_path)
    shutil.rmtree(bare / "navigation")
    with pytest.raises(InputError, match=r"bare: navigation 'estimated' needs navigation logs, and 'grid-\d+-000' has"):
        Graph(RunRecipe.model_validate(recorded), tmp_path)
    Graph(RunRecipe.model_validate(recorded | {"navigation": {"position_m": 0.2}}), tmp_path)
    data = Dataset.open(bare)
    with pytest.raises(InputError, match=r"no navigation log of 'cav0'; estimated poses need 'navigation_s'"):
        navigate(data, 0, "estimated")


def test_fixes_of_another_drive_are_refused(folder: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(folder / "work" / "grid-edge-objects" / "data", bad)
    path = bad / navigation_path(Dataset.open(bad).keys[0].scene)
    table = pq.read_table(path)
    for name in ("fix_time_s", "fix"):
        swapped = pa.array(table[name].to_pylist()[::-1], type=table.schema.field(name).type)
        table = table.set_column(table.schema.get_field_index(name), table.schema.field(name), swapped)
    pq.write_table(table, path)
    with pytest.raises(
        InputError, match=r"parquet: 'cav0': the fixes of the navigation log are not where its IMU leads"
    ):
        navigate(Dataset.open(bad), 0, "estimated")
