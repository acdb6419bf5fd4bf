"""Couplings of perception tasks to driving: the driver's input when a task is left out.

Without `objects` nobody is seen, without `trajectory` everybody is taken to stand where they are, without `signs` no
light is known, and without `weather` the driver keeps to the limit in any: that is the *bare* coupling. In the
*cautious* one a task that lacks is made up for by slower driving, and tracks keep their velocity: a driver who knows
what is missing. How much the ranking of tasks depends on this choice is what the two show.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from flcav.driving.seen import TIMES_S, WEATHER_SPEED, Perception, Seen, predict_motion
from flcav.geometry import Boxes
from flcav.world.snapshot import Snapshot

Coupling = Literal["bare", "cautious"]

TASKS = ("objects", "trajectory", "signs", "weather")
SLOWER: Mapping[str, float] = {  # share of the limit in the cautious coupling
    "objects": 0.3,
    "trajectory": 1.0,
    "signs": 0.5,
    "weather": min(WEATHER_SPEED.values()),
}
FEEDS: Mapping[str, str] = {
    "objects": "boxes and velocities of road users: whom to follow and to brake for",
    "trajectory": "where they will be in the next four seconds: whom to let pass",
    "signs": "lights that are red or yellow: where to stop (signs of speed limits and stop signs feed nothing)",
    "weather": "the share of the speed limit: slower at night, in rain and in fog",
}


def leave_out(seen: Seen, task: str, coupling: Coupling) -> Seen:
    """Return the perceived surroundings without the output of a task."""
    if task == "objects":
        none = np.zeros((0, len(TIMES_S)))
        seen = replace(
            seen,
            boxes=Boxes.empty(),
            velocity=np.zeros((0, 2)),
            path=np.zeros((0, len(TIMES_S), 2)),
            yaw=none,
            spread=none,
        )
    elif task == "trajectory":
        moving = seen.velocity if coupling == "cautious" else np.zeros_like(seen.velocity)
        path, yaw = predict_motion(seen.boxes, moving)
        seen = replace(seen, path=path, yaw=yaw)
    elif task == "signs":
        seen = replace(seen, closed=frozenset(), amber=frozenset())
    else:
        seen = replace(seen, speed_share=1.0)
    if coupling == "cautious":
        seen = replace(seen, speed_share=min(seen.speed_share, SLOWER[task]))
    return seen


@dataclass(frozen=True)
class Without:
    """Perception without a task."""

    whole: Perception
    task: str  # one of `TASKS`
    coupling: Coupling

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the surroundings as the complete perception has them, less the output of the task."""
        return leave_out(self.whole.look(snapshot), self.task, self.coupling)
