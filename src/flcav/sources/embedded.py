"""The built-in simulator as a source: SUMO traffic in one of our towns, seen by our sensors."""

from collections.abc import Iterator
from typing import Any

from flcav.config import InputError
from flcav.files import sha256
from flcav.seeds import child_seed
from flcav.sensors.frame import Frame
from flcav.sensors.observe import observe
from flcav.sources.recipe import Recipe
from flcav.world.scene import Scene
from flcav.world.town import load_town
from flcav.world.trace import Trace
from flcav.world.traffic import simulate


class EmbeddedSource:
    """The frames of a recipe. Scene i has the same traffic whatever the number of scenes, agents apart."""

    def __init__(self, recipe: Recipe) -> None:
        """Load the town; raises `InputError` where it, one of the poles or an observer is missing."""
        self.recipe = recipe
        self.town = load_town(recipe.town)
        known = self.town.poles.id.tolist()
        self.poles = known if recipe.poles == "all" else list(recipe.poles)
        if unknown := [pole for pole in self.poles if pole not in known]:
            raise InputError(f"field 'poles' = {unknown[0]}: no pole of {self.town.name}, which has {known}")
        self.agents = [f"cav{i}" for i in range(recipe.cavs)] + [f"pole{pole}" for pole in self.poles]
        if not self.agents:
            raise InputError("fields 'cavs' = 0 and 'poles' = []: nobody observes; give at least one of them")
        self._per_scene = recipe.spins_per_scene * len(self.agents)
        self._frames = recipe.frames or recipe.scenes * self._per_scene
        self._last: tuple[str, Trace] | None = None

    def describe(self) -> dict[str, Any]:
        """Return the recipe with every name resolved: the poles, the rigs, what the town was built from."""
        folder = self.town.net.parent
        return {
            **self.recipe.model_dump(mode="json"),
            "town": self.town.name,
            "town_files": {path.name: sha256(path) for path in (self.town.net, folder / "town.yaml")},
            "scenes": len(self.scenes()),
            "frames": self._frames,
            "poles": self.poles,
        }

    def scenes(self) -> list[str]:
        """Return the names of the scenes: town, seed and number, so that no two runs share a name."""
        count = -(-self._frames // self._per_scene)
        return [f"{self.town.name}-{self.recipe.seed}-{scene:03d}" for scene in range(count)]

    def frame_count(self, scene: str) -> int:
        """Return how many frames `frames(scene)` yields: fewer in the last scene where the recipe limits frames."""
        return min(self._per_scene, self._frames - self.scenes().index(scene) * self._per_scene)

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the scene's frames: spin after spin, the vehicles of each before its poles."""
        world = Scene(self.town, self.trace(scene))
        for number in range(self.frame_count(scene)):
            index, agent = divmod(number, len(self.agents))
            name = self.agents[agent]
            rig = self.recipe.vehicle_rig if agent < self.recipe.cavs else self.recipe.pole_rig
            yield observe(world, rig, name, index, scene_name=scene, seed=self.recipe.seed)

    def trace(self, scene: str) -> Trace:
        """Return the scene's traffic at the times of its spins."""
        if self._last is None or self._last[0] != scene:
            seed = child_seed(self.recipe.seed, "traffic", self.scenes().index(scene))
            trace = simulate(self.town, seed=seed, cavs=self.recipe.cavs, times_s=self.recipe.times_s())
            self._last = scene, trace
        return self._last[1]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_last": None}
