"""Road average of many agents over a window of spins, in one thread."""

import argparse
import json

import numpy as np
from cpu_time import cpu_ms

from flcav.fusion.average import BoxReport, average_boxes
from flcav.geometry import Boxes

AGENTS, OBJECTS, SPINS, EVERY_S = 10, 50, 10, 0.1
SIGMA = np.array((0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.05))


def draw_window(seed: int) -> list[BoxReport]:
    """Return what `AGENTS` agents tell of the same `OBJECTS` moving objects in each of `SPINS` spins."""
    rng = np.random.default_rng(seed)
    place, velocity = rng.uniform(-200, 200, (OBJECTS, 2)), rng.normal(0, 5, (OBJECTS, 2))
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
    told = []
    for spin in range(SPINS):
        for agent in range(AGENTS):
            xy = place + velocity * spin * EVERY_S
            rows = np.column_stack((xy, np.full(OBJECTS, 0.8), np.tile((4.4, 1.8, 1.6), (OBJECTS, 1)), yaw))
            rows += rng.normal(0, 1, rows.shape) * SIGMA
            boxes = Boxes(
                rows[:, :3],
                rows[:, 3:6],
                rows[:, 6],
                np.full(OBJECTS, "car"),
                np.full(OBJECTS, 0.8),
                np.tile(SIGMA**2, (OBJECTS, 1)),
            )
            told.append(BoxReport(f"agent{agent}", spin * EVERY_S, boxes))
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    told = draw_window(arguments.seed)
    (ms,) = cpu_ms((lambda: average_boxes(told, (SPINS - 1) * EVERY_S),), repeats=5)
    if arguments.json:
        print(json.dumps({"average_ms": ms}))
        return
    print(f"{AGENTS} agents x {OBJECTS} boxes x {SPINS} spins: {ms:.1f} CPU-ms")


if __name__ == "__main__":
    main()
