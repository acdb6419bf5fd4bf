"""Time of a live world's step: python benchmarks/bench_live.py [STEPS].

Printed are the times of steps of .05 s in the town `grid`, with 50 vehicles of SUMO, with 50 under control, and with
both, each as a multiple of the time that SUMO alone takes for the same traffic in the same run, and of real time; and
the same with a LiDAR on one vehicle. Times are of the wall clock, since SUMO runs in another process: of the fastest
block of steps each, in turns, since other load only makes blocks slower.
"""

import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar32
from flcav.world.commands import Controls, Spawn
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.town import Town, load_town
from flcav.world.scenarios.stage import STEP_S
from flcav.world.scene import Scene
from flcav.world.traffic.live import write_live_job
from flcav.world.traffic.simulation import Simulation

TOWN = "grid"
VEHICLES = 50
DT_S = 0.05
BLOCK = 20  # steps


def start(town: Town, traffic: int, own: int) -> LiveWorld:
    """Return a world with `own` vehicles under control where there is room on the roads, each in a wide circle."""
    world = LiveWorld(town, Settings(seed=1, traffic=traffic, dt_s=DT_S))
    random = np.random.default_rng(0)
    while len(world.bodies.members) < own:
        road = town.roads[int(random.integers(len(town.roads)))]
        x, y = road.mean(axis=0) + random.uniform(-60, 60, 2)
        spawn = Spawn(f"own{len(world.bodies.members)}", "car", 3, float(x), float(y), float(random.uniform(-3, 3)))
        if not world.find_obstruction(spawn):
            world.apply(spawn)
    for body in world.bodies.members:
        body.controls = Controls(throttle=0.1, steer=0.2)
    return world


def run_alone(pipe: Connection, folder: str) -> None:
    """Run SUMO alone with the same traffic: so many seconds of it for each number that comes through the pipe."""
    import libsumo

    job = write_live_job(load_town(TOWN), Path(folder), seed=1, vehicles=VEHICLES, pedestrians=0)
    os.chdir(folder)
    sumo = Simulation(libsumo, job).sumo
    while (time_s := pipe.recv()) > 0:
        for _ in range(round(time_s / STEP_S)):
            sumo.simulationStep()
        pipe.send(True)


def main(steps: int) -> None:
    """Print the times."""
    town = load_town(TOWN)
    context = multiprocessing.get_context("spawn")
    pipe, other = context.Pipe()
    with (
        tempfile.TemporaryDirectory() as folder,
        start(town, VEHICLES, 0) as traffic,
        start(town, 0, VEHICLES) as own,
        start(town, VEHICLES, VEHICLES) as both,
        start(town, VEHICLES, 1) as seeing,
    ):
        alone = context.Process(target=run_alone, args=(other, folder), daemon=True)
        alone.start()
        scene, rig = Scene(town, seeing.snapshot.trace), lidar32()

        def step_alone() -> None:
            pipe.send(BLOCK * DT_S)
            pipe.recv()

        def see() -> None:
            snapshot = seeing.step()
            if snapshot.step % 2 == 0:  # the LiDAR spins at 10 Hz
                scene.follow(snapshot.trace)
                observe(scene, rig, "own0", 0, scene_name="live", seed=1, number=snapshot.step)

        def repeat(work: Callable[[], object]) -> Callable[[], None]:
            def block() -> None:
                for _ in range(BLOCK):
                    work()

            return block

        works: dict[str, Callable[[], None]] = {
            "SUMO alone": step_alone,
            f"{VEHICLES} of SUMO": repeat(traffic.step),
            f"{VEHICLES} under control": repeat(own.step),
            f"{VEHICLES} of SUMO and {VEHICLES} under control": repeat(both.step),
            f"{VEHICLES} of SUMO and a LiDAR at 10 Hz": repeat(see),
        }
        taken = np.zeros((max(2, steps // BLOCK), len(works)))
        for row in range(-1, len(taken)):
            for column, work in enumerate(works.values()):
                begun = time.perf_counter()
                work()
                taken[row, column] = (time.perf_counter() - begun) / BLOCK
        pipe.send(0.0)
        alone.join()
        fastest = taken.min(axis=0)
        for name, took in zip(works, fastest):
            share, real = took / fastest[0], DT_S / took
            print(f"{name}: {1e3 * took:.2f} ms a step, {share:.1f} x SUMO alone, {real:.0f} x real time")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
