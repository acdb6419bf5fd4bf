"""Measured throughput of vehicles (CSV), in place of the radio model.

A table has a row per vehicle and time: `vehicle`, `time_s` [s], `mbps` [Mbit/s], and optionally `link`, wireless (the
default) or wireline. A rate holds until the vehicle's next row, and the last one as long as the longest before it;
before the first and after the last rate a vehicle is absent. The table repeats when it ends.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil
from pathlib import Path

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError, shorten
from flcav.network.ledger import LINKS
from flcav.network.radio.budget import Radio
from flcav.network.radio.links import RadioLinks
from flcav.storage.columns import find_columns
from flcav.storage.files import sha256
from flcav.storage.records import read_csv

NAMES: Mapping[str, Sequence[str]] = {  # alternative names of columns for `find_columns`
    "vehicle": ("vehicle_id", "veh", "vehicles", "ue", "ue_id", "node", "client", "car", "id", "name"),
    "time_s": ("time", "t", "timestamp", "seconds", "time_sec", "sec", "time_stamp"),
    "mbps": (
        *("mbit_s", "mbits", "mbit", "mbits_s", "throughput", "throughput_mbps", "throughput_mbit_s", "rate"),
        *("rate_mbps", "rate_mbit_s", "uplink_mbps", "ul_mbps", "ul_throughput", "bitrate_mbps", "datarate_mbps"),
    ),
    "link": ("link_type", "link_name"),
}
MOST_MBPS, MOST_S = 1e6, 1e10
REPEATED_S = 6 * 3600.0  # for which a table is repeated; a longer round ends there
UNIT = "measured"  # name of the single unit of measured links


@dataclass(frozen=True)
class Throughput:
    """Measured rates of vehicles by link, each a step function of time."""

    path: str
    rates: Mapping[
        str, Mapping[str, tuple[Array, Array]]
    ]  # by link and vehicle: times (T,) [s] and rates (T,) [Mbit/s]
    taken: tuple[str, ...] = ()  # a sentence for each column that was read under another name

    def mean_mbps(self, vehicle: str, link: str = "wireless") -> float:
        """Return the time-averaged rate of a vehicle on a link [Mbit/s].

        Raises `InputError` for a vehicle without measurements.
        """
        time_s, mbps = self.find(vehicle, link)
        return float(np.average(mbps, weights=_lasting(time_s)))

    def find(self, vehicle: str, link: str = "wireless") -> tuple[Array, Array]:
        """Return the times (T,) [s] and rates (T,) [Mbit/s] of a vehicle, named "region/vehicle" or only "vehicle".

        Raises `InputError` for a vehicle without measurements.
        """
        known = self.rates[link]
        for name in (vehicle, vehicle.rpartition("/")[2]):
            if name in known:
                return known[name]
        raise InputError(f"{self.path}: no {link} rates of vehicle '{vehicle}'; it has {', '.join(known) or 'none'}")


def load_throughput(path: Path | str, version: str | None = None) -> Throughput:
    """Return the throughput in a CSV file; raises `InputError` with row and value where the file is not valid.

    With `version`, the SHA-256 of the expected file, another file is refused.
    """
    digest = sha256(Path(path)) if Path(path).is_file() else ""
    if version not in (None, digest):
        raise InputError(f"{path}: the measured rates were changed while the run was under way")
    return _load(str(path), digest)


@lru_cache(maxsize=8)
def _load(path: str, _version: str) -> Throughput:
    columns, taken = find_columns(read_csv(path, ("vehicle",)).to_pydict(), NAMES, path)
    for name in ("vehicle", "time_s", "mbps"):
        if name not in columns:
            found = ", ".join(columns) or "none"
            raise InputError(
                f"{path}: column '{name}' is missing; measured rates have vehicle, time_s [s], mbps [Mbit/s], and "
                f"optionally link, {' or '.join(LINKS)}; found {found}"
            )
    links = columns.get("link", [LINKS[0]] * len(columns["vehicle"]))
    rows: dict[str, dict[str, dict[float, float]]] = {link: {} for link in LINKS}
    for row, (vehicle, time, rate, link) in enumerate(
        zip(columns["vehicle"], columns["time_s"], columns["mbps"], links), start=1
    ):
        name, wire = str(vehicle if vehicle is not None else "").strip(), str(link or LINKS[0]).strip().lower()
        if not name:
            raise InputError(f"{path}: row {row}: vehicle is empty")
        if wire not in LINKS:
            raise InputError(f"{path}: row {row}: link = {shorten(link)} must be {' or '.join(LINKS)}")
        series = rows[wire].setdefault(name, {})
        time_s = _number(time, "time_s", -MOST_S, MOST_S, f"{path}: row {row}")
        if time_s in series:
            raise InputError(f"{path}: row {row}: '{name}' has another row of {wire} at {time_s:g} s")
        series[time_s] = _number(rate, "mbps", 0.0, MOST_MBPS, f"{path}: row {row}")
    if not rows[LINKS[0]]:
        raise InputError(f"{path}: has no wireless rates")
    start = min(time for vehicles in rows.values() for series in vehicles.values() for time in series)
    rates = {
        link: {
            name: (np.array(sorted(series)) - start, np.array([series[time] for time in sorted(series)]))
            for name, series in vehicles.items()
        }
        for link, vehicles in rows.items()
    }
    return Throughput(path, rates, taken)


def link_measured(measured: Throughput, radio: Radio, vehicles: Sequence[str], region: str = "") -> RadioLinks:
    """Return the measured wireless links of vehicles to a single unit, repeated for `REPEATED_S`.

    Vehicles do not share a band: the rates are used as measured. Raises `InputError` for a vehicle without
    measurements.

    Args:
        measured: rates of the vehicles.
        radio: settings stored with the links; the rates do not depend on them.
        vehicles: names of the vehicles without their region, such as "cav0".
        region: region of the vehicles; "" if the table has no regions.
    """
    prefix = f"{region}/" if region else ""
    series = [measured.find(prefix + name) for name in vehicles]
    ends = [times[-1] + _lasting(times)[-1] for times, _ in series]
    period_s = max(ends)
    time_s = np.unique(np.concatenate([*(times for times, _ in series), ends, [0.0]]))
    time_s = time_s[time_s < period_s]
    mbps = np.full((len(time_s), len(series)), np.nan)
    for column, ((times, rates), end) in enumerate(zip(series, ends)):
        latest = np.searchsorted(times, time_s, side="right") - 1
        there = (latest >= 0) & (time_s < end)
        mbps[there, column] = rates[latest[there]]
    copies = ceil(REPEATED_S / period_s) + 1
    mbps = np.concatenate([np.tile(mbps, (copies, 1)), mbps[:1]])
    times = (np.arange(copies)[:, None] * period_s + time_s).ravel()
    here = ~np.isnan(mbps)[:, :, None]
    return RadioLinks(
        radio,
        np.append(times, copies * period_s),
        tuple(vehicles),
        (UNIT,),
        np.where(here, 0.0, np.nan),
        np.where(here, 0, -1).astype(np.int8),
        np.where(here, 0.0, np.inf),
        measured_bps=1e6 * np.nan_to_num(mbps),
        period_s=float(period_s),
    )


def _lasting(time_s: Array) -> Array:
    """Return the durations (T,) [s] of rates that begin at `time_s`; the last is the longest of the others, or 1 s."""
    gaps = np.diff(time_s)
    return np.append(gaps, gaps.max(initial=0.0) or 1.0)


def _number(value: object, name: str, least: float, most: float, where: str) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = np.nan
    if not least <= number <= most:
        raise InputError(f"{where}: {name} = {shorten(value)} must be a number from {least:g} to {most:g}")
    return number
