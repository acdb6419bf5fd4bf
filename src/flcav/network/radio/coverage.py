"""Radio coverage of a town: the rate that a vehicle would have at each place, among the buildings, without traffic."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.network.radio.budget import Radio, lone_rate_bps, received_dbm
from flcav.network.radio.links import check_units, walls_of
from flcav.network.radio.propagation import path_loss_db
from flcav.network.radio.sight import find_sight
from flcav.world.map.town import Town

Array = NDArray[np.float64]

ANTENNA_M = 1.6  # height of a vehicle's antenna: TR 37.885, clause 6.1.2, type 2
FINEST_M = 0.5


@dataclass(frozen=True)
class Coverage:
    """Median rates on a grid of X times Y places in a town, at the unit that serves each best."""

    unit: tuple[str, ...]  # (U,)
    site: Array  # (U, 3) [m, world]
    x: Array  # (X,) centres of the cells [m, world]
    y: Array  # (Y,)
    rate_bps: Array  # (Y, X)
    state: NDArray[np.int8]  # (Y, X) State.LOS or State.NLOS, to the unit that serves


def cover_town(town: Town, units: Mapping[str, Array], radio: Radio, step_m: float = 2.0) -> Coverage:
    """Return the radio coverage of a town by roadside units, on a grid.

    Rates are those of a vehicle alone in the band, without shadowing: medians over it. Raises `InputError` as
    `links.check_units`, and for a step below `FINEST_M`.

    Args:
        town: the town.
        units: name -> (3,) position of the unit's antenna [m, world].
        radio: settings of the links.
        step_m: distance of the grid's points [m].
    """
    check_units(town, units, radio)
    if not step_m >= FINEST_M:
        raise InputError(f"a grid of {step_m:g} m: at least {FINEST_M:g} m are wanted")
    sites = np.array(list(units.values()), dtype=np.float64)
    walls, nobody = walls_of(town, radio), Boxes.empty()
    x_low, y_low, x_high, y_high = town.bounds
    x, y = np.arange(x_low + step_m / 2, x_high, step_m), np.arange(y_low + step_m / 2, y_high, step_m)
    rate, state = np.empty((len(y), len(x))), np.empty((len(y), len(x)), np.int8)
    for row, north in enumerate(y):
        places = np.stack((x, np.full(len(x), north), np.full(len(x), ANTENNA_M)), axis=1)
        seen = find_sight(places, sites, walls, nobody).state  # (X, U)
        distance = np.linalg.norm(places[:, None] - sites, axis=-1)
        loss = path_loss_db(distance, seen, radio.frequency_ghz, radio.environment)
        best = loss.argmin(axis=1)[:, None]
        rate[row] = lone_rate_bps(received_dbm(np.take_along_axis(loss, best, 1)[:, 0], radio), radio)
        state[row] = np.take_along_axis(seen, best, 1)[:, 0]
    return Coverage(tuple(units), sites, x, y, rate, state)
