"""Import of an OpenDRIVE map as the folder of a town, by SUMO's netconvert in two passes.

The first pass splits the map into nodes, edges and connections; the second joins these, rewritten, to a net.
"""

import shutil
import tempfile
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from shapely.geometry import LineString

from flcav.config import InputError, shorten
from flcav.machine.locks import only_writer
from flcav.storage.files import find_existing, flush_tree
from flcav.world.map.parameters import GeoReference, MapSource
from flcav.world.map.relief import Deck, Relief
from flcav.world.map.roads import RoadNet, name_streets
from flcav.world.map.town import HEIGHTS, Town, check_town_name, load_town
from flcav.world.opendrive.document import describe_map, read_map
from flcav.world.opendrive.furnishing import furnish, take_objects
from flcav.world.opendrive.georeference import locate_origin
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.mending import mend_map, mend_roads
from flcav.world.opendrive.netconvert import join_parts, name_safely, split_map
from flcav.world.opendrive.objects.crossings import find_crosswalks
from flcav.world.opendrive.objects.places import note_taken
from flcav.world.opendrive.streets import find_road, read_made_net, rewrite_streets

WIDEST_M = 5e5  # largest coordinate of a street in the town's frame
GAPS_M = 5000.0  # largest total length of the gaps between linked roads that streets span, both directions together
STRETCHED = 0.01  # least relative difference between lengths in the map and on the ground that is noted


def _read_joined(path: Path, origin: Path, roads_m: float) -> RoadNet:
    """Read the net that netconvert made and check that it can be a town; raises `InputError` naming `origin` otherwise.

    netconvert joins linked roads by straight streets, however far apart they are. `roads_m` is the total length of the
    map's roads [m], against which that of the streets is checked.
    """
    net = read_made_net(path, origin)
    if not any(edge.lanes_of("driving") for edge in net.streets):
        raise InputError(f"{origin}: has no road with a lane for driving")
    streets_m = sum(LineString(edge.lanes[0].shape).length for edge in net.streets)
    if streets_m > 2 * roads_m + GAPS_M:  # both directions of each road, at most
        raise InputError(
            f"{origin}: roads that are linked lie apart: {streets_m / 1000:.0f} km of streets to join "
            f"{roads_m / 1000:.3g} km of roads (OpenDRIVE 1.8, 10.3)"
        )
    if any(np.abs(lane.shape).max() > WIDEST_M for edge in net.streets for lane in edge.lanes):
        raise InputError(f"{origin}: its streets lie more than {WIDEST_M / 1000:.0f} km from their middle")
    return net


def _format_place(geo: GeoReference) -> str:
    """Format latitude and longitude as text, rounded to about 10 m.

    >>> _format_place(GeoReference(latitude_deg=-33.9, longitude_deg=18.42))
    '33.9° S, 18.42° E'
    """
    latitude, longitude = round(geo.latitude_deg, 4), round(geo.longitude_deg, 4)
    return f"{abs(latitude)}° {'S' if latitude < 0 else 'N'}, {abs(longitude)}° {'W' if longitude < 0 else 'E'}"


@dataclass(frozen=True)
class ImportedTown:
    """An imported town, and notes on how it differs from the map."""

    town: Town
    notes: tuple[str, ...]  # one sentence a difference


def import_town(xodr: Path, out: Path) -> ImportedTown:
    """Convert an OpenDRIVE map to a town in the new folder `out`; the same map always gives the same town.

    Raises `InputError`, and makes no folder, where `out` exists already, where netconvert cannot read the file as an
    OpenDRIVE map, and where the map has no driving lane.
    """
    check_town_name(out.name)
    with only_writer(out):
        return _import(xodr, out)


def _import(xodr: Path, out: Path) -> ImportedTown:
    if out.exists():
        raise InputError(f"{out}: is there already; give a new folder")
    parent = find_existing(out.parent)
    if not parent.is_dir():
        raise InputError(f"{parent}: is a file; a town needs a folder")
    root = read_map(xodr)
    notes = [*mend_roads(root), *mend_map(root)]
    name_safely(root)
    document = describe_map(root)
    heights = sample_heights(root, xodr)
    if heights.decks:
        notes.append(f"Bridges, on which roads pass above others: {len(heights.decks)}.")
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=parent) as scratch:
        prefix, folder = Path(scratch) / "map", Path(scratch) / out.name
        folder.mkdir()
        split_map(root, prefix, xodr, left_hand=document.left_hand)
        streets = rewrite_streets(prefix, document, xodr)
        crosswalks = find_crosswalks(root, streets.offset_m)
        crossed = join_parts(
            prefix, folder / "town.net.xml", xodr, left_hand=document.left_hand, crosswalks=crosswalks.found
        )
        name_streets(folder / "town.net.xml", lambda edge: find_road(edge, document).name)
        roads_m = sum(float(road.attrib["length"]) for road in root.iterfind("road"))
        net = _read_joined(folder / "town.net.xml", xodr, roads_m)
        nowhere = Counter({"no street between two sidewalks there": len(crosswalks.found) - crossed})
        notes += note_taken("Crosswalks", crossed, crosswalks.left + nowhere)
        objects = take_objects(root, streets.offset_m, net, folder / "town.net.xml", crosswalks=crossed > 0)
        notes += objects.notes
        dx, dy = streets.offset_m
        geo = locate_origin(document.geo_reference, -dx, -dy, document.offset)
        if geo is None:
            geo = GeoReference()
            why = (
                f"The map's geo-reference {shorten(document.geo_reference)} is none of +proj=tmerc, +proj=utm and "
                "+proj=merc on WGS 84 and no EPSG code of these, or its place is none"
                if document.geo_reference
                else "The map has no geo-reference"
            )
            notes.append(f"{why}: the town lies at {_format_place(geo)}.")
        else:
            scale = 1 / np.hypot(*geo.y_axis)
            stretched = f"; a metre there is {scale:.3g} m of the map" if abs(scale - 1) > STRETCHED else ""
            notes.append(f"By its geo-reference the town lies at {_format_place(geo)}{stretched}.")
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
            found=objects,
        )
        values = parameters.model_dump(mode="json", exclude_defaults=True)
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)
        (folder / "town.yaml").write_text(text, encoding="utf-8")
        if not parameters.vehicles:
            metres = sum(LineString(lane.shape).length for edge in net.streets for lane in edge.lanes_of("driving"))
            notes.append(f"No vehicles: the map has {metres:.0f} m of lanes open to cars.")
        if len(heights.points):
            offset = np.array([dx, dy, 0.0])
            decks = [Deck([section + offset for section in sections]) for sections in heights.decks]
            Relief(heights.points + offset, decks).save(folder / HEIGHTS)
        town = load_town(folder)
        flush_tree(folder)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(folder, out)
    return ImportedTown(replace(town, net=out.absolute() / "town.net.xml"), tuple(notes))
