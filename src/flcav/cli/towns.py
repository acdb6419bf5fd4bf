"""`flcav towns`: list towns, draw their maps, and import new ones from OpenDRIVE."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_png
from flcav.cli.terminal import Answer, answer_json, echo
from flcav.interface.wording import plural

if TYPE_CHECKING:
    import pyarrow as pa

    from flcav.world.map.town import Town

towns = typer.Typer(help="Towns: list them, draw their maps, import new ones from OpenDRIVE.", no_args_is_help=True)


@towns.command("list")
@answer_json
def list_towns() -> Answer:
    """List the towns that come with flcav, and what they have."""
    from flcav.world.map.census import summarise_town
    from flcav.world.map.town import PACKAGED, load_town

    found = {name: load_town(name) for name in PACKAGED}
    counts = {name: summarise_town(town) for name, town in found.items()}
    rows = [{"name": name, "description": found[name].parameters.description, **counts[name]} for name in PACKAGED]
    yield {"towns": rows}
    for name, town in found.items():
        yield f"{name}: {town.parameters.description}"
        yield f"    {summary(counts[name])}"


@towns.command()
def show(
    town: str = typer.Argument(help="A town's name, or its folder."),
    out: Path | None = typer.Option(None, "--out", callback=check_png, help="PNG file: the map."),
    poles: Path | None = typer.Option(None, "--poles", help="Table (.csv or .parquet) of its candidate poles."),
) -> None:
    """Show a town.

    As a map: roads, lanes, markings, buildings, trees, signs, lights, and the numbered candidate poles. As a table: the
    poles' id, x, y, z [m, world], yaw_deg and kind, which `flcav place` reads; recipes take the same ids.
    """
    from flcav.report.pictures.town_map import town_map
    from flcav.storage.files import write_bytes
    from flcav.storage.records import write_any_table
    from flcav.world.map.census import summarise_town
    from flcav.world.map.town import load_town

    loaded = load_town(town)
    if poles is not None:
        write_any_table(_poles_table(loaded), poles)
        echo(f"{poles}: {plural(len(loaded.poles.id), 'candidate pole')} of {loaded.name}")
    if out is not None:
        write_bytes(out, town_map(loaded))
        echo(f"{out}: map of {loaded.name}")
    echo(f"{loaded.name}: {summary(summarise_town(loaded))}")
    if out is None:
        echo(f"its map: flcav towns show {town} --out {loaded.name}.png")


@towns.command("import")
def import_(
    xodr: Path = typer.Argument(help="OpenDRIVE map (.xodr)."),
    out: Path = typer.Option(..., "--out", help="New folder of the town; recipes name it as `town: DIR`."),
) -> None:
    """Make a town from an OpenDRIVE map, CARLA's included: streets as in the map, furnished like the other towns."""
    from flcav.world.map.census import summarise_town
    from flcav.world.opendrive.importing import import_town

    imported = import_town(xodr, out)
    echo(f"{out}: {summary(summarise_town(imported.town))}")
    for note in imported.notes:
        echo(f"    {note}")


def _poles_table(town: "Town") -> "pa.Table":
    import numpy as np
    import pyarrow as pa

    columns = {"id": town.poles.id, **dict(zip("xyz", town.poles.position.T, strict=True))}
    return pa.table(columns | {"yaw_deg": np.degrees(town.poles.yaw), "kind": list(town.poles.kind)})


def summary(counts: dict[str, float]) -> str:
    """Return a town's extent and counts as one line."""
    extent = f"{counts['width_m']:.0f} m x {counts['height_m']:.0f} m"
    lengths = f"{counts['driving_km']:g} km of lanes"
    nouns = ("junction", "light", "crossing", "building", "tree", "sign", "pole", "vehicle", "pedestrian")
    return ", ".join((extent, lengths, *(plural(int(counts[f"{noun}s"]), noun) for noun in nouns)))
