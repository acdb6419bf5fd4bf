"""A federation of walkers on a fleet that is up: run_walkers.py FLEET CLIENTS ROUNDS LOG OUT."""

import sys
from pathlib import Path

import numpy as np
from fleet_clients import Walker

from flcav.federation.links.flower import Deployment
from flcav.federation.loop import Schedule, federate
from flcav.federation.strategies import strategy_named


def walk(runtime, count, rounds, log=None, lasts_s=0.0, **more):
    """Return the weights of a federation of `count` walkers by SCAFFOLD, whose clients keep arrays."""
    clients = {f"town/cav{number}": Walker(number + 1, log, lasts_s) for number in range(count)}
    weights = {"w": np.arange(500, dtype=np.float32)}
    schedule = Schedule(rounds, 2, 0.1, 0.05, 11)
    return federate(clients, weights, schedule, strategy=strategy_named("scaffold"), runtime=runtime, **more).weights


if __name__ == "__main__":
    fleet, count, rounds, log, out = sys.argv[1:]
    np.save(out, walk(Deployment(Path(fleet)), int(count), int(rounds), Path(log), 2.0)["w"])
