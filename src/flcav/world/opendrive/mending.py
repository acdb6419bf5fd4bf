"""Mending of OpenDRIVE maps: gaps over which netconvert stumbles, although a map can do without what is missing."""

import math
import xml.etree.ElementTree as ElementTree

SIGNAL = {"type": "-1", "dynamic": "no", "orientation": "none"}  # what a signal is that does not say; -1: of no type
ENDS = ("predecessor", "successor")


def mend_map(root: ElementTree.Element) -> tuple[str, ...]:
    """Mend the map below `root` in place; return a note on each kind of change.

    Signals get what they lack of `SIGNAL`; links and connections that lead nowhere, and infinite limits, are removed.
    """
    roads = {row.get("id", "") for row in root.iterfind("road")}
    known = {"road": roads, "junction": {row.get("id", "") for row in root.iterfind("junction")}}
    untyped = dangling = endless = 0  # signals, links, speed limits
    for road in root.iterfind("road"):
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
    for junction in root.iterfind("junction"):
        for row in junction.findall("connection"):
            ways = [lane for lane in row.iterfind("laneLink") if _is_integer(lane, "from") and _is_integer(lane, "to")]
            if not {row.get("incomingRoad"), row.get("connectingRoad")} <= roads:
                junction.remove(row)
                dangling += 1
            elif len(ways) < len(row.findall("laneLink")):
                for lane in row.findall("laneLink"):
                    if lane not in ways:
                        row.remove(lane)
    notes = []
    if untyped:
        notes.append(f"Signals without a type: {untyped}; they have no meaning here.")
    if dangling:
        notes.append(f"Links that lead to no road, junction or lane of the map, left out: {dangling}.")
    if endless:
        notes.append(f"Speed limits that are not finite, left out: {endless}.")
    return tuple(notes)


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
