"""Mending of OpenDRIVE maps: completion of optional content that netconvert requires, and removal of broken content.

netconvert requires more than ASAM OpenDRIVE 1.8 does: a type of the centre lane (11.3), the contact point of a
connection (12.4), and restrictions of access as attributes, as in edition 1.7 (11.8.2).
"""

import math
import re
import xml.etree.ElementTree as ElementTree

NAMES = {  # attributes that refer to a road or junction by its id
    "road": ("incomingRoad", "connectingRoad", "linkedRoad", "high", "low"),
    "junction": ("junction",),
}
UNSAFE = re.compile(r"[^A-Za-z0-9_.-]")  # what ids of SUMO's nodes and edges are without here

SIGNAL = {"type": "-1", "dynamic": "no", "orientation": "none"}  # what a signal is that does not say; -1: of no type
ENDS = ("predecessor", "successor")


def mend_map(root: ElementTree.Element) -> tuple[str, ...]:
    """Mend the map below `root` in place; return a note on each kind of change.

    Signals get what they lack of `SIGNAL`; links and connections that lead nowhere, and infinite limits, are removed.
    What netconvert requires beyond the standard is completed without a note.
    """
    roads = {row.get("id", "") for row in root.iterfind("road")}
    known = {"road": roads, "junction": {row.get("id", "") for row in root.iterfind("junction")}}
    untyped = dangling = endless = unknown = direct = 0  # signals, links, speed limits, lanes, connections
    for road in root.iterfind("road"):
        unknown += _type_lanes(road)
        _split_restrictions(road)
        for signal in road.iterfind("signals/signal"):
            untyped += not signal.get("type")
            for name, value in {"id": f"unnamed{untyped}", **SIGNAL}.items():
                signal.set(name, signal.get(name) or value)
        link = road.find("link")
        for end in list(link) if link is not None else []:
            if end.tag in ENDS and end.get("elementId") not in known.get(end.get("elementType", ""), ()):
                link.remove(end)  # pyright: ignore[reportOptionalMemberAccess]
                dangling += 1
        dangling += _clear_lane_links(road)
        endless += _clear_endless_limits(road)
    before = {road.get("id", ""): _find_predecessor(road) for road in root.iterfind("road")}
    for junction in root.iterfind("junction"):
        for row in junction.findall("connection"):
            if not row.get("contactPoint"):
                begins = before.get(row.get("connectingRoad", "")) == row.get("incomingRoad")
                row.set("contactPoint", "start" if begins else "end")
            ways = [lane for lane in row.iterfind("laneLink") if _is_integer(lane, "from") and _is_integer(lane, "to")]
            if {row.get("incomingRoad"), row.get("linkedRoad")} <= roads:
                junction.remove(row)
                direct += 1
            elif not {row.get("incomingRoad"), row.get("connectingRoad")} <= roads:
                junction.remove(row)
                dangling += 1
            elif len(ways) < len(row.findall("laneLink")):
                for lane in row.findall("laneLink"):
                    if lane not in ways:
                        row.remove(lane)
    notes = (
        (untyped, f"Signals without a type: {untyped}; they have no meaning here."),
        (dangling, f"Links that lead to no road, junction or lane of the map, left out: {dangling}."),
        (endless, f"Speed limits that are not finite, left out: {endless}."),
        (direct, f"Connections of direct junctions: {direct}; their lanes are joined by where they lie."),
        (unknown, f"Lanes without a type, closed to traffic: {unknown}."),
    )
    return tuple(note for count, note in notes if count)


def name_safely(root: ElementTree.Element) -> None:
    """Replace what SUMO's ids cannot have in the ids of roads and junctions of the map below `root`, in place."""
    for kind, references in NAMES.items():
        known = {row.get("id", "") for row in root.iterfind(kind)}
        safe: dict[str, str] = {}
        for name in sorted(name for name in known if UNSAFE.search(name)):
            safe[name] = UNSAFE.sub("_", name)
            while safe[name] in known:
                safe[name] += "_"
            known.add(safe[name])
        for row in root.iter() if safe else ():
            own = ("id",) if row.tag == kind else ("elementId",) if row.get("elementType") == kind else ()
            for attribute in (*own, *references):
                if row.get(attribute) in safe:
                    row.set(attribute, safe[row.attrib[attribute]])


def _type_lanes(road: ElementTree.Element) -> int:
    """Give each lane without a type the type "none"; return how many of them are not the centre lane."""
    unknown = 0
    for side in road.iterfind("lanes/laneSection/*"):
        for lane in side.iterfind("lane"):
            if not lane.get("type"):
                lane.set("type", "none")
                unknown += side.tag != "center"
    return unknown


def _split_restrictions(road: ElementTree.Element) -> None:
    """Rewrite each `<access>` of edition 1.8, with `<restriction>` elements, as one of edition 1.7 for each of them."""
    for lane in road.iterfind("lanes/laneSection/*/lane"):
        for access in lane.findall("access"):
            if access.get("restriction"):
                continue
            at = list(lane).index(access)
            lane.remove(access)
            for restriction in access.iterfind("restriction"):
                values = {**access.attrib, "restriction": restriction.get("type", "")}
                lane.insert(at, ElementTree.Element("access", values))


def _find_predecessor(road: ElementTree.Element) -> str | None:
    """Return the id of the road that precedes a road, if any."""
    before = road.find("link/predecessor[@elementType='road']")
    return None if before is None else before.get("elementId")


def _clear_lane_links(road: ElementTree.Element) -> int:
    """Remove the links of lanes that are no numbers; return how many."""
    removed = 0
    for link in road.iterfind("lanes/laneSection/*/lane/link"):
        for end in list(link):
            if end.tag in ENDS and not _is_integer(end, "id"):
                link.remove(end)
                removed += 1
    return removed


def _clear_endless_limits(road: ElementTree.Element) -> int:
    """Remove the speed limits that are infinite or NaN; return how many. Words like "no limit" stay."""
    removed = 0
    for owner in [*road.iterfind("type"), *road.iterfind("lanes/laneSection/*/lane")]:
        for limit in owner.findall("speed"):
            try:
                endless = not math.isfinite(float(limit.get("max", "")))
            except ValueError:
                continue
            if endless:
                owner.remove(limit)
                removed += 1
    return removed


def _is_integer(row: ElementTree.Element, name: str) -> bool:
    return row.get(name, "").removeprefix("-").isascii() and row.get(name, "").removeprefix("-").isdigit()
