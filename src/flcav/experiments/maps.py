"""OpenDRIVE maps of the package as towns of experiments."""

from pathlib import Path

from flcav.sources.recipe import recipe_path
from flcav.world.opendrive.importing import import_town


def import_map(name: str, folder: Path) -> None:
    """Import recipes/maps/NAME.xodr as the town `folder`/NAME, unless it is there."""
    if not (folder / name).exists():
        import_town(recipe_path("runs/placement").parents[1] / "maps" / f"{name}.xodr", folder / name)
