"""Pedestrians of limited speed.

In SUMO's "striping" model they jump: up to three stripes aside in one step, and from one end of a junction's corner to
the other where they wait for one crossing and another turns green. Here a pedestrian who falls behind follows the path
of SUMO's pedestrian at no more than `HURRY_MPS` until caught up. Nothing of later steps is used.
"""

import math
from collections import deque
from collections.abc import Mapping

from flcav.world.scenarios.stage import State

HURRY_MPS = 2.5  # jogging speed; the pedestrians of the demand walk at no more than 1.7 m/s


class Walkers:
    """The pedestrians of a run, with limited speed: they follow SUMO's pedestrians step by step."""

    def __init__(self, step_s: float) -> None:
        """Start without pedestrians; `step_s` is the duration of a step [s]."""
        self.states: dict[str, State] = {}  # of those present now, in SUMO's order
        self._step_s = step_s
        self._behind: dict[str, deque[tuple[float, float]]] = {}  # path between a pedestrian and SUMO's

    def follow(self, targets: Mapping[str, State]) -> None:
        """Advance by one step, in which SUMO's pedestrians reach `targets`; those not among them leave."""
        self.states = {name: self._follow(name, target) for name, target in targets.items()}
        self._behind = {name: path for name, path in self._behind.items() if path and name in targets}

    def _follow(self, name: str, target: State) -> State:
        """Return `target`, or where it is out of reach the state on the path to it, with its own angle and speed."""
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
