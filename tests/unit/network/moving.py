"""Made-up traffic and links for tests of the radio and the clock."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.world.map.town import Town, load_town
from flcav.world.shapes import SHAPES
from flcav.world.trace import Trace


def open_town(*buildings: Sequence[float]) -> Town:
    """Return a town of 300 m by 300 m about the origin with these buildings: x, y, yaw, length, width, height."""
    rows = np.array(buildings, dtype=np.float64).reshape(-1, 6)
    return replace(load_town("suburb"), name="square", buildings=rows, bounds=(-150.0, -150.0, 150.0, 150.0))


def make_trace(
    times: ArrayLike, paths: Mapping[str, ArrayLike], shapes: Mapping[str, tuple[str, int]] | None = None
) -> Trace:
    """Return actors, sedans by default, that head east along `paths`, (T, 2) x, y [m], NaN where absent."""
    time_s = np.asarray(times, dtype=np.float64)
    kinds = [(shapes or {}).get(name, ("car", 3)) for name in paths]
    xy = np.stack([np.broadcast_to(np.asarray(path, np.float64), (len(time_s), 2)) for path in paths.values()], axis=1)
    present = np.isfinite(xy[..., 0] + xy[..., 1])
    flat = np.where(present, 0.0, np.nan)
    still = np.repeat(flat[..., None], 3, axis=2)
    sizes = [SHAPES[category][shape] for category, shape in kinds]
    return Trace(
        town="square",
        time_s=time_s,
        actor=np.array(list(paths), np.str_),
        category=np.array([category for category, _ in kinds], np.str_),
        shape=np.array([shape for _, shape in kinds]),
        size=np.array([(size.length, size.width, size.height) for size in sizes]),
        present=present,
        position=np.concatenate((xy, flat[..., None]), axis=2),
        yaw=flat,
        velocity=still,
        acceleration=still,
        yaw_rate=flat,
        light=np.zeros(0, np.str_),
        light_state=np.zeros((len(time_s), 0), np.str_),
    )


def made_links(
    times: ArrayLike, sinr_db: Mapping[str, ArrayLike], distance_m: Mapping[str, ArrayLike] | None = None
) -> RadioLinks:
    """Return links of vehicles with given SINRs (T,) or (T, U) [dB] in the whole band; NaN where one is absent."""
    radio = Radio()
    time_s = np.asarray(times, dtype=np.float64)

    def table(rows: Mapping[str, ArrayLike]) -> np.ndarray:
        columns = [np.asarray(row, np.float64) for row in rows.values()]
        columns = [
            np.broadcast_to(each if each.ndim == 2 else each.reshape(-1, 1), (len(time_s), width)) for each in columns
        ]
        return np.stack(columns, axis=1)

    width = max(np.asarray(row).shape[1] if np.ndim(row) == 2 else 1 for row in sinr_db.values())
    sinr = table(sinr_db)
    noise = -174 + 10 * np.log10(radio.bandwidth_mhz * 1e6) + radio.noise_figure_db
    loss = radio.power_dbm + 2 * radio.antenna_gain_dbi - noise - sinr
    distance = np.where(np.isnan(sinr), np.nan, np.ones(sinr.shape) if distance_m is None else table(distance_m))
    state = np.where(np.isnan(sinr), -1, 0).astype(np.int8)
    units = tuple(f"pole{number + 1}" for number in range(width))
    return RadioLinks(radio, time_s, tuple(sinr_db), units, distance, state, np.nan_to_num(loss, nan=np.inf))
