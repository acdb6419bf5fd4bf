"""Export of a town's roads as an OpenDRIVE map, in the town's coordinates.

netconvert writes the plan. This module corrects or adds what netconvert omits: the geo-reference, heights, lane-change
permissions, links from driving lanes to bicycle lanes (removed), closed outlines of crosswalks, and traffic lights: one
signal of CARLA's type per approach, with the id "junction_link".
"""

import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from copy import deepcopy
from pathlib import Path

import numpy as np

from flcav.world.map.parameters import GeoReference
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.town import Town
from flcav.world.opendrive.netconvert import run_netconvert
from flcav.world.opendrive.reference_line import ReferenceLine

TRAFFIC_LIGHT = "1000001"  # type of a signal with three lenses (ASAM OpenDRIVE signal catalogue)
HEIGHT_STEP_M = 2.0  # largest distance of two neighbouring heights along a road


def export_town(town: Town) -> str:
    """Convert a town's roads to an OpenDRIVE map, as XML text; the same town always gives the same text.

    Raises `InputError` where netconvert is missing or refuses the net.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        shutil.copyfile(town.net, folder / "town.net.xml")
        options = {"sumo-net-file": "town.net.xml", "opendrive-output": "town.xodr"}
        run_netconvert(options, folder, town.net)
        root = ElementTree.parse(folder / "town.xodr").getroot()
    header = root.find("header")
    assert header is not None, "netconvert writes a header"
    header.attrib["date"], header.attrib["name"] = "", town.name
    ElementTree.SubElement(header, "geoReference").text = _format_projection(town.geo)
    _keep_signals(root, {name_signal(link) for link in list_approaches(read_net(town.net)).values()})
    _part_types(root)
    for mark in root.iter("roadMark"):
        if mark.get("type") != "none":
            mark.set("laneChange", "none" if "solid" in mark.get("type", "") else "both")
    for outline in root.iterfind(".//object[@type='crosswalk']/outline"):
        last = deepcopy(outline[0])
        last.set("id", str(len(outline)))
        outline.append(last)
    if town.relief is not None:
        for road in root.iterfind("road"):
            _raise_road(road, town)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def list_approaches(net: RoadNet) -> dict[str, str]:
    """Map each edge that leads to a traffic light to its link "junction:link".

    Of several links, the one straight on is taken, if any.
    """
    links: dict[str, str] = {}
    for edge in net.streets:
        lanes = {lane.id for lane in edge.lanes_of("driving")}
        ruled = [way for way in net.connections if way.light and way.start in lanes]
        if ruled:
            links[edge.id] = min(ruled, key=lambda way: way.turn != "s").light
    return links


def name_signal(link: str) -> str:
    """Return the id in the map of the signal of a link "junction:link"."""
    junction, _, number = link.rpartition(":")
    return f"{junction}_{number}"


def _format_projection(geo: GeoReference) -> str:
    return (
        f"+proj=tmerc +lat_0={geo.latitude_deg:.10g} +lon_0={geo.longitude_deg:.10g} +k=1 +x_0=0 +y_0=0 "
        "+datum=WGS84 +units=m +no_defs"
    )


def _keep_signals(root: ElementTree.Element, kept: set[str]) -> None:
    """Remove all signals except those with an id in `kept`, which become traffic lights, and empty controllers."""
    for signals in root.iter("signals"):
        for signal in list(signals):
            if signal.get("id") in kept:
                signal.set("type", TRAFFIC_LIGHT)
                signal.set("subtype", "-1")
            else:
                signals.remove(signal)
    for controller in root.findall("controller"):
        for control in list(controller):
            if control.get("signalId") not in kept:
                controller.remove(control)
        if not len(controller):
            root.remove(controller)


def _part_types(root: ElementTree.Element) -> None:
    """Remove links between driving lanes and lanes of other types, which cars cannot use, through junctions too.

    A lane across a junction that begins at a bicycle lane becomes a bicycle lane; netconvert calls it a driving lane.
    """
    roads = [(road.get("id"), road) for road in root.iterfind("road")]
    lanes = {(number, lane.get("id")): lane for number, road in roads for lane in road.iter("lane")}

    def differ(*ends: tuple[str | None, str | None]) -> bool:
        kinds = {lanes[end].get("type") for end in ends}
        return "driving" in kinds and len(kinds) > 1

    for junction in root.iterfind("junction"):
        for way in junction.findall("connection"):
            for link in way.findall("laneLink"):
                start, across = (way.get("incomingRoad"), link.get("from")), (way.get("connectingRoad"), link.get("to"))
                if differ(start, across) and lanes[across].get("type") == "driving":
                    lanes[across].set("type", lanes[start].get("type", ""))
                elif differ(start, across):
                    way.remove(link)
            if way.find("laneLink") is None:
                junction.remove(way)
    for number, road in roads:
        for beyond in road.iterfind("link/*[@elementType='road']"):
            for lane in road.iter("lane"):
                link = lane.find(f"link/{beyond.tag}")
                if link is not None and differ((number, lane.get("id")), (beyond.get("elementId"), link.get("id"))):
                    lane[0].remove(link)


def _raise_road(road: ElementTree.Element, town: Town) -> None:
    """Write the heights of the ground [m] under a road's reference line as its elevation profile."""
    line = ReferenceLine(road)
    s = np.linspace(0.0, line.length, max(2, int(np.ceil(line.length / HEIGHT_STEP_M)) + 1))
    x, y, _ = line.at(s).T
    z = town.grounds(x, y)
    slope = np.append(np.diff(z) / np.maximum(np.diff(s), 1e-9), 0.0)
    profile = road.find("elevationProfile")
    assert profile is not None, "netconvert writes a profile for each road"
    profile.clear()
    for at, height, rise in zip(s[:-1].tolist(), z.tolist(), slope.tolist()):
        row = {"s": f"{at:.3f}", "a": f"{height:.4f}", "b": f"{rise:.6f}", "c": "0", "d": "0"}
        ElementTree.SubElement(profile, "elevation", row)
