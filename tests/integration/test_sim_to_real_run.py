"""`flcav reproduce sim-to-real` at toy scale, with the weights of the package, on frames in KITTI's layout."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.experiments.experiment import load_experiment
from flcav.reproductions.sim_to_real import run as sim_to_real

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "kitti_frame"
TOY = {**sim_to_real.RECIPE, "scenes": 1, "warmup_s": 20.0, "spins_per_scene": 1, "cavs": 1}
RECIPE = """
town: suburb
seed: 5
warmup_s: 30.0
spins_per_scene: 1
vehicle_rig: kitti
"""


def flcav(*command: str | Path) -> None:
    with pytest.raises(SystemExit) as stopped:
        run(list(map(str, command)))
    assert stopped.value.code == 0


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a frame of our own in KITTI's layout."""
    folder = tmp_path_factory.mktemp("kitti")
    (folder / "recipe.yaml").write_text(RECIPE)
    flcav("record", folder / "recipe.yaml", "--out", folder / "data")
    flcav("export", "kitti", folder / "data", "--out", folder / "kitti")
    return folder / "kitti"


@pytest.mark.slow
@pytest.mark.parametrize(
    "made",
    [
        "driven",
        pytest.param("real", marks=pytest.mark.skipif(not REAL.is_dir(), reason=f"no {REAL}; set FLCAV_REAL_DATA")),
    ],
)
def test_it_runs_with_the_shipped_weights(
    made: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kitti = REAL if made == "real" else request.getfixturevalue(made)
    monkeypatch.setattr(sim_to_real, "RECIPE", TOY)
    flcav("reproduce", "sim-to-real", "--kitti", kitti, "--out", tmp_path, "--jobs", "1")
    results = json.loads((tmp_path / "result.json").read_text())
    (name,) = (path.stem for path in (kitti / "training" / "velodyne").iterdir())
    labels = [line.split()[0] for line in (kitti / "training" / "label_2" / f"{name}.txt").read_text().splitlines()]
    scores = {(row["class"], row["kind"], row["iou"]): row for row in results["scores"]}
    assert scores["Car", "3d", 0.5]["targets"] == len(results["frames"][0]["cars"]) == labels.count("Car")
    assert scores["Car", "3d", 0.5]["found"] == sum(0.5 in car["found_at"] for car in results["frames"][0]["cars"])
    clouds = results["clouds"]
    assert list(clouds) == ["KITTI", "simulated", "beams alone"]
    returns = len(np.fromfile(kitti / "training" / "velodyne" / f"{name}.bin", np.float32)) / 4
    assert all(clouds[each]["returns"] > 0 for each in clouds)
    assert clouds["KITTI"]["returns"] <= returns
    assert set(load_experiment("sim-to-real").tabulate(results, "result.json")) == {"detections", "cars", "clouds"}
    assert (tmp_path / "clouds.png").read_bytes()[:4] == (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    if made == "real":
        assert scores["Car", "3d", 0.5]["found"] >= labels.count("Car") / 2
