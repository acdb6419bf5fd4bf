"""Pedestrians who never move faster than people do.

SUMO's pedestrians (its "striping" model) hop: up to three stripes aside in one step, and from one end of a junction's
corner to the other where they wait for one crossing and another turns green. Here each hop is walked: who falls behind
follows the path SUMO's pedestrian took, at no more than `HURRY_MPS`, until caught up. Nothing of later steps is used.
"""

import math
from collections import deque
from collections.abc import Mapping

from flcav.world.scenarios.stage import State

HURRY_MPS = 2.5  # a jog; SUMO's pedestrians walk at no more than 1.7 m/s


class Walkers:
    """All pedestrians of a run, followed step by step."""

    def __init__(self, step_s: float) -> None:
        """Begin with nobody; steps last `step_s`."""
        self.states: dict[str, State] = {}  # of those there now, in SUMO's order
        self._step_s = step_s
        self._behind: dict[str, deque[tuple[float, float]]] = {}  # path that SUMO's pedestrian has walked alone

    def follow(self, targets: Mapping[str, State]) -> None:
        """Take a step in which SUMO's pedestrians come to `targets`, and those who are not in it leave."""
        self.states = {name: self._follow(name, target) for name, target in targets.items()}
        self._behind = {name: path for name, path in self._behind.items() if path and name in targets}

    def _follow(self, name: str, target: State) -> State:
        """Return `target`, or, if it is out of reach, a state on the way with angle and speed of the motion."""
        if name not in self.states:
            return target
        path = self._behind.setdefault(name, deque())
        path.append(target[:2])
        start_x, start_y = x, y = self.states[name][:2]
        left = HURRY_MPS * self._step_s
        while path:
            to_x, to_y = path[0]
            distance = math.hypot(to_x - x, to_y - y)
            if distance > left:
                x, y = x + (to_x - x) * left / distance, y + (to_y - y) * left / distance
                moved_x, moved_y = x - start_x, y - start_y
                return x, y, math.degrees(math.atan2(moved_x, moved_y)), math.hypot(moved_x, moved_y) / self._step_s
            left -= distance
            x, y = path.popleft()
        return target
