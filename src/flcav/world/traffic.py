"""Traffic of a town by SUMO: everything that moves, and what is parked beside it, as a `Trace`."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import wrap_angle
from flcav.seeds import child_seed, stream
from flcav.world.demand import types, write_demand
from flcav.world.parking import Parked, park
from flcav.world.roads import read_net
from flcav.world.shapes import SHAPES
from flcav.world.sumo_process import STEP_S
from flcav.world.town import Town
from flcav.world.trace import Trace

Array = NDArray[np.float64]

FILL_S = 30.0  # everybody is under way by then


def simulate(town: Town, *, seed: int, cavs: int, times_s: NDArray) -> Trace:
    """Return the traffic of `town` at `times_s` (T,): ascending multiples of 0.1 s after an empty town's time 0.

    Actors are "cav<i>" (sedans, under way from the start), "veh<i>", "ped<i>" and "parked<i>"; those absent at all of
    `times_s` are left out. Before `FILL_S` the town is still filling. The same arguments give the same trace.
    Raises `ValueError` for other times or a negative number of CAVs.
    """
    steps = np.rint(np.asarray(times_s, dtype=np.float64) / STEP_S).astype(np.int64)
    if not len(steps) or not np.allclose(steps * STEP_S, times_s, atol=1e-6) or (np.diff(steps, prepend=0) <= 0).any():
        raise ValueError("times_s must be ascending multiples of 0.1 s above 0")
    if cavs < 0:
        raise ValueError(f"cavs is {cavs}, must be >= 0")
    net = read_net(town.net)
    demand = write_demand(net, town.parameters, seed=seed, cavs=cavs, until_s=float(steps[-1] * STEP_S), fill_s=FILL_S)
    raw = _run(town.net, demand, child_seed(seed, "sumo"), steps)
    return _trace(town.name, steps * STEP_S, raw, park(net, town.parameters, stream(seed, "parked")))


def _run(net: Path, demand: str, seed: int, steps: NDArray[np.int64]) -> dict[str, NDArray]:
    with tempfile.TemporaryDirectory(prefix="flcav_traffic_") as name:
        folder = Path(name)
        routes, job, out = folder / "routes.rou.xml", folder / "job.json", folder / "out.npz"
        routes.write_text(demand, encoding="utf-8")
        job.write_text(json.dumps({"net": str(net), "routes": str(routes), "seed": seed, "steps": steps.tolist()}))
        command = [sys.executable, "-m", "flcav.world.sumo_process", str(job), str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"SUMO failed on {net}: {(done.stderr or done.stdout).strip()[-500:]}")
        with np.load(out) as arrays:
            return dict(arrays)


def _trace(town: str, time_s: Array, raw: dict[str, NDArray], parked: list[Parked]) -> Trace:
    order = sorted(range(len(raw["id"])), key=lambda i: _natural(str(raw["id"][i])))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    known = {name: (category, shape) for name, category, shape in types()}
    kinds = [known[str(raw["type"][i])] for i in order] + [(car.category, car.shape) for car in parked]
    moving, actors = len(order), len(kinds)
    size = np.array([SHAPES[category][shape][1:] for category, shape in kinds], dtype=np.float64).reshape(-1, 3)

    position = np.full((len(time_s), actors, 3), np.nan)
    yaw = np.full((len(time_s), actors), np.nan)
    velocity = np.full((len(time_s), actors, 3), np.nan)
    at = (raw["row"][:, 0], rank[raw["row"][:, 1]])
    position[at], yaw[at], velocity[at] = _poses(raw["state"], size[at[1], 0])
    position[:, moving:] = np.array([(car.x, car.y, 0.0) for car in parked]).reshape(-1, 3)
    yaw[:, moving:] = [car.yaw for car in parked]
    velocity[:, moving:] = 0.0

    lights = [(light, len(letters)) for light, letters in zip(raw["light"], raw["light_state"][0])]
    return Trace(
        town=town,
        time_s=np.round(time_s, 1),
        actor=np.array([str(raw["id"][i]) for i in order] + [f"parked{i}" for i in range(len(parked))], dtype=np.str_),
        category=np.array([category for category, _ in kinds], dtype=np.str_),
        shape=np.array([shape for _, shape in kinds], dtype=np.int64),
        size=size,
        present=~np.isnan(yaw),
        position=position,
        yaw=yaw,
        velocity=velocity,
        light=np.array([f"{light}:{i}" for light, links in lights for i in range(links)], dtype=np.str_),
        light_state=np.array([list("".join(letters)) for letters in raw["light_state"]], dtype="<U1").reshape(
            len(time_s), sum(links for _, links in lights)
        ),
    )


def _poses(state: Array, length: Array) -> tuple[Array, Array, Array]:
    """Return ground centres (N, 3), yaws (N,) and velocities (N, 3) from SUMO's x, y of the front, angle, speed."""
    yaw = wrap_angle(np.pi / 2 - np.radians(state[:, 2]))
    forward = np.stack((np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))), axis=1)
    front = np.concatenate((state[:, :2], np.zeros((len(state), 1))), axis=1)
    return front - length[:, None] / 2 * forward, yaw, state[:, 3, None] * forward


def _natural(name: str) -> tuple[str, int]:
    kind = name.rstrip("0123456789")
    return kind, int(name[len(kind) :])
