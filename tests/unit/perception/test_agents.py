"""Whose frames are used: vehicles' and poles' sweeps in one dataset, and what is said of those left out."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.fusion.road import ROAD
from flcav.geometry import concatenate, pose
from flcav.perception.agents import choose_frames
from flcav.perception.networks import find_trained_lidar
from flcav.perception.objects import predict as prediction
from flcav.perception.objects.config import small_config, tiny_config
from flcav.perception.objects.model import second, second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import narrow_range
from flcav.perception.task import KnownLidar
from flcav.perception.trajectory.config import CONFIGURATIONS as TRAJECTORIES
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import find_recorded_lidar, find_shipped, join_lidars, read_card, save_network
from flcav.sensors.frame import Calibration, Frame
from flcav.sensors.rig import RIGS
from flcav.sources.randomisation import DRAWN_BEAMS

from .frames import cloud_in, detections, frame

CARS = [("near", "car", 10.0, 3.0, 40), ("aside", "car", 20.0, 26.0, 40), ("far", "car", 50.0, 0.0, 40)]
CLOUD = cloud_in(detections(*((x, y, 1.0) for _, _, x, y, _ in CARS)), each=40)


@dataclass(frozen=True)
class Street:
    """A source of one frame per scene and agent: vehicles with a LiDAR at `height_m`, poles with theirs at 6 m."""

    agents: tuple[str, ...] = ("cav0", "cav1", "pole3")
    scene: tuple[str, ...] = ("a", "b")
    height_m: float = 1.8
    beams: int | None = None
    range_m: float | None = None

    def describe(self) -> dict[str, Any]:
        known = {"beams": self.beams, "range_m": self.range_m}
        return {"town": "none", "split": "train", "seed": 0, "agents": self.agents, **known}

    def scenes(self) -> list[str]:
        return list(self.scene)

    def frame_count(self, scene: str) -> int:
        return len(self.agents)

    def frames(self, scene: str):
        return (self.frame(scene, agent) for agent in self.agents)

    def frame(self, scene: str, agent: str) -> Frame:
        seen = frame(CARS, points=CLOUD, scene=scene, agent=agent)
        mounted = Calibration({"top": pose(0, 0, 0.0 if agent.startswith("pole") else self.height_m)})
        raised = pose(0, 0, 6.0) if agent.startswith("pole") else np.eye(4)
        return replace(seen, calibration=mounted, assumed=mounted, world_from_agent=raised)

    def trace(self, scene: str) -> None:
        return None


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Callable[..., Dataset]:
    def make(**fields: Any) -> Dataset:
        out = tmp_path_factory.mktemp("street")
        record(Street(**fields), out)
        return Dataset.open(out)

    return make


@pytest.fixture(scope="module")
def street(recorded) -> Dataset:
    return recorded()


@pytest.fixture
def said(capsys) -> Callable[..., str]:
    """Run a command that is to succeed; return what it prints."""

    def call(*arguments: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            run([str(argument) for argument in arguments])
        told = capsys.readouterr()
        assert not stopped.value.code, told.err
        return told.out

    return call


def agents_of(data: Dataset, frames: Any) -> list[str]:
    return [data.keys[number].agent for number in frames]


@pytest.mark.parametrize(
    ("wanted", "agents", "sentence"),
    [
        (None, ["cav0", "cav1"], "4 vehicle frames (2 pole frames left out)"),
        ("vehicles", ["cav0", "cav1"], "4 vehicle frames (2 pole frames left out)"),
        ("poles", ["pole3"], "2 pole frames (4 vehicle frames left out)"),
        ("all", ["cav0", "cav1", "pole3"], "4 vehicle and 2 pole frames"),
        ("pole3,cav1", ["cav1", "pole3"], "2 vehicle and 2 pole frames (2 vehicle frames left out)"),
        ("poles,cav0", ["cav0", "pole3"], "2 vehicle and 2 pole frames (2 vehicle frames left out)"),
    ],
)
def test_agents_are_chosen_by_kind_and_name(street, wanted, agents, sentence):
    chosen = choose_frames(OBJECTS, tiny_config(), street, wanted)
    assert agents_of(street, chosen.frames) == 2 * agents
    assert list(chosen.agents) == agents
    assert chosen.sentence == sentence


def test_one_frame_is_one(recorded):
    assert choose_frames(WEATHER, None, recorded(agents=("cav0",), scene=("a",))).sentence == "1 vehicle frame"


@pytest.mark.parametrize("wanted", ["cav7", "vehicles,cav7", "", "cav0,", "pole"])
def test_agents_that_are_not_there_are_refused(street, wanted):
    with pytest.raises(InputError, match=r"has none called '.*', but cav0, cav1, pole3$"):
        choose_frames(OBJECTS, tiny_config(), street, wanted)


def test_a_kind_that_is_not_there_is_refused(recorded):
    with pytest.raises(InputError, match="has none called 'poles', but cav0"):
        choose_frames(OBJECTS, tiny_config(), recorded(agents=("cav0",)), "poles")


def test_a_lidar_fits_by_its_height_and_not_by_its_carrier(recorded):
    truck = recorded(height_m=2.9)
    with pytest.raises(InputError, match=r"no LiDAR is mounted 1.8 m .* \(cav0: 2.9 m, cav1: 2.9 m, pole3: 6 m\)"):
        choose_frames(OBJECTS, tiny_config(), truck)
    assert len(choose_frames(OBJECTS, tiny_config(), truck, "vehicles").frames) == 4
    assert choose_frames(OBJECTS, tiny_config(ground_z_m=-3.0), truck).sentence.startswith("4 vehicle frames (2 pole")


def test_a_rig_unlike_the_network_s_is_said_and_its_height_corrected(recorded):
    taller = recorded(height_m=2.1)
    chosen = choose_frames(OBJECTS, tiny_config(), taller, "all")
    assert chosen.rig == "unlike in the network's training the LiDAR is 2.10 m above the ground, not 1.8 m (corrected)"
    assert chosen.sentence == f"4 vehicle and 2 pole frames; {chosen.rig}"
    assert chosen.summary()["rig"] == chosen.rig
    assert choose_frames(OBJECTS, tiny_config(), taller, "poles").rig == ""
    beams = choose_frames(OBJECTS, tiny_config(), recorded(beams=32), trained=KnownLidar((64, 64)))
    assert beams.rig == "unlike in the network's training the LiDAR has 32 beams, not 64"
    drawn = choose_frames(OBJECTS, tiny_config(), recorded(beams=32), trained=KnownLidar(DRAWN_BEAMS["streets"]))
    assert drawn.rig == "unlike in the network's training the LiDAR has 32 beams, not 40 to 128"
    for trained in (KnownLidar((64, 64), 120), KnownLidar(DRAWN_BEAMS["streets"])):
        assert choose_frames(OBJECTS, tiny_config(), recorded(beams=64), trained=trained).rig == ""


@pytest.mark.parametrize(
    ("here", "trained", "said"), [(40, 100, True), (100, 40, True), (60, 120, False), (45, 50, False)]
)
def test_another_range_is_said_as_far_as_the_network_looks(recorded, here: float, trained: float, said: bool):
    """A tiny network looks 48 m ahead and 24 m aside: 54 m."""
    found = choose_frames(OBJECTS, tiny_config(), recorded(range_m=here), trained=KnownLidar(range_m=trained)).rig
    assert found == (f"unlike in the network's training the LiDAR reaches {here} m, not {trained} m" if said else "")
    assert choose_frames(OBJECTS, tiny_config(), recorded(range_m=here)).rig == ""


def test_the_lidar_of_a_training_is_that_of_its_rig():
    settings = RIGS["kitti_lidar"].lidars["velodyne"].settings
    known = KnownLidar((settings.channels, settings.channels), settings.range_m)
    assert known == KnownLidar((64, 64), 120)
    assert find_recorded_lidar({"vehicle_rig": "kitti_lidar"}) == known
    assert find_recorded_lidar({"vehicle_rig": RIGS["kitti_lidar"].model_dump(mode="json")}) == known
    for drawing, beams in (("streets", (40, 128)), ("lidars", (16, 128)), ("wide", (16, 128))):
        assert find_recorded_lidar({"vehicle_rig": "kitti_lidar", "randomise": drawing}) == KnownLidar(beams, 120)
    # that of the package is of many, drawn ones
    assert find_trained_lidar(OBJECTS, None) == KnownLidar(DRAWN_BEAMS["wide"], 120)


def test_the_lidar_of_a_road_detector_s_training_is_the_poles():
    both = {"vehicle_rig": "lidar32", "pole_rig": "lidar_pole"}
    assert find_recorded_lidar(both, ("pole1", "pole2")).beams == (64, 64)
    assert find_recorded_lidar(both, ("cav0", "pole2")).beams == find_recorded_lidar(both).beams == (32, 32)
    assert find_trained_lidar(OBJECTS, find_shipped(OBJECTS, ROAD)).beams == (64, 64)


def test_the_lidars_of_several_recordings_are_one_by_what_all_of_them_say():
    few, many = KnownLidar((32, 32), 100), KnownLidar(DRAWN_BEAMS["streets"], 120)
    assert join_lidars([few, many]) == KnownLidar((32, 128))
    assert join_lidars([many, KnownLidar(None, 120)]) == KnownLidar(None, 120)
    assert join_lidars([]) == KnownLidar()


def test_cameras_of_vehicles_and_poles_are_used_alike_and_paths_are_those_of_vehicles(street):
    assert choose_frames(WEATHER, None, street).left_out == {}
    assert choose_frames(TRAJECTORY, TRAJECTORIES["tiny"], street).left_out == {}
    assert choose_frames(TRAJECTORY, TRAJECTORIES["tiny-cameras"], street).left_out == {"pole": 2}


def test_every_command_says_whose_frames_it_uses(street, tmp_path, said):
    out = tmp_path / "out"
    learned = said(
        "train", "objects", "--data", street.folder, "--validation", street.folder, "--out", out, "--epochs", 1
    )
    counts = "4 vehicle frames (2 pole frames left out)"
    assert learned.splitlines()[:2] == [f"{street.folder}: {counts}", f"{street.folder}: {counts}, for validation"]
    weights = out / "weights.safetensors"
    card = read_card(weights)
    assert card.samples == 4
    assert card.validation is not None
    assert [entry.agents for entry in (*card.data, card.validation)] == 2 * [("cav0", "cav1")]
    assert "4 frames of cav0, cav1;" in card.markdown()
    evaluated = said("evaluate", "objects", "--data", street.folder, "--weights", weights).splitlines()
    assert evaluated[:2] == [counts, f"network: pillars, seed 0, {weights}"]
    assert any("0 to 48 m ahead and 24 m to either side, 5 LiDAR returns or more" in line for line in evaluated[:5])
    assert "intervals: 95 %, over scenes" in evaluated[:5]
    assert said("infer", "objects", street.folder, "--weights", weights).startswith(f"{street.folder}: {counts}\n")


def test_what_is_left_out_is_neither_tested_nor_looked_at(street, tmp_path, said):
    weights = tmp_path / "weights.safetensors"
    save_network(OBJECTS, second_tiny(), weights)
    for wanted, agents in (((), ["cav0", "cav1"]), (("--agents", "pole3"), ["pole3"])):
        result = json.loads(
            said("evaluate", "objects", "--data", street.folder, "--weights", weights, "--json", *wanted)
        )
        asked_for = OBJECTS.evaluate(second_tiny(), street, street.select(agents=agents))
        assert result["frames"] == 2 * len(agents)
        assert [row["targets"] for row in result["scores"]] == [row.targets for row in asked_for.scores]
        found = json.loads(said("infer", "objects", street.folder, "--weights", weights, "--json", *wanted))
        assert [one["path"].rsplit("_", 1)[1] for one in found["inputs"]] == 2 * agents
        assert result["agents"] == found["datasets"][0]["agents"] == agents
        assert sum(result["used"].values()) + sum(result["left_out"].values()) == 6


def test_files_have_no_agents(street, tmp_path, capsys):
    cloud = next(iter(sorted(street.folder.glob("top/*.bin"))))
    with pytest.raises(SystemExit, match="2"):
        run(["infer", "objects", str(cloud), "--agents", "all"])
    assert "--agents all: only datasets have agents" in capsys.readouterr().err


def test_networks_of_different_ranges_are_asked_for_the_same_objects(street):
    tiny, small = second_tiny(), second(small_config(("Car",)))
    own, same = [], []
    for network in (tiny, small):
        asked = narrow_range(network.config, "48,24")
        own.append(OBJECTS.evaluate(network, street).scores[0].targets)
        same.append(OBJECTS.evaluate(network, street, asked=asked).scores[0].targets)
    assert own == [6, 18]
    assert same == [6, 6]


def test_beyond_the_range_nothing_is_wrong(street, monkeypatch):
    hit, beyond = detections((10, 3, 0.8)), detections((44, 10, 0.9), (30, -26, 0.9))
    monkeypatch.setattr(prediction, "detect_all", lambda *_, **__: [concatenate([beyond, hit])])
    network = second(small_config(("Car",)))
    ap = [
        OBJECTS.evaluate(network, street, street.select(agents=["cav0"]), asked=asked).scores[0].ap
        for asked in (narrow_range(network.config, "40,24"), narrow_range(network.config, "51,28"))
    ]
    assert ap[0] == 1
    assert ap[1] is not None
    assert ap[1] < 0.5


@pytest.mark.parametrize("text", ["48", "48,24,1", "48;24", "nan,24", "48,inf", "0,24", "-48,24", "48,-24", ""])
def test_a_range_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="metres ahead and metres to either side are wanted, as in 48,24"):
        narrow_range(small_config(), text)


@pytest.mark.parametrize("text", ["52,24", "48,29"])
def test_a_range_beyond_the_network_s_is_refused(text):
    with pytest.raises(InputError, match=r"sees no further than 0 to 51\.2 m ahead and 28\.8 m to either side"):
        narrow_range(small_config(), text)


def test_only_objects_lie_in_a_range(street, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(["evaluate", "weather", "--data", str(street.folder), "--range", "48,24"])
    assert "--range: only objects" in capsys.readouterr().err


def test_a_range_around_is_asked_for_to_all_four_sides(street, tmp_path, said, monkeypatch):
    """The car 20 m ahead and 26 m to the left is 26 m away by 20 m to the right of who looks left."""
    hits = detections((10, 3, 0.9), (20, 26, 0.8), (-10, 5, 0.7), (30, 30, 0.6), (50, 0, 0.5))
    monkeypatch.setattr(prediction, "detect_all", lambda *_, **__: [hits])
    weights = tmp_path / "weights.safetensors"
    save_network(OBJECTS, second(small_config(("Car",))), weights)
    options = ("evaluate", "objects", "--data", street.folder, "--weights", weights, "--range", "48,24", "--json")
    ahead, around = json.loads(said(*options)), json.loads(said(*options, "--around"))
    assert (ahead["rules"]["range_m"], around["rules"]["range_m"]) == ([0, -24, -3, 48, 24, 1],) * 2
    assert ("around" in ahead["rules"], around["rules"]["around"]) == (False, True)
    assert (ahead["scores"][0]["targets"], around["scores"][0]["targets"]) == (4, 8)
    counts = {key: each["near"] for key, each in (("ahead", ahead), ("around", around))}
    assert (counts["ahead"]["cars"], counts["ahead"]["found"]) == (4, 4)
    assert (counts["around"]["cars"], counts["around"]["found"]) == (8, 8)
    assert counts["ahead"]["false_per_quarter_turn"] == 0  # (-10, 5) and (30, 30) are in no range asked for
    assert counts["around"]["false_per_quarter_turn"] == 0.25  # one in each of four looks
    assert (counts["around"]["within_m"], counts["around"]["score"], counts["around"]["overlap"]) == (40, 0.3, 0.5)


def test_infer_has_no_range(street, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(["infer", "objects", str(street.folder), "--around", "--range", "48,24"])
    assert len(told := capsys.readouterr().err.splitlines()) == 1
    assert "No such option" in told[0]
    assert "--range" in told[0]


def test_one_scene_has_no_interval(recorded, tmp_path, said, monkeypatch):
    hits = detections((10, 3, 0.8))
    monkeypatch.setattr(prediction, "detect_all", lambda *_, **__: [hits])
    weights = tmp_path / "weights.safetensors"
    save_network(OBJECTS, second_tiny(), weights)
    for scenes, words in ((("a",), "AP 1.000 (no interval: one scene)"), (("a", "b"), "AP 1.000 [1.000, 1.000]")):
        data = recorded(scene=scenes)
        options = ("evaluate", "objects", "--data", data.folder, "--weights", weights)
        assert words in said(*options)
        row = json.loads(said(*options, "--json"))["scores"][0]
        assert (row["low"], row["high"]) == ((None, None) if len(scenes) == 1 else (1, 1))
