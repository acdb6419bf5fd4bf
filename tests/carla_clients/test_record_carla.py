"""A recording from CARLA's protocol, by the genuine client, of our own server: no CARLA runs here."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from ports import find_port
from scipy.spatial import KDTree

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.dataset.validation import validate
from flcav.geometry import heading_vectors, inverse, transform_points
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import CarlaRecipe, Recipe

pytest.importorskip("carla")
pytestmark = pytest.mark.slow

LIDAR = {"mount": {"z": 1.85}, "settings": {"channels": 16, "azimuth_steps": 360, "noise_m": 0.0, "dropout": 0.0}}
CAMERA = {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 160, "height": 96}}
FIELDS: dict[str, Any] = {
    **{"town": "grid", "seed": 3, "scenes": 2, "spins_per_scene": 2, "every_s": 0.3, "warmup_s": 1.5, "cavs": 1},
    "poles": [3],
    "vehicle_rig": {
        "lidars": {"lidar": LIDAR},
        "cameras": {"camera": CAMERA},
        "gnss": {"gnss": {"mount": {"z": 1.6}}},
        "imus": {"imu": {"mount": {"z": 0.5}}},
    },
    "pole_rig": {"lidars": {"lidar": {"settings": {**LIDAR["settings"], "channels": 32, "down_deg": -45.0}}}},
}


def start_server(port: int) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "flcav", "carla", "serve", "grid", "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert server.stdout is not None
    assert "ready" in server.stdout.readline()
    return server


@pytest.fixture(scope="module")
def asked() -> Iterator[dict[str, Any]]:
    """Return the fields of a recipe for a server that runs."""
    port = find_port(2)
    server = start_server(port)
    yield {
        **FIELDS,
        "source": "carla",
        "port": port,
        "traffic_port": find_port(),
        "vehicles": 8,
        "pedestrians": 12,
        "timeout_s": 60,
    }
    server.terminate()
    server.wait(20)


@pytest.fixture(scope="module")
def recorded(asked: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("carla") / "data"
    assert record(CarlaRecipe.model_validate(asked), out)
    return Dataset.open(out)


def test_a_recording_is_whole_and_valid(recorded: Dataset) -> None:
    assert validate(recorded.folder) == []
    agents = ("cav0", "pole3")
    assert [(key.scene, key.index, key.agent, key.time_s) for key in recorded.keys] == [
        (f"grid-3-00{scene}", spin, agent, round(1.5 + 0.3 * spin, 1))
        for scene in range(2)
        for spin in range(2)
        for agent in agents
    ]
    frame = recorded.frame(0)
    assert {*frame.lidar} == {"lidar"}
    assert frame.images["camera"].rgb.shape == (96, 160, 3)
    assert frame.images["camera"].rgb.std() > 10
    assert frame.imu["imu"][2] == pytest.approx(9.8, abs=1.5)
    assert frame.gnss["gnss"][:2] == pytest.approx((49.0, 8.4), abs=0.1)
    with pytest.raises(ValueError, match="recorded without labels of signs"):
        recorded.check_labelled("signs")


def test_the_town_is_where_the_built_in_simulator_has_it(recorded: Dataset, tmp_path: Path) -> None:
    """Of the same pole and LiDAR: right-handed, in place, and in whole spins."""
    record(
        EmbeddedSource(Recipe.model_validate({**FIELDS, "cavs": 0, "scenes": 1, "spins_per_scene": 1})),
        tmp_path / "own",
    )
    own, frame = Dataset.open(tmp_path / "own").frame(0), recorded.frame(1)
    np.testing.assert_allclose(frame.world_from_agent, own.world_from_agent, atol=1e-6)
    away, _ = KDTree(own.lidar["lidar"][:, :3]).query(frame.lidar["lidar"][:, :3])
    assert (away < 0.02).mean() > 0.9  # the others are on traffic, or behind that of the other recording
    assert np.median(away) < 1e-3


def test_boxes_hold_their_returns_and_cars_move_ahead(recorded: Dataset) -> None:
    returns, moving = 0, 0
    for i in range(len(recorded)):
        frame = recorded.frame(i)
        truth, boxes = frame.annotations, frame.annotations.boxes
        inside = transform_points(frame.world_from_sensor("lidar"), frame.lidar["lidar"][:, :3].astype(np.float64))
        for row in np.flatnonzero(truth.returns):
            own = transform_points(inverse(boxes.pose(int(row))), inside)
            found = (np.abs(own) <= boxes.size[row] / 2 - (0, 0, 0.02)).all(axis=1).sum()  # but for the ground below
            assert abs(found - truth.returns[row]) <= 0.2 * truth.returns[row] + 2
        speed = np.linalg.norm(truth.velocity, axis=1)
        fast = speed > 1
        ahead = (heading_vectors(boxes.yaw[fast]) * truth.velocity[fast, :2]).sum(axis=1) / speed[fast]
        assert (ahead > 0.95).all()
        assert (truth.occlusion[truth.returns > 20] < 1).all()
        returns, moving = returns + int(truth.returns.sum()), moving + int(fast.sum())
    assert returns > 100
    assert moving > 4
    people = [recorded.frame(i).annotations.boxes for i in range(len(recorded))]
    assert any("pedestrian" in boxes.label for boxes in people)


def test_the_same_command_has_nothing_to_do(asked: dict[str, Any], recorded: Dataset) -> None:
    assert not record(CarlaRecipe.model_validate(asked | {"timeout_s": 30}), recorded.folder)


def refused(fields: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[Any, str]:
    """Return exit code and sentence of a recording that fails."""
    (folder / "recipe.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(fields))))
    with pytest.raises(SystemExit) as ended:
        run(["record", str(folder / "recipe.yaml"), "--out", str(folder / "out"), *options])
    said = capsys.readouterr().err.strip()
    assert said.startswith("flcav: ")
    assert "\n" not in said
    return ended.value.code, said


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "map": ({"town": "atlantis", "poles": []}, "has no map 'atlantis'; it has"),
    "misspelt": ({"map": "subrb"}, "did you mean 'suburb'?"),
    "many": ({"cavs": 1000, "vehicles": 0, "poles": []}, "has no free spawn point for cav"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_a_server_lacks_is_one_sentence(
    name: str, asked: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields, told = BAD[name]
    code, said = refused(asked | fields, tmp_path, capsys)
    assert (code, told in said) == (2, True), said
    assert not (tmp_path / "out").exists()


def test_no_server_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fields = {**FIELDS, "source": "carla", "port": find_port(2), "timeout_s": 1}
    code, said = refused(fields, tmp_path, capsys)
    assert code == 1
    assert "time-out of 1000ms" in said


def test_a_lost_server_is_named_and_the_recording_goes_on(tmp_path: Path) -> None:
    port = find_port(2)
    server = start_server(port)
    fields = {**FIELDS, "source": "carla", "port": port, "traffic_port": find_port(), "vehicles": 4, "timeout_s": 3}
    fields |= {"poles": [], "scenes": 2, "spins_per_scene": 20}

    def kill(frames: int) -> Callable[[int, int, str], None]:
        def progress(done: int, total: int, rate: str) -> None:
            if done >= frames and server.poll() is None:
                os.kill(server.pid, signal.SIGKILL)
                server.wait(20)

        return progress

    recipe = CarlaRecipe.model_validate(fields)
    with pytest.raises(OSError, match=f"CARLA at 127.0.0.1:{port} .* and the same command goes on"):
        record(recipe, tmp_path / "out", progress=kill(21))
    assert (tmp_path / "out" / ".recording" / "grid-3-000" / "00000").is_dir()  # the first scene
    assert not (tmp_path / "out" / "manifest.json").exists()
    server = start_server(port)
    try:
        again: list[int] = []
        assert record(recipe, tmp_path / "out", progress=lambda done, total, rate: again.append(done))
        assert min(again) >= 20  # only the second scene was missing
        assert validate(tmp_path / "out") == []
    finally:
        server.terminate()
        server.wait(20)
