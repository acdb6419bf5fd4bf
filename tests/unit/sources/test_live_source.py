"""Drives in a live world, recorded: the same dataset whoever records it, whose frames show the world as it was."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from flcav import load_town, record, validate
from flcav.config import InputError, Json
from flcav.geometry import heading_vectors
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.rig import Mount, MountedLidar, Rig
from flcav.sources.live import LiveSource
from flcav.storage.files import sha256
from flcav.world.commands import Controls, Spawn
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.roads import draw_route, read_net
from flcav.world.snapshot import Snapshot

RIG = Rig(lidars={"lidar": MountedLidar(mount=Mount(z=1.8), settings=Lidar(channels=8, azimuth_steps=180))})


@dataclass
class Starting:
    """A car that sets off straight ahead."""

    throttle: float = 0.5

    def describe(self) -> Mapping[str, Json]:
        return {"throttle": self.throttle}

    def begin(self, world: LiveWorld) -> None:
        route = draw_route(read_net(world.town.net), np.random.default_rng(3), 300.0)
        x, y, yaw = route.at(10.0).tolist()
        world.apply(Spawn("ego", "car", 3, x, y, yaw, anywhere=True))

    def drive(self, now: Snapshot) -> Mapping[str, Controls]:
        return {"ego": Controls(throttle=self.throttle)}


def make_source(**changes: object) -> LiveSource:
    values = {"settings": Settings(seed=5, traffic=6), "scene_count": 2, "spins": 3, "every_s": 0.2} | changes
    return LiveSource(load_town("grid"), Starting(), {"ego": RIG}, **values)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_a_drive_is_recorded_whole_by_any_number_of_processes(tmp_path: Path) -> None:
    for jobs in (1, 2):
        assert record(make_source(), tmp_path / f"jobs{jobs}", jobs=jobs)
    files = [
        {path.relative_to(tmp_path / name): sha256(path) for path in (tmp_path / name).rglob("*") if path.is_file()}
        for name in ("jobs1", "jobs2")
    ]
    assert files[0] == files[1]
    assert not validate(tmp_path / "jobs1")
    assert not record(make_source(), tmp_path / "jobs1")  # it is there


def test_frames_are_those_of_the_stepped_world() -> None:
    source = make_source()
    frames = list(source.frames(source.scenes()[1]))
    trace = source.trace(source.scenes()[1])
    assert trace is not None
    assert trace.time_s.tolist() == pytest.approx([0.5, 0.7, 0.9])
    ego = trace.actor.tolist().index("ego")
    for index, frame in enumerate(frames):
        assert frame.time_s == pytest.approx(trace.time_s[index])
        assert frame.world_from_agent[:2, 3] == pytest.approx(trace.position[index, ego, :2])
    speed = np.linalg.norm(trace.velocity[:, ego], axis=1)
    way = trace.position[2, ego, :2] - trace.position[0, ego, :2]
    assert (np.diff(speed) > 0).all()  # full of throttle, it gets faster
    assert way @ heading_vectors(trace.yaw[0, ego]) == pytest.approx(0.4 * speed.mean(), rel=0.05)


def test_scenes_have_traffic_of_their_own() -> None:
    source = make_source()
    one, other = (source.trace(scene) for scene in source.scenes() if list(source.frames(scene)))
    assert one is not None
    assert other is not None
    assert not np.array_equal(one.position[0], other.position[0])


@pytest.mark.parametrize("wrong", [{"every_s": 0.13}, {"first_s": 0.0}, {"spins": 0}])
def test_times_that_no_step_meets_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        make_source(**wrong)
