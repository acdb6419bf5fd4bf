"""Frames as a network sees them: of a roadside LiDAR the returns before its static background alone.

A pole's background is learned from its own sweeps of the same dataset.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

from flcav.dataset.store import Dataset
from flcav.perception.agents import POLE, kind_of
from flcav.sensors.frame import Frame
from flcav.sensors.lidar.background import Background, learn_background

MOST_SWEEPS = 100  # of each pole, evenly spread over the dataset, that its background is learned from


def frame_reader(data: Dataset, foreground: bool) -> Callable[[int], Frame]:
    """Return the function that reads a frame by its number as a network sees it.

    For a network of foregrounds (`foreground`), the sweeps of poles lack their background; other agents' are whole.
    """
    if not foreground:
        return data.frame

    def read(number: int) -> Frame:
        frame = data.frame(number)
        if kind_of(frame.agent) != POLE:
            return frame
        behind = pole_backgrounds(data, frame.agent)
        return replace(
            frame, lidar={name: points[behind[name].in_front(points)] for name, points in frame.lidar.items()}
        )

    return read


@lru_cache(maxsize=64)
def pole_backgrounds(data: Dataset, pole: str) -> dict[str, Background]:
    """Return the background of each LiDAR of a pole, by the LiDAR's name, learned from its sweeps in `data`."""
    numbers = data.select(agents={pole})
    sweeps = [data.frame(number).lidar for number in numbers[:: -(-len(numbers) // MOST_SWEEPS)]]
    names = sorted({name for sweep in sweeps for name in sweep})
    return {name: learn_background(sweep[name] for sweep in sweeps if name in sweep) for name in names}
