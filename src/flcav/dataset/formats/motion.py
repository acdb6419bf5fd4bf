"""How fast the agents of a scene move."""

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.store import Dataset


def agent_velocities(dataset: Dataset, scene: str) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Return (agent, spin) -> (3,) velocity, world [m/s]; zero of an agent that is not in the scene's traffic."""
    keys = [dataset.keys[i] for i in dataset.select(scenes=[scene])]
    velocities = {(key.agent, key.index): np.zeros(3) for key in keys}
    trace = dataset.trace(scene)
    if trace is None:
        return velocities
    actors = {name: a for a, name in enumerate(trace.actor.tolist())}
    for key in keys:
        if key.agent in actors:
            t = int(np.argmin(np.abs(trace.time_s - key.time_s)))
            velocities[key.agent, key.index] = trace.velocity[t, actors[key.agent]]
    return velocities
