"""Rate of the closed loop: python benchmarks/bench_driving.py [SECONDS].

Printed is the rate of drives in the town `grid` among 25 vehicles and 8 pedestrians, as a multiple of real time: by
ground truth without sensors, with one LiDAR that is simulated at 10 Hz and not looked at, by the model of the
networks' errors, and by the networks. Each is the fastest block of 2 s, in turns, since other load only makes blocks
slower: of the wall clock, and beside it of the CPU time of this process, which lacks SUMO's.
"""

import sys
import time
from collections.abc import Callable

from flcav.driving.driver import decide_controls
from flcav.driving.errors import load_error_model, sense_model
from flcav.driving.loop import Sensing, find_motion, sense_truth
from flcav.driving.networks import sense_networks
from flcav.driving.scenarios import DT_S, StagedScenario, find_scenarios
from flcav.driving.seen import EGO, Perception, Seen
from flcav.machine.threads import use_threads
from flcav.sensors.observe import observe
from flcav.sensors.rig import lidar32
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot

BLOCK = 20  # steps
GOALS = {"truth": 5.0, "truth and one LiDAR": 1.0}


class Sweeping:
    """Ground truth beside a LiDAR that spins."""

    def __init__(self, staged: StagedScenario, seed: int) -> None:
        self._truth, self._scene = sense_truth(staged, seed), Scene(staged.town, staged.world.snapshot.trace)

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the truth, and simulate a sweep."""
        self._scene.follow(snapshot.trace)
        observe(self._scene, lidar32(), EGO, 0, scene_name="bench", seed=1, number=snapshot.step)
        return self._truth.look(snapshot)


def start(sense: Callable[[StagedScenario, int], Perception] | Sensing) -> Callable[[], None]:
    """Return a function that drives one block of a drive."""
    (scenario,) = find_scenarios(["grid-none-clear"])
    staged = StagedScenario(scenario, 1)
    perception, along = sense(staged, 1), staged.start_m
    body = staged.world.bodies.find(EGO).blueprint

    def block() -> None:
        nonlocal along
        for _ in range(BLOCK):
            now = staged.world.snapshot
            own = find_motion(now, staged.route, along)
            along = own.along
            staged.world.step({EGO: decide_controls(staged.route, own, perception.look(now), body).controls})

    return block


def main(seconds: float) -> None:
    """Print the rates."""
    use_threads(1)
    blocks = {
        "truth": start(sense_truth),
        "truth and one LiDAR": start(Sweeping),
        "model of errors": start(sense_model(load_error_model())),
        "networks": start(sense_networks),
    }
    wall, cpu = dict.fromkeys(blocks, float("inf")), dict.fromkeys(blocks, float("inf"))
    for turn in range(-1, max(round(seconds / (BLOCK * DT_S)), 1)):
        for name, block in blocks.items():
            begun, spent = time.perf_counter(), time.process_time()
            block()
            if turn >= 0:
                wall[name] = min(wall[name], time.perf_counter() - begun)
                cpu[name] = min(cpu[name], time.process_time() - spent)
    for name in blocks:
        rate, own = BLOCK * DT_S / wall[name], BLOCK * DT_S / cpu[name]
        goal = f", {rate / GOALS[name]:.1f} x the goal" if name in GOALS else ""
        print(f"{name}: {rate:.1f} x real time{goal}; {own:.1f} x by CPU time")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)
