"""The built-in simulator as a source: SUMO traffic in a town, observed by simulated sensors."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import InputError, Json
from flcav.sensors.frame import Frame
from flcav.sensors.navigation_log import NavigationLog, log_drive
from flcav.sensors.observe import observe
from flcav.sensors.rig import Rig
from flcav.sources.randomisation import randomise_bodies, randomise_rig, randomise_town, town_files
from flcav.sources.recipe import DividedSource, Recipe
from flcav.statistics.streams import derive_seed, stream
from flcav.world.map.town import HEIGHTS, HILLS, HILLY, PACKAGED, Town, check_town_name, load_town
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.traffic.traffic import simulate_drives


class EmbeddedSource(DividedSource):
    """The built-in simulator as a `Replayable` source of a recipe's frames.

    The traffic of scene i depends on the town, the seed, the number of vehicles, the times of the spins and the
    scenarios, but not on the number of scenes.
    """

    def __init__(self, recipe: Recipe, beside: Path | None = None) -> None:
        """Load the town of `recipe`; a town's folder may also be relative to `beside`, the folder of the recipe file.

        Raises `InputError` where the town or a pole does not exist, there is neither a vehicle nor a pole to observe,
        a sensor is not mounted above the ground, or the town's name is too long for the names of frames.
        """
        self.recipe = recipe
        self.town = load_town(recipe.town, beside)
        if recipe.randomise is not None:
            self.town = randomise_town(self.town, stream(recipe.seed, "streets", self.town.name), recipe.randomise)
        if recipe.rare:
            drawn = self.town.parameters.model_copy(update={"rare": recipe.rare})
            self.town = replace(self.town, parameters=drawn)
        if recipe.worn_paint:
            worn = self.town.parameters.model_copy(update={"worn_paint": recipe.worn_paint})
            self.town = replace(self.town, parameters=worn)
        check_town_name(self.town.name)
        known = self.town.poles.id.tolist()
        self.poles = known if recipe.poles == "all" else list(recipe.poles)
        if unknown := [pole for pole in self.poles if pole not in known]:
            raise InputError(f"field 'poles' = {unknown[0]}: no pole of {self.town.name}, which has {known}")
        self.agents = [f"cav{i}" for i in range(recipe.cavs)] + [f"pole{pole}" for pole in self.poles]
        self.vehicle_rigs = [self._vehicle_rig(i) for i in range(recipe.cavs)]
        for rig in self.vehicle_rigs or [recipe.vehicle_rig]:
            check_mounts("vehicle_rig", rig, "a vehicle", 0.0)
        for pole in self.poles:
            x, y, z = self.town.poles.position[known.index(pole)].tolist()
            mount_m = z - self.town.ground(x, y)
            check_mounts("pole_rig", recipe.pole_rig, f"pole {pole}", mount_m)
        super().__init__(recipe, self.town.name, tuple(self.agents))
        self._last_traffic: tuple[str, Trace, Trace] | None = None
        self._last_scene: tuple[str, Scene] | None = None

    def describe(self) -> Mapping[str, Json]:
        """Return the recipe as JSON values with names resolved: pole numbers, rigs, hashes of the town's files."""
        fields = self.recipe.model_dump(mode="json")
        optional = {
            "randomise",
            "rare",
            "worn_paint",
            "window_s",
            "window_every_s",
            "window_range_m",
            "navigation_s",
        }  # left out where they are not asked for
        return {
            **{name: value for name, value in fields.items() if name not in optional or value},
            "town": self.town.name,
            "town_files": {name: hashlib.sha256(data).hexdigest() for name, data in self._files().items()},
            "scenes": len(self.scenes()),
            "frames": self.frame_total,
            "poles": self.poles,
        }

    def town_files(self) -> Mapping[str, bytes]:
        """Return the contents of the town's files by name; empty for a town that comes with flcav."""
        kept = self.recipe.town not in PACKAGED or self.recipe.randomise is not None
        return self._files() if kept else {}

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the scene's frames by spin, and within a spin those of the vehicles before those of the poles."""
        yield from self.replay(scene, self.trace(scene), range(self.frame_count(scene)))

    def replay(self, scene: str, trace: Trace, numbers: range) -> Iterator[Frame]:
        """Yield the scene's frames with the given `numbers`, observed in the traffic `trace`: see `Replayable`."""
        if self._last_scene is None or self._last_scene[0] != scene:
            self._last_scene = scene, Scene(self.town, trace)
        world = self._last_scene[1]
        recipe = self.recipe
        weather = recipe.weather.draw(stream(recipe.seed, scene, "weather"))
        for number in numbers:
            index, agent = divmod(number, len(self.agents))
            if not self._records(trace, index, agent):
                continue
            yield observe(
                world,
                self.vehicle_rigs[agent] if agent < recipe.cavs else recipe.pole_rig,
                self.agents[agent],
                index,
                scene_name=scene,
                seed=recipe.seed,
                weather=weather.at(float(trace.time_s[index] - trace.time_s[0])),
                error=recipe.calibration_error,
            )

    def _records(self, trace: Trace, index: int, agent: int) -> bool:
        """Return whether an agent records the spin `index`; with `window_range_m`, windows only near a pole."""
        near_m = self.recipe.window_range_m
        middles = self.recipe.find_middles(index)
        if near_m is None or not self.poles or index in middles:
            return True
        if agent >= self.recipe.cavs:
            return False
        sites = self.town.poles.position[np.isin(self.town.poles.id, self.poles), :2]
        places = trace.position[middles, trace.actor.tolist().index(self.agents[agent]), :2]
        return bool((np.linalg.norm(places[:, None] - sites, axis=2) <= near_m).any())

    def trace(self, scene: str) -> Trace:
        """Return the simulated traffic of the scene, sampled at the times of its spins."""
        return self._simulate(scene)[0]

    def navigation_logs(self, scene: str) -> Mapping[str, NavigationLog]:
        """Return the navigation log of each vehicle's drive in a scene, by name; empty without `navigation_s`."""
        if not self.recipe.navigation_s:
            return {}
        drives, about = self._simulate(scene)[1], {"scene": scene, "seed": self.recipe.seed}
        logs = {
            agent: log_drive(drives, agent, rig, self.town.geo, **about)
            for agent, rig in zip(self.agents, self.vehicle_rigs)
        }
        return {agent: log for agent, log in logs.items() if log is not None}

    def _simulate(self, scene: str) -> tuple[Trace, Trace]:
        """Return the traffic of the scene at its spins, and the densely sampled motion for the navigation logs."""
        if self._last_traffic is None or self._last_traffic[0] != scene:
            seed = derive_seed(self.recipe.seed, "traffic", self.scenes().index(scene))
            warmup = stream(self.recipe.seed, scene, "warmup").integers(*self.recipe.warmup_steps, endpoint=True)
            trace, drives = simulate_drives(
                self.town,
                seed=seed,
                cavs=self.recipe.cavs,
                times_s=self.recipe.times_s(int(warmup)),
                lead_s=self.recipe.navigation_s,
                scenarios=self.recipe.scenarios,
            )
            if self.recipe.randomise is not None:
                trace = randomise_bodies(trace, stream(self.recipe.seed, scene, "sizes"))
            self._last_traffic = scene, trace, drives
        return self._last_traffic[1:]

    def _vehicle_rig(self, number: int) -> Rig:
        """Return the rig of the vehicle "cav<number>"."""
        rig = self.recipe.rigs.get(f"cav{number}", self.recipe.vehicle_rig)
        if self.recipe.randomise is None:
            return rig
        return randomise_rig(rig, stream(self.recipe.seed, "rig", f"cav{number}"), self.recipe.randomise)

    def _files(self) -> Mapping[str, bytes]:
        """Return the contents of the files of the town, as drawn, by name."""
        if self.recipe.randomise is not None:
            return town_files(self.town)
        return read_town_files(self.town, self.recipe.town)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_last_traffic": None, "_last_scene": None}


def read_town_files(town: Town, name: str) -> Mapping[str, bytes]:
    """Return the contents of a town's files by file name; `name` is the town as the recipe names it."""
    heights = HILLS if name in HILLY else HEIGHTS
    names = ("town.yaml", *([] if town.relief is None else [heights]))
    paths = [town.net, *(town.net.parent / file for file in names)]
    return {path.name: path.read_bytes() for path in paths}


def check_mounts(field: str, rig: Rig, carrier: str, mount_m: float) -> None:
    """Raise `InputError` where a sensor of `rig` is not above the ground.

    The origin of the carrier's frame is `mount_m` above the ground. `field` is the recipe's field of the rig.
    """
    for name, sensor in rig.sensors().items():
        if mount_m + sensor.mount.z <= 0:
            raise InputError(
                f"field '{field}': sensor '{name}' at z = {sensor.mount.z} m is not above the ground on {carrier}, "
                f"whose frame is {mount_m:.1f} m up"
            )
