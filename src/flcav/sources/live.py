"""A live world as a source of frames: closed-loop drives of a planner, observed by its vehicles' sensors."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from flcav.config import InputError, Json
from flcav.sensors.frame import Frame
from flcav.sensors.observe import observe
from flcav.sensors.rig import Rig
from flcav.sources.embedded import check_mounts
from flcav.statistics.streams import derive_seed
from flcav.world.commands import Controls
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.town import Town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot, join_snapshots
from flcav.world.trace import Trace
from flcav.world.weather import WEATHERS, Weather


class Driver(Protocol):
    """A planner that spawns its vehicles in a world and drives them. Recording in several processes pickles it."""

    def describe(self) -> Mapping[str, Json]:
        """Return what determines its driving, as JSON values: equal descriptions mean equal driving."""
        ...

    def begin(self, world: LiveWorld) -> None:
        """Spawn the vehicles in a world that has just begun, and discard any state of earlier worlds."""
        ...

    def drive(self, now: Snapshot) -> Mapping[str, Controls]:
        """Return the controls of the vehicles until the next step, by name; a missing vehicle keeps its last ones."""
        ...


@dataclass
class LiveSource:
    """A source of the frames of a planner's drives: every scene is a separate live world, observed at regular times.

    The vehicles named in `rigs` must exist at every spin. Raises `InputError` for numbers that are not positive, a
    time between spins that is not a multiple of the world's step, and a sensor below the ground.
    """

    town: Town
    driver: Driver
    rigs: Mapping[str, Rig]  # vehicle under control -> its sensors
    settings: Settings
    scene_count: int = 1
    spins: int = 10
    every_s: float = 0.5  # time between spins [s]
    first_s: float = 0.5  # time of the first spin [s]
    split: str = "train"
    weather: Weather = WEATHERS["clear"]
    _traces: dict[str, Trace] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if min(self.scene_count, self.spins) < 1 or not self.rigs:
            raise InputError("a live recording needs a scene, a spin and a vehicle with sensors, at least one of each")
        for name, time_s in (("every_s", self.every_s), ("first_s", self.first_s)):
            steps = time_s / self.settings.dt_s
            if steps < 1 or abs(steps - round(steps)) > 1e-6:
                raise InputError(f"{name} = {time_s}: must be a multiple of the step, {self.settings.dt_s} s")
        for name, rig in self.rigs.items():
            check_mounts(f"rigs.{name}", rig, "a vehicle", 0.0)

    def describe(self) -> Mapping[str, Json]:
        """Return what determines the frames as JSON values."""
        return {
            "source": "live",
            "town": self.town.name,
            "seed": self.settings.seed,
            "split": self.split,
            "scenes": self.scene_count,
            "spins_per_scene": self.spins,
            "every_s": self.every_s,
            "first_s": self.first_s,
            "step_s": self.settings.dt_s,
            "traffic": self.settings.traffic,
            "pedestrians": self.settings.pedestrians,
            "parked": self.settings.parked,
            "weather": self.weather.model_dump(mode="json"),
            "rigs": {name: rig.model_dump(mode="json") for name, rig in self.rigs.items()},
            "driver": dict(self.driver.describe()),
        }

    def scenes(self) -> list[str]:
        """Return the names of the scenes, `<town>-live-<seed>-<number>`."""
        return [f"{self.town.name}-live-{self.settings.seed}-{scene:03d}" for scene in range(self.scene_count)]

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene."""
        return self.spins * len(self.rigs)

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the frames of a scene while its world runs, by spin, and within a spin by vehicle.

        Raises `InputError` where a vehicle does not exist, `RuntimeError` where SUMO fails.
        """
        seed = derive_seed(self.settings.seed, "live", self.scenes().index(scene))
        started = replace(self.settings, seed=seed, remembers=False)
        seen: list[Snapshot] = []
        with LiveWorld(self.town, started) as world:
            self.driver.begin(world)
            view = Scene(self.town, world.snapshot.trace)
            for spin in range(self.spins):
                for _ in range(round((self.every_s if spin else self.first_s) / started.dt_s)):
                    world.step(self.driver.drive(world.snapshot))
                seen.append(now := world.snapshot)
                view.follow(now.trace)
                for name, rig in self.rigs.items():
                    yield observe(
                        *(view, rig, name, 0),
                        scene_name=scene,
                        seed=self.settings.seed,
                        weather=self.weather,
                        number=spin,
                    )
        self._traces = {scene: join_snapshots(seen)}

    def trace(self, scene: str) -> Trace | None:
        """Return the traffic at the spins of the scene that was read last, and None for others."""
        return self._traces.get(scene)
