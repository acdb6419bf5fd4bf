"""`flcav reproduce real` at toy scale: on made folders in the layouts of KITTI and Astyx, and on the real ones."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow.csv
import pytest

from flcav.cli.main import run
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import load_experiment
from flcav.reproductions.real import curve, networks
from flcav.reproductions.real.networks import NETWORKS, TRACKS
from flcav.reproductions.real.regions import ASTYX, CHOSE, KARLSRUHE, prepare_regions

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "real"
SPINS = 8
RECIPE = f"{{town: suburb, seed: 5, warmup_s: 30.0, every_s: 0.1, spins_per_scene: {SPINS}, vehicle_rig: kitti}}"
ASTYX_FRAMES = (0, 1, 100, 101, 102, 103, 230, 231)


def flcav(*command: str | Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(list(map(str, command)))
    assert stopped.value.code == 0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of simulated sweeps in the layouts of the data."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "recipe.yaml").write_text(RECIPE)
    flcav("record", folder / "recipe.yaml", "--out", folder / "data")
    flcav("export", "kitti", folder / "data", "--out", folder / "exported")
    source = folder / "exported/training"
    names = sorted(path.stem for path in (source / "velodyne").iterdir())
    objects = (*CHOSE[:2], "000008", "000015")
    for name, numbers in (("kitti", objects), ("astyx", [f"{n:06d}" for n in ASTYX_FRAMES])):
        for kind, end in (("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt")):
            (folder / name / "training" / kind).mkdir(parents=True)
            for place, number in enumerate(numbers):
                from_path = source / kind / f"{names[place % SPINS]}.{end}"
                shutil.copy(from_path, folder / name / "training" / kind / f"{number}.{end}")
    times = [f"{n:06d},{10_000_000 * n}" for n in ASTYX_FRAMES]
    (folder / "astyx/timestamps.csv").write_text("\n".join(("frame,lidar_us", *times)))
    part = folder / "kitti_tracking_0000/training"
    for kind in ("velodyne/0000", "label_02", "calib"):
        (part / kind).mkdir(parents=True)
    rows = []
    for frame, name in enumerate(names):
        shutil.copy(source / f"velodyne/{name}.bin", part / f"velodyne/0000/{frame:06d}.bin")
        labels = (source / f"label_2/{name}.txt").read_text().splitlines()
        for track, (label, _, *others) in enumerate(line.split() for line in labels):
            rows.append(f"{frame} {track} {label} 0 {' '.join(others)}")
    (part / "label_02/0000.txt").write_text("\n".join((*rows, "")))
    shutil.copy(source / f"calib/{names[0]}.txt", part / "calib/0000.txt")
    return folder


@pytest.mark.slow
def test_it_runs_on_made_folders(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "STREETS", {**networks.STREETS, "spins_per_scene": 1, "cavs": 1, "warmup_s": 20.0})
    monkeypatch.setattr(networks, "TOWNS", networks.TOWNS[:1])
    monkeypatch.setattr(curve, "SIZES", (1, 2, 4))
    monkeypatch.setattr(curve, "DRAWS", 1)
    flcav("reproduce", "real", "--scale", "quick", "--data", made, "--out", tmp_path, "--jobs", "1")
    result = json.loads((tmp_path / "result.json").read_text())
    assert {region: {*of} for region, of in result["reached"].items()} == {
        KARLSRUHE: {*NETWORKS},
        ASTYX: {*NETWORKS} - {TRACKS},
    }
    assert {name: split["sweeps"] for name, split in result["splits"][ASTYX].items()} == {
        "edge": 4,
        "validation": 2,
        "test": 2,
    }
    up = [vehicle["up_mb"] for vehicle in result["vehicles"]]
    assert len(up) == 8
    assert np.ptp(up) < 0.01 * up[0]  # all send the same network as often
    errors = pyarrow.csv.read_csv(tmp_path / "errors.csv")
    assert errors.num_rows == sum(result["drive"]["counts"].values())
    assert set(load_experiment("real").tabulate(result, "result.json")) >= {"claim", "expectations", "vehicles"}
    assert (tmp_path / "networks.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no {REAL}; set FLCAV_REAL_DATA")
def test_real_folders_become_regions(tmp_path: Path) -> None:
    regions = prepare_regions([REAL], tmp_path)
    found = {region: {name: Dataset.open(path) for name, path in of.items()} for region, of in regions.items()}
    assert {region: {name: len(data) for name, data in of.items()} for region, of in found.items()} == {
        KARLSRUHE: {"edge": 154, "validation": 9, "test": 9},
        ASTYX: {"edge": 120, "validation": 100, "test": 49},
    }
    for of in found.values():
        scenes = {name: {key.scene for key in data.keys} for name, data in of.items()}
        assert {key.agent for key in of["edge"].keys} == {f"car{n}" for n in range(4)}
        assert len(scenes["edge"]) >= 4
    way = [found[KARLSRUHE]["edge"].world_from_agent(i)[:2, 3] for i in range(39)]
    assert 5 < np.linalg.norm(way[-1] - way[0]) < 60  # poses by odometry
    assert regions == prepare_regions([REAL], tmp_path)  # which are there already
