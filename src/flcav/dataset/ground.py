"""The ground of a dataset's scenes: its height below agents, and theirs above it."""

from functools import cached_property

import numpy as np

from flcav.dataset.store import Dataset
from flcav.world.map.relief import Relief
from flcav.world.map.town import Town

POLE = "pole"  # prefix of the names of roadside agents; all other agents are vehicles


class DatasetGround:
    """The ground of a dataset's scenes: that of its town, or, where no town is known, that below its vehicles."""

    def __init__(self, data: Dataset) -> None:
        self._data = data
        self._feet: dict[tuple[str, str], float] = {}  # scene, pole -> height of the ground

    @cached_property
    def town(self) -> Town | None:
        """Return the town of the dataset; None where it is not known."""
        return self._data.town()

    @property
    def relief(self) -> Relief | None:
        """Return the heights of the town; None where it is level, or not known."""
        return None if self.town is None else self.town.relief

    def below(self, i: int) -> float:
        """Return the height [m] of the ground below the agent of frame `i`, world frame.

        A vehicle's origin is on the ground. A pole stands on that of the town; where no town is known, as in an
        imported dataset, as high as its scene's vehicles where one comes nearest to it, and without any at 0.
        """
        key = self._data.keys[i]
        place = self._data.world_from_agent(i)[:3, 3]
        if not self._stands(i):
            return float(place[2])
        if self.town is not None:
            return self.town.ground(place[0], place[1])
        if (key.scene, key.agent) not in self._feet:
            vehicles = [j for j in self._data.select(scenes=[key.scene]) if not self._stands(j)]
            passed = np.array([self._data.world_from_agent(j)[:3, 3] for j in vehicles]).reshape(-1, 3)
            away = np.linalg.norm(passed[:, :2] - place[:2], axis=1)
            self._feet[key.scene, key.agent] = float(passed[away.argmin(), 2]) if len(passed) else 0.0
        return self._feet[key.scene, key.agent]

    def height_of(self, i: int) -> float:
        """Return how high [m] the origin of the agent of frame `i` is above the ground: 0 of a vehicle."""
        return float(self._data.world_from_agent(i)[2, 3]) - self.below(i) if self._stands(i) else 0.0

    def _stands(self, i: int) -> bool:
        return self._data.keys[i].agent.startswith(POLE)
