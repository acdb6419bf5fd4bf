"""Recorded traffic: the states of a run at some of its steps."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.traffic.simulation import Simulation, States


class Recorded(NamedTuple):
    """The states of A actors and the letters of J lights' links at T instants."""

    id: NDArray[np.str_]  # (A,)
    type: NDArray[np.str_]  # (A,) SUMO's
    state: NDArray[np.float64]  # (T, A, 4) SUMO's front x, y [m], angle [deg], speed [m/s]; NaN where absent
    light: NDArray[np.str_]  # (J,)
    light_state: NDArray[np.str_]  # (T, J)
    events: NDArray[np.str_]  # () scenarios that took place, as JSON


def record(simulation: Simulation, steps: Sequence[int], out: Path) -> None:
    """Make the steps up to the last of `steps` (T,), ascending, and write what is `Recorded` at these into `out`."""
    lights, director = simulation.sumo.trafficlight, simulation.director
    junctions, now = lights.getIDList(), 0
    seen: list[States] = []
    letters: list[list[str]] = []
    for step in steps:
        while now < step:
            simulation.advance()
            now += 1
        seen.append(simulation.states())
        letters.append([lights.getRedYellowGreenState(junction) for junction in junctions])
    if director:
        for states, step in zip(seen, steps):  # only now, since a script may place a prop at earlier steps
            states |= {name: (kind, *state) for name, kind, state in director.props(step)}
    kinds = {name: each[0] for states in seen for name, each in states.items()}
    column = {name: i for i, name in enumerate(kinds)}
    state = np.full((len(steps), len(kinds), 4), np.nan)
    for row, states in zip(state, seen):
        row[[column[name] for name in states]] = np.array([each[1:] for each in states.values()]).reshape(-1, 4)
    recorded = Recorded(
        id=np.array(list(kinds), dtype=np.str_),
        type=np.array(list(kinds.values()), dtype=np.str_),
        state=state,
        light=np.array(junctions, dtype=np.str_),
        light_state=np.array(letters, dtype=np.str_).reshape(len(steps), len(junctions)),
        events=np.array(json.dumps([event._asdict() for event in director.events] if director else [])),
    )
    np.savez(out, **recorded._asdict())
