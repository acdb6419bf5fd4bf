"""From an OpenDRIVE file to the folder of a town."""

import shutil
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import yaml

from flcav.config import InputError
from flcav.world.opendrive.document import read_document
from flcav.world.opendrive.furnishing import furnish
from flcav.world.opendrive.georeference import geo_reference
from flcav.world.opendrive.netconvert import join, take_apart
from flcav.world.opendrive.streets import rewrite
from flcav.world.parameters import GeoReference, MapSource
from flcav.world.roads import read_net
from flcav.world.town import Town, load_town


@dataclass(frozen=True)
class Imported:
    """A town made from a map, and what one should know about it."""

    town: Town
    notes: tuple[str, ...]  # sentences


def import_town(xodr: Path, out: Path) -> Imported:
    """Make the folder `out` of a town from an OpenDRIVE map; the same map gives the same town.

    Raises `InputError`, and leaves nothing behind, where the file is no OpenDRIVE map that netconvert can read, where
    no car can drive on it, and where `out` is there already.
    """
    if out.exists():
        raise InputError(f"{out}: is there already; give a new folder")
    document = read_document(xodr)
    notes = ["Heights of the map are left out: towns are flat."]
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
        prefix, folder = Path(scratch) / "map", Path(scratch) / out.name
        folder.mkdir()
        take_apart(xodr, prefix)
        streets = rewrite(prefix, document, xodr)
        join(prefix, folder / "town.net.xml", xodr)
        net = read_net(folder / "town.net.xml")
        dx, dy = streets.offset_m
        geo = geo_reference(document.geo_reference, -dx, -dy)
        if geo is None:
            geo = GeoReference()
            notes.append(
                f"The map's geo-reference {document.geo_reference!r} is none of +proj=tmerc and +proj=utm: "
                f"the town lies at {geo.latitude_deg}° N, {geo.longitude_deg}° E."
            )
        if streets.sidewalks_added:
            notes.append("The map has no sidewalks: added along its town streets.")
        if streets.offset_m != (0.0, 0.0):
            notes.append(f"Moved to the origin: town = map + ({dx:.0f}, {dy:.0f}) m.")
        parameters = furnish(
            net,
            description=f"Imported from {xodr.name}.",
            seed=zlib.crc32(xodr.read_bytes()) % 10_000,
            geo=geo,
            source=MapSource(file=xodr.name, offset_m=streets.offset_m),
        )
        values = parameters.model_dump(mode="json", exclude_defaults=True)
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
        (folder / "town.yaml").write_text(text, encoding="utf-8")
        load_town(folder)
        shutil.move(folder, out)
    return Imported(load_town(out), tuple(notes))
