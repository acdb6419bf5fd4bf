"""The simulated world: town maps, traffic, scripted scenarios, weather, meshes, materials and ray casting."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.world.commands import Controls, Spawn
    from flcav.world.live import LiveWorld
    from flcav.world.map.town import TOWNS, Town, load_town
    from flcav.world.snapshot import Snapshot
    from flcav.world.trace import Trace

PLACES = {
    "Controls": "flcav.world.commands",
    "Spawn": "flcav.world.commands",
    "LiveWorld": "flcav.world.live",
    "TOWNS": "flcav.world.map.town",
    "Town": "flcav.world.map.town",
    "load_town": "flcav.world.map.town",
    "Snapshot": "flcav.world.snapshot",
    "Trace": "flcav.world.trace",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
