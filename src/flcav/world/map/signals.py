"""Traffic light heads: one on a mast at the kerb of every approach a light rules, one more above wide ones."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import LineString

from flcav.world.map.parameters import StreetParameters
from flcav.world.map.roads import Connection, Edge, RoadNet
from flcav.world.map.street_furniture import Verge

Array = NDArray[np.float64]

KERB_HEAD_M = 2.9  # height of a head's centre beside the road
ARM_HEAD_M = 5.6  # and above it
ARM_LANES = 2  # approaches from so many driving lanes on have a head above them
BEFORE_END_M = 0.6  # a mast stands so far before its lane's end
FROM_KERB_M = 0.45
SENSOR_CLEAR_M = 8.0


@dataclass(frozen=True)
class Signals:
    """The signal heads of a town."""

    position: Array  # (K, 3) centre of the head, world [m]
    yaw: Array  # (K,) where it faces: against the traffic it rules [rad]
    foot: Array  # (K, 2) of its mast [m]; heads on one mast share it
    link: tuple[str, ...]  # (K,) the entry of `Trace.light` it shows

    @classmethod
    def none(cls) -> "Signals":
        """Return the signals of a town without any."""
        return cls(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), ())


def place_signals(net: RoadNet, sensors: Array) -> Signals:
    """Return the heads of all approaches of `net` that a light rules, in the net's order.

    No arm reaches over the road where one of the `sensors` (P, 3) at the roadside stands close by: it hides the view.
    """
    heads = [head for edge in net.streets for head in _approach(edge, net.connections, sensors)]
    if not heads:
        return Signals.none()
    position, yaw, foot, link = zip(*heads)
    return Signals(np.array(position), np.array(yaw), np.array(foot), link)


Head = tuple[tuple[float, float, float], float, tuple[float, float], str]


def _approach(edge: Edge, connections: tuple[Connection, ...], sensors: Array) -> Iterator[Head]:
    driven = edge.lanes_of("driving")
    names = {lane.id for lane in driven}
    ruled = [way for way in connections if way.light and way.start in names]
    if not ruled:
        return
    link = min(ruled, key=lambda way: way.turn != "s").light  # the light of those who go straight on
    outer = edge.lanes[0]
    verge = Verge(LineString(outer.shape), outer.width / 2, StreetParameters())
    inwards = FROM_KERB_M - verge.half_width if outer.kind == "sidewalk" else verge.half_width + FROM_KERB_M
    x, y, heading = verge.at(verge.line.length - BEFORE_END_M, inwards)
    yaw = heading + np.pi
    yield (x, y, KERB_HEAD_M), yaw, (x, y), link
    clear = all(np.hypot(*(sensor[:2] - (x, y))) > SENSOR_CLEAR_M for sensor in sensors)
    if len(driven) >= ARM_LANES and clear:
        middle = np.mean([np.asarray(lane.shape)[-1] for lane in driven], axis=0)
        left = np.array((-np.sin(heading), np.cos(heading)))
        reach = float(left @ (middle - (x, y)))
        yield (x + reach * left[0], y + reach * left[1], ARM_HEAD_M), yaw, (x, y), link
