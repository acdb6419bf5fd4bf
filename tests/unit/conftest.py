from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flcav.world
from flcav.config import read_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.sensors.frame import Frame
from flcav.world.map.parameters import TownParameters
from flcav.world.map.town import Poles, Signs, Town
from flcav.world.shapes import SHAPES
from flcav.world.trace import Trace

Actor = tuple[str, str, int, float, float, float]  # id, category, shape, x, y, yaw
NONE = np.zeros((0, 6))


@dataclass(frozen=True)
class Once:
    """A source of one frame."""

    seen: Frame

    def describe(self) -> dict[str, Any]:
        return {"town": "none", "split": "test", "seed": 0}

    def scenes(self) -> list[str]:
        return [self.seen.scene]

    def frame_count(self, scene: str) -> int:
        return 1

    def frames(self, scene: str) -> Iterator[Frame]:
        yield self.seen

    def trace(self, scene: str) -> None:
        return None


@pytest.fixture(scope="session")
def recorded() -> Callable[[Frame, Path], Dataset]:
    """Record a frame into a folder, and open it."""

    def write(frame: Frame, out: Path) -> Dataset:
        record(Once(frame), out)
        return Dataset.open(out)

    return write


@pytest.fixture(scope="session")
def small_town() -> Callable[..., Town]:
    """A straight road along x, 14 m wide, with a sidewalk on its left; fields of the town can be replaced."""
    parameters = read_config(TownParameters, Path(flcav.world.__path__[0]) / "towns" / "suburb" / "town.yaml")
    town = Town(
        name="small",
        net=Path("small.net.xml"),
        parameters=parameters,
        bounds=(-60.0, -60.0, 60.0, 60.0),
        roads=(np.array([[-60.0, -7], [60, -7], [60, 7], [-60, 7]]),),
        sidewalks=(np.array([[-60.0, 7], [60, 7], [60, 10], [-60, 10]]),),
        kerbs=(np.array([[-60.0, 7], [60, 7]]),),
        buildings=NONE,
        trees=np.zeros((0, 4)),
        clutter=(),
        poles=Poles(np.array([4]), np.array([[5.0, -9.0, 6.0]]), np.array([np.pi / 2]), ("straight",)),
        signs=Signs(np.zeros((0, 3)), np.zeros(0), ()),
        lamps=np.zeros((0, 3)),
    )

    def build(**fields: Any) -> Town:
        return replace(town, **fields)

    return build


@pytest.fixture(scope="session")
def standing() -> Callable[..., Trace]:
    """A trace of actors that stand still for some instants."""

    def build(actors: Sequence[Actor], instants: int = 1) -> Trace:
        shape = (instants, len(actors))
        position = np.array([[x, y, 0.0] for *_, x, y, _ in actors]).reshape(-1, 3)
        return Trace(
            town="small",
            time_s=np.arange(instants, dtype=np.float64) / 10,
            actor=np.array([actor[0] for actor in actors], dtype=np.str_),
            category=np.array([actor[1] for actor in actors], dtype=np.str_),
            shape=np.array([actor[2] for actor in actors], dtype=np.int64),
            size=np.array([SHAPES[actor[1]][actor[2]][1:] for actor in actors]).reshape(-1, 3),
            present=np.ones(shape, dtype=bool),
            position=np.broadcast_to(position, (*shape, 3)).copy(),
            yaw=np.broadcast_to([actor[5] for actor in actors], shape).astype(float),
            velocity=np.zeros((*shape, 3)),
            acceleration=np.zeros((*shape, 3)),
            yaw_rate=np.zeros(shape),
            light=np.zeros(0, dtype=np.str_),
            light_state=np.zeros((instants, 0), dtype=np.str_),
        )

    return build
