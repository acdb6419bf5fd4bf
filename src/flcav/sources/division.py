"""Division of a recipe's frames into scenes."""

from flcav.config import InputError, shorten
from flcav.sensors.frame import LONGEST_NAME, format_key
from flcav.sources.recipe import Recipe


class Division:
    """The scenes of a recipe in a town, and their numbers of frames: of all agents at all spins of a scene."""

    def __init__(self, recipe: Recipe, town: str, agents: tuple[str, ...]) -> None:
        """Raises `InputError` where nobody observes, or the town's name is too long for the names of frames."""
        if not agents:
            raise InputError("fields 'cavs' = 0 and 'poles' = []: nobody observes; give at least one of them")
        self._name = f"{town}-{recipe.seed}"
        self._per_scene = recipe.spins * len(agents)
        self.frames = recipe.frames or recipe.scenes * self._per_scene
        longest = max((format_key(self.scenes()[-1], recipe.spins - 1, one) for one in agents), key=len)
        if len(longest) > LONGEST_NAME:
            raise InputError(
                f"field 'town' = {shorten(recipe.town)}: a frame would be called {shorten(longest)}, {len(longest)} "
                f"characters where {LONGEST_NAME} are allowed; give the town's folder a shorter name"
            )

    def scenes(self) -> list[str]:
        """Return the names of the scenes, `<town>-<seed>-<number>`."""
        return [f"{self._name}-{scene:03d}" for scene in range(-(-self.frames // self._per_scene))]

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene; the last scene has fewer where the recipe limits frames."""
        return min(self._per_scene, self.frames - self.scenes().index(scene) * self._per_scene)
