"""Datasets on slopes: agents, points and mistakes are as high above the ground as they would be in a level town."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.dataset.ground import DatasetGround
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.fusion.road import build_road_view
from flcav.geometry import Boxes, inverse, pose, transform_points
from flcav.perception.agents import choose_frames
from flcav.perception.objects.config import tiny_config
from flcav.perception.objects.task import OBJECTS
from flcav.report import style
from flcav.report.pictures import birdseye
from flcav.report.pictures.birdseye import BirdseyeView
from flcav.report.pictures.clouds import read_sweep
from flcav.runs.frames import Frames
from flcav.runs.labels.pseudo_labels import road_views
from flcav.sensors.frame import Calibration, Frame
from flcav.world.map.town import load_town

from .frames import frame

HILLY, POLE = "hilly_ring", "pole6"
HEIGHTS = np.linspace(0.0, 3.5, 300)  # of the points above the ground [m]
UP_M = 5.0  # height of the world's z = 0 below the level place that is imported


@dataclass(frozen=True)
class Place:
    """A source of a vehicle and a pole with points known in height, in a hilly town, or in none at some height."""

    town: str

    def describe(self) -> dict[str, Any]:
        return {"town": self.town, "split": "train", "seed": 0}

    def scenes(self) -> list[str]:
        return ["a"]

    def frame_count(self, scene: str) -> int:
        return 2

    def frames(self, scene: str):
        return (self.frame(agent) for agent in ("cav0", POLE))

    def trace(self, scene: str) -> None:
        return None

    def ground(self, xy: np.ndarray) -> np.ndarray:
        return load_town(self.town).grounds(*xy.T) if self.town else np.full(len(xy), UP_M)

    def frame(self, agent: str) -> Frame:
        x, y, _ = load_town(HILLY).poles.position[5]
        (z,) = self.ground(np.array([[x, y]]))
        vehicle = agent == "cav0"
        slope = {"pitch": 0.06, "roll": -0.04} if vehicle and self.town else {}
        world_from_agent = pose(x, y, z, 0.7, **slope) if vehicle else pose(x, y, z + 6.0, 0.7)
        mount = Calibration({"top": pose(0, 0, 1.8 if vehicle else 0.0)})
        aside = np.random.default_rng(0).uniform((x - 30, y - 30), (x + 30, y + 30), (len(HEIGHTS), 2))
        world = np.column_stack((aside, self.ground(aside) + HEIGHTS))
        seen = transform_points(inverse(world_from_agent @ mount.agent_from_sensor["top"]), world)
        points = np.pad(seen, ((0, 0), (0, 1))).astype(np.float32)
        bare = frame([], points=points, scene="a", agent=agent)
        return replace(bare, calibration=mount, assumed=mount, world_from_agent=world_from_agent)


@pytest.fixture(scope="module", params=[HILLY, ""], ids=["slope", "imported"])
def data(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("place")
    record(Place(request.param), out)
    return Dataset.open(out)


def test_a_pole_is_as_high_as_above_its_foot(data: Dataset) -> None:
    ground, (vehicle, pole) = DatasetGround(data), (data.frame(i).world_from_agent[2, 3] for i in (0, 1))
    assert [ground.height_of(0), ground.height_of(1)] == pytest.approx([0.0, 6.0])
    assert [ground.below(0), ground.below(1)] == pytest.approx([vehicle, pole - 6])
    assert abs(vehicle) > 4


def test_a_network_for_poles_fits_them_by_their_height_above_the_ground(data: Dataset) -> None:
    assert choose_frames(OBJECTS, tiny_config(ground_z_m=-6.0), data).agents == (POLE,)
    assert choose_frames(OBJECTS, tiny_config(), data).agents == ("cav0",)


@pytest.mark.parametrize("agent", [0, 1], ids=["vehicle", "pole"])
def test_a_birdseye_view_colours_points_by_height_above_the_ground(
    data: Dataset, agent: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[BirdseyeView] = []
    monkeypatch.setattr(birdseye, "birdseye", lambda view: shown.append(view) or style.canvas(1, 1))
    with pytest.raises(SystemExit) as ended:
        run(["birdseye", str(data.folder), "--frame", data.name(agent), "--out", str(tmp_path / "a.png")])
    assert not ended.value.code
    np.testing.assert_allclose(shown[0].points[:, 2], HEIGHTS, atol=1e-4)


def test_a_sweep_of_a_report_is_divided_at_the_ground(data: Dataset) -> None:
    seen = data.frame(0)
    points, ground_m = read_sweep(seen, "top", DatasetGround(data).relief)
    np.testing.assert_array_equal(points[:, :2], seen.lidar["top"][:, :2])
    np.testing.assert_allclose(points[:, 2] - ground_m, HEIGHTS, atol=1e-4)


def test_a_road_sensor_sees_free_ground_where_it_is(data: Dataset) -> None:
    level = Place("").frame(POLE)
    wanted = build_road_view(level, Boxes.empty(), "top", ground_m=UP_M)
    split, spin = Frames(data, (0,), {6: (1,)}), (data.keys[1].scene, data.keys[1].index)
    found = road_views(split, [6], trained=False, spins={spin})[spin][6]
    assert not road_views(split, [6], trained=False, spins=())
    assert wanted.ground.any()
    assert wanted.occupied.any()
    np.testing.assert_array_equal(found.ground, wanted.ground)
    np.testing.assert_array_equal(found.occupied, wanted.occupied)


def test_an_import_has_no_town_wherever_the_command_is_called(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(load_town("ring").net.parent)
    town = data.town()
    assert (town.name if town else "") == data.manifest.recipe["town"]
