"""Selection of a dataset's frames by agent, and frames as a network sees them.

Frames are selected by agent: all, vehicles, poles (roadside units), or agents by name. Of a roadside LiDAR some
networks see only the returns in front of the static background, which is learned from the pole's sweeps in the dataset.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from flcav.config import InputError, Json
from flcav.dataset.ground import POLE
from flcav.dataset.store import Dataset
from flcav.perception.task import ConfigT, KnownLidar, KnowsRig, NetworkT, RigBound, SampleT, Task
from flcav.sensors.frame import Frame
from flcav.sensors.lidar.background import Background, learn_background


@dataclass(frozen=True)
class FrameSelection:
    """The selected frames of a dataset, and counts of the selected and of the other frames."""

    frames: tuple[int, ...]  # frame numbers
    agents: tuple[str, ...]  # names of their agents, in the order of the frames
    used: Mapping[str, int]  # kind of agent, vehicle or pole -> number of selected frames
    left_out: Mapping[str, int]  # the same for the frames that are not selected
    rig: str = ""  # how their sensors differ from those that the network was trained with; "" where they do not

    @property
    def sentence(self) -> str:
        """Return the counts in words: "24 vehicle frames (8 pole frames left out)"."""
        left = f" ({_frames(self.left_out)} left out)" if self.left_out else ""
        return _frames(self.used) + left + (f"; {self.rig}" if self.rig else "")

    def summary(self) -> dict[str, Json]:
        """Return the agents and the counts of selected frames as JSON values, and `rig` where the sensors differ."""
        counts = {"agents": list(self.agents), "used": dict(self.used), "left_out": dict(self.left_out)}
        return counts | ({"rig": self.rig} if self.rig else {})


def choose_frames(
    task: Task[ConfigT, NetworkT, SampleT],
    config: ConfigT | None,
    data: Dataset,
    wanted: str | None = None,
    *,
    trained: KnownLidar | None = None,
) -> FrameSelection:
    """Select the frames of the agents `wanted`: "all", "vehicles", "poles" or names, separated by commas.

    None selects the frames whose sensors are mounted as a network of `config` expects them (`RigBound.fitting`), or all
    frames if the task is not bound to a rig. `trained` is the LiDAR that the network was trained with, None where it is
    unknown. Raises `InputError` for an agent that the dataset lacks, and what `RigBound.fitting` raises.
    """
    if wanted is not None:
        frames = data.select(agents=_agents(data, wanted))
    else:
        frames = task.fitting(data, config) if isinstance(task, RigBound) else range(len(data))
    every, selected = ([data.keys[i].agent for i in numbers] for numbers in (range(len(data)), frames))
    used = Counter(map(kind_of, selected))
    rig = task.compare_rig(data, config, frames, trained or KnownLidar()) if isinstance(task, KnowsRig) else ""
    return FrameSelection(tuple(frames), tuple(dict.fromkeys(selected)), used, Counter(map(kind_of, every)) - used, rig)


def kind_of(agent: str) -> str:
    """Return the kind of an agent by its name: "vehicle" or "pole"."""
    return POLE if agent.startswith(POLE) else "vehicle"


def _agents(data: Dataset, wanted: str) -> set[str]:
    known = list(dict.fromkeys(key.agent for key in data.keys))
    groups = {"all": known} | {f"{kind}s": [a for a in known if kind_of(a) == kind] for kind in ("vehicle", POLE)}
    agents: set[str] = set()
    for name in wanted.split(","):
        members = groups.get(name, [name] if name in known else [])
        if not members:
            raise InputError(f"agents '{wanted}': {data.folder} has none called '{name}', but {', '.join(known)}")
        agents.update(members)
    return agents


def _frames(counts: Mapping[str, int]) -> str:
    noun = "frame" if sum(counts.values()) == 1 else "frames"
    return f"{' and '.join(f'{count} {kind}' for kind, count in counts.items())} {noun}"


MOST_SWEEPS = 100  # sweeps per pole, evenly spread over the dataset, from which its background is learned


def frame_reader(data: Dataset, foreground: bool) -> Callable[[int], Frame]:
    """Return the function that reads a frame by its number as a network sees it.

    For a network of foregrounds (`foreground`), the sweeps of poles lack their background; those of others are
    complete.
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
