"""Pictures of a camera that stands still beside its static background, as a network of three channels sees them.

The background is the median of the camera's pictures in the same dataset, as that of a roadside LiDAR is learned from
its own sweeps.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.perception.agents import POLE, kind_of
from flcav.perception.images import Picture, check_picture

LEAST_PICTURES = 3  # of a camera: the median of fewer shows what moves, too
MOST_PICTURES = 40  # of each camera, evenly spread over the dataset, that its background is learned from
LUMA = np.array((0.299, 0.587, 0.114))  # ITU-R BT.601


def picture_reader(data: Dataset, background: bool) -> Callable[[int, str], Picture]:
    """Return the function that reads the picture of a frame's number and a camera as a network sees it.

    For a network of backgrounds (`background`) that is `compare_with_background`, of poles alone. Raises `InputError`
    as `check_picture`, `check_stands` and `learn_picture_background` do.
    """

    def read(number: int, camera: str) -> Picture:
        rgb = check_picture(data.plane(number, camera, "rgb"), f"{data.folder} {data.name(number)}")
        if not background:
            return rgb
        check_stands(data, [number])
        return compare_with_background(rgb, learn_picture_background(data, data.keys[number].agent, camera))

    return read


def check_stands(data: Dataset, numbers: Iterable[int]) -> None:
    """Raise `InputError` unless the agents of all these frames are poles: the camera of a vehicle has no background."""
    for agent in dict.fromkeys(data.keys[number].agent for number in numbers):
        if kind_of(agent) != POLE:
            raise InputError(
                f"{data.folder}: {agent} moves, and this network sees pictures of poles beside their background; "
                "choose them with --agents poles"
            )


def compare_with_background(picture: Picture, background: Picture) -> Picture:
    """Return (H, W, 3): luma of the picture, luma of the background, and the largest difference of a colour."""
    apart = np.abs(picture.astype(np.int16) - background).max(axis=2)
    return np.stack([picture @ LUMA, background @ LUMA, apart], axis=2).round().astype(np.uint8)


@lru_cache(maxsize=64)
def learn_picture_background(data: Dataset, agent: str, camera: str) -> NDArray[np.uint8]:
    """Return the median (H, W, 3) of an agent's pictures by one camera in `data`.

    Raises `InputError` where there are fewer than `LEAST_PICTURES`.
    """
    numbers = [number for number in data.select(agents={agent}) if camera in data.cameras(number)]
    if len(numbers) < LEAST_PICTURES:
        raise InputError(
            f"{data.folder}: {agent} has {len(numbers)} picture{'s' * (len(numbers) != 1)} by {camera}, and this "
            f"network's background is learned from {LEAST_PICTURES} or more; record more scenes or spins"
        )
    chosen = numbers[:: -(-len(numbers) // MOST_PICTURES)]
    return np.median([data.plane(number, camera, "rgb") for number in chosen], axis=0).astype(np.uint8)
