"""Predictions for the frames of a dataset, as JSON knows them, on the map around who observes."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.layout import read_manifest
from flcav.dataset.store import Dataset
from flcav.geometry import pose, yaw_of
from flcav.perception.marks import Light, Mode, Paths, RoadUser
from flcav.perception.task import Finding, of_frames
from flcav.perception.trajectory.config import FUTURE, STEP_S
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import predict, single
from flcav.perception.trajectory.rasters import OPEN
from flcav.perception.trajectory.roads import STATIC_ROWS, RoadMap, roads_of
from flcav.perception.trajectory.samples import Samples, present_at, seen_from, traffic
from flcav.perception.trajectory.tracks import constant_velocity, into_frame, out_of_frame
from flcav.world.lanes import rasterise
from flcav.world.trace import Trace

Array = NDArray[np.float64]

AROUND_M = 50.0  # of the observing agent, ahead, behind and to both sides: shown, and predicted with rasters
PIXEL_M = 0.2  # of the map that is shown
TIMES_S = tuple((STEP_S * np.arange(1, FUTURE + 1)).tolist())


def findings(network: TrajectoryNetwork, path: Path, frames: Sequence[int] | None = None) -> Iterator[Finding]:
    """Yield what is predicted in `frames` of the dataset `path` (None: all); raises `InputError` for anything else.

    The result is in the world's frame: {"time_s": [...], "observer": {"x", "y", "yaw"}, "lights": [{"x", "y",
    "open"}], "agents": [{"track", "class", "x", "y", "yaw", "speed", "length", "width", "modes": [{"probability",
    "path": [[x, y], ...]}], "constant_velocity": [...], "truth": [...] or None}]}. The first mode is the one for who
    wants a single one, the others come by probability. It is shown on the map around the observer, (len(STATIC), H, W),
    row 0 ahead of it and column 0 to its left. Frames whose vehicles have no past of 2 s yet have no agents.
    """
    read_manifest(path)
    data = Dataset.open(path)
    traces: dict[str, Trace] = {}
    for number in of_frames(data, frames):
        key = data.keys[number]
        if key.scene not in traces:
            traces = {key.scene: traffic(data, key.scene)}
        trace = traces[key.scene]
        world_from_agent = data.frame(number).world_from_agent
        observer = np.array([*world_from_agent[:2, 3], yaw_of(world_from_agent)])
        found = _predicted(network, data, number, trace, observer)
        yield Finding(path / data.name(number), map_around(roads_of(data), observer), paths_as_json(found), (found,))


def paths_as_json(paths: Paths) -> dict[str, Any]:
    """Return predicted paths as JSON knows them, see `findings`."""
    return {
        "time_s": list(paths.times_s),
        "observer": dict(zip(("x", "y", "yaw"), paths.observer)),
        "lights": [asdict(light) for light in paths.lights],
        "agents": [_user_as_json(user) for user in paths.users],
    }


def _user_as_json(user: RoadUser) -> dict[str, Any]:
    return {
        **{"track": user.track, "class": user.label, "x": user.x, "y": user.y, "yaw": user.yaw, "speed": user.speed},
        **{"length": user.length, "width": user.width},
        "modes": [{"probability": mode.probability, "path": mode.path.tolist()} for mode in user.modes],
        "constant_velocity": None if user.constant_velocity is None else user.constant_velocity.tolist(),
        "truth": None if user.truth is None else user.truth.tolist(),
    }


def map_around(roads: RoadMap, observer: Array) -> NDArray[np.bool_]:
    """Return (len(STATIC), H, W) the map within `AROUND_M` of x, y, yaw."""
    middle = pose(float(observer[0]), float(observer[1]), yaw=float(observer[2]))
    return rasterise(roads.layers, middle, (2 * AROUND_M, 2 * AROUND_M), PIXEL_M)[list(STATIC_ROWS)]


def _predicted(network: TrajectoryNetwork, data: Dataset, number: int, trace: Trace, observer: Array) -> Paths:
    key, config = data.keys[number], network.config
    instant = int(np.argmin(np.abs(trace.time_s - key.time_s)))
    if config.cameras:
        wanted = seen_from(trace, key)
    else:
        apart = into_frame(trace.position[None, instant, :, :2], observer[None])[0]
        wanted = (np.abs(apart) <= AROUND_M).all(axis=1)
    columns = present_at(trace, key.time_s, roads_of(data), config.patch, wanted, complete=False)
    count = len(columns["past"])
    columns |= {"scene": np.full(count, key.scene), "frame": np.full(count, number)}
    users: list[RoadUser] = []
    if count:
        paths, probabilities = predict(network, Samples(data, columns, config.cameras))
        first = single(paths, probabilities)
        present, plain = columns["pose"], constant_velocity(columns["past"])
        for i, actor in enumerate(columns["actor"]):
            modes = [Mode(float(share), _in_world(way, present[i])) for share, way in zip(probabilities[i], paths[i])]
            truth = columns["future"][i].astype(np.float64)
            users.append(
                RoadUser(
                    str(trace.actor[actor]),
                    str(trace.category[actor]),
                    *present[i].tolist(),
                    speed=float(columns["past"][i, -1, 3]),
                    length=float(trace.size[actor, 0]),
                    width=float(trace.size[actor, 1]),
                    modes=(modes.pop(first[i]), *sorted(modes, key=lambda mode: -mode.probability)),
                    constant_velocity=_in_world(plain[i], present[i]),
                    truth=_in_world(truth, present[i]) if np.isfinite(truth).all() else None,
                )
            )
    x, y, yaw = observer.tolist()
    return Paths((x, y, yaw), AROUND_M, TIMES_S, tuple(users), _lights(trace, instant, roads_of(data)))


def _lights(trace: Trace, instant: int, roads: RoadMap) -> tuple[Light, ...]:
    letters = dict(zip(trace.light.tolist(), trace.light_state[instant].tolist()))
    middles = {name: bar.mean(axis=0).tolist() for name, bar in roads.lights.items() if name in letters}
    return tuple(Light(x, y, letters[name] in OPEN) for name, (x, y) in middles.items())


def _in_world(path: Array, present: Array) -> Array:
    return out_of_frame(path[None], present[None])[0]
