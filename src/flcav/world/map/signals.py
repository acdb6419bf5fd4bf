"""Placement of signal heads: a mast at the kerb of every approach to a traffic light, an arm over wide approaches."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from shapely.geometry import LineString

from flcav.arrays import Array
from flcav.geometry import left_vectors
from flcav.world.map.parameters import SignalParameters, StreetParameters
from flcav.world.map.roads import Edge, RoadNet
from flcav.world.map.street_furniture import Verge

Head = tuple[tuple[float, float, float], float, tuple[float, float], str]  # position [m], yaw [rad], foot [m], link

KERB_HEAD_M = 2.9  # height of the centre of a head at the kerb
ARM_HEAD_M = 5.6  # height of the centre of a head above the road
ARM_LANES = 2  # number of driving lanes from which an approach also has a head above it
BEFORE_END_M = 0.6  # distance of a mast from the end of its lane
FROM_KERB_M = 0.45  # distance of a mast from the kerb
SENSOR_CLEAR_M = 8.0  # distance of a roadside sensor from a mast within which it has no arm


@dataclass(frozen=True)
class Signals:
    """The K signal heads of a town."""

    position: Array  # (K, 3) centre of the head, world frame [m]
    yaw: Array  # (K,) direction it faces, towards the traffic it controls, world frame [rad]
    foot: Array  # (K, 2) foot of its mast, world frame [m]; heads on one mast share it
    link: tuple[str, ...]  # (K,) the entry of `Trace.light` that it shows
    walkers: int = 0  # number of heads at the end that are for pedestrians

    @classmethod
    def none(cls) -> "Signals":
        """Return the record of a town without traffic lights."""
        return cls(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), ())


def place_signals(net: RoadNet, sensors: Array, known: tuple[SignalParameters, ...] = ()) -> Signals:
    """Place the signal heads of all approaches to traffic lights, in the net's order, then those for pedestrians.

    There is no arm within `SENSOR_CLEAR_M` of a roadside sensor, `sensors` (P, 3) [m], since it would block the view.
    An approach with `known` heads has only these. Heads for pedestrians are only those known.
    """
    given: dict[str, list[Head]] = {}
    for signal in known:
        if not signal.walkers:
            given.setdefault(signal.light, []).append(_head(signal))
    heads = [head for edge in net.streets for head in _given(edge, net, given) or _approach(edge, net, sensors)]
    walkers = [_head(signal) for signal in known if signal.walkers]
    if not heads and not walkers:
        return Signals.none()
    position, yaw, foot, link = zip(*heads, *walkers)
    return Signals(np.array(position), np.array(yaw), np.array(foot), link, len(walkers))


def _head(signal: SignalParameters) -> Head:
    yaw = float(np.radians(signal.yaw_deg))
    foot = (signal.x, signal.y) - signal.reach_m * left_vectors(yaw)
    return (signal.x, signal.y, signal.height_m), yaw, (float(foot[0]), float(foot[1])), signal.light


def _given(edge: Edge, net: RoadNet, given: dict[str, list[Head]]) -> list[Head]:
    """Return the known heads of an approach."""
    lanes = {lane.id for lane in edge.lanes}
    lights = dict.fromkeys(way.light for way in net.connections if way.light and way.start in lanes)
    return [head for light in lights for head in given.get(light, ())]


def _approach(edge: Edge, net: RoadNet, sensors: Array) -> Iterator[Head]:
    """Yield the heads of an approach, placed by rule."""
    driven = edge.lanes_of("driving")
    names = {lane.id for lane in driven}
    ruled = [way for way in net.connections if way.light and way.start in names]
    if not ruled:
        return
    link = min(ruled, key=lambda way: way.turn != "s").light  # the signal of the way straight on, where there is one
    outer = edge.lanes[0]
    verge = Verge(LineString(outer.shape), outer.width / 2, StreetParameters(), net.side)
    inwards = FROM_KERB_M - verge.half_width if outer.kind == "sidewalk" else verge.half_width + FROM_KERB_M
    x, y, heading = verge.at(verge.line.length - BEFORE_END_M, inwards)
    yaw = heading + np.pi
    yield (x, y, KERB_HEAD_M), yaw, (x, y), link
    clear = all(np.hypot(*(sensor[:2] - (x, y))) > SENSOR_CLEAR_M for sensor in sensors)
    if len(driven) >= ARM_LANES and clear:
        middle = np.mean([np.asarray(lane.shape)[-1] for lane in driven], axis=0)
        left = left_vectors(heading)
        reach = float(left @ (middle - (x, y)))
        yield (x + reach * left[0], y + reach * left[1], ARM_HEAD_M), yaw, (x, y), link
