"""A town: what stands still. Roads come from a SUMO net, the rest from the town's parameter file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Poles:
    """Candidate sites of a roadside sensor."""

    id: NDArray[np.int64]  # (P,) the numbers people call them by, 1-based
    position: Array  # (P, 3) the sensor's mount, world [m]; z is its height above ground
    yaw: Array  # (P,) where the mount faces: towards the road or junction it watches, world [rad]
    kind: tuple[str, ...]  # (P,) straight | cross | tee | roundabout


@dataclass(frozen=True)
class Signs:
    """Traffic signs."""

    position: Array  # (S, 3) plate centre, world [m]
    yaw: Array  # (S,) the plate's outward normal [rad]
    kind: tuple[str, ...]  # (S,) stop | yield | speed_30 | speed_60 | speed_90


@dataclass(frozen=True)
class Town:
    """A town's static content. World frame: ENU, metres, z = 0 is the road surface."""

    name: str
    net: Path  # the SUMO net file (.net.xml)
    bounds: tuple[float, float, float, float]  # x_min, y_min, x_max, y_max [m]
    roads: tuple[Array, ...]  # polygons (K, 2) of drivable surface
    sidewalks: tuple[Array, ...]  # polygons (K, 2), raised by the kerb
    kerbs: tuple[Array, ...]  # polylines (K, 2) where road meets sidewalk
    buildings: Array  # (B, 6) centre x, y, yaw, length, width, height
    trees: Array  # (T, 4) x, y, height, crown radius
    clutter: tuple[
        tuple[str, Array], ...
    ]  # (kind, (K, 6) x, y, yaw, length, width, height): shelter, kiosk, bin, hedge...
    poles: Poles
    signs: Signs
    lamps: Array  # (L, 3) street lamp foot x, y and height
