"""Links of vehicles before sensors are placed, and what a plan takes from them: rates, and time on the air of a round.

The roadside unit is on the pole with most traffic.
"""

from collections.abc import Sequence

import numpy as np

from flcav.config import InputError
from flcav.network.clock.rounds import NetworkSettings, RoundRules, time_clients
from flcav.network.clock.work import ClientWork
from flcav.network.radio.links import RadioLinks
from flcav.network.radio.recorded import link_scene
from flcav.pipeline.frames import Frames
from flcav.pipeline.poles import find_sites, read_traces
from flcav.world.map.census import measure_traffic_density


def link_drive(
    region: str, drive: Frames, settings: NetworkSettings, range_m: float, seed: int, recorded: bool
) -> list[RadioLinks]:
    """Return the links of the vehicles in the scenes of a drive to a unit on the pole with most traffic.

    Traffic counts within `range_m` [m]. Of `recorded` data the poles are those that it was recorded from. Raises
    `InputError` where there is none, and as `link_scene`.
    """
    sites = find_sites(drive, drive if recorded else None)
    if not len(sites.number):
        raise InputError(f"federation.network: '{region}' has no poles for roadside units")
    actors = measure_traffic_density(sites.position, read_traces(drive.data, drive.vehicles), range_m)
    pole = int(sites.number[int(np.argmax(actors))])
    scenes = dict.fromkeys(drive.data.keys[i].scene for i in drive.vehicles)
    return [link_scene(drive.data, settings.radio, (pole,), scene, seed).links for scene in scenes]


def measure_uplinks(
    region: str, drive: Frames, settings: NetworkSettings, range_m: float, seed: int
) -> dict[str, float]:
    """Return the mean rate of the uplink [Mbit/s] of each vehicle of a drive, "region/vehicle", over all its scenes.

    Each vehicle has the whole band; where it is not in the town, its rate is 0. See `link_drive`.
    """
    rates = dict[str, list[float]]()
    for links in link_drive(region, drive, settings, range_m, seed, recorded=drive.data.town() is None):
        for vehicle, mean in zip(links.vehicle, links.rate_bps[:, :, 0].mean(axis=0) / 1e6, strict=True):
            rates.setdefault(f"{region}/{vehicle}", []).append(float(mean))
    return {name: float(np.mean(each)) for name, each in rates.items()}


def predict_air_s(scenes: Sequence[RadioLinks], download_bytes: int, upload_bytes: int) -> float | None:
    """Return the mean time [s] in which a vehicle downloads and uploads so many bytes; None where none gets through.

    In each scene all that are in the town begin at its first instant, and share the band.
    """
    spent = []
    for links in scenes:
        present = [name for name, here in zip(links.vehicle, links.present[0].tolist(), strict=True) if here]
        if present and len(links.time_s) > 1:
            work = [ClientWork(name, download_bytes, 0.0, upload_bytes) for name in present]
            timings = time_clients(links, work, 1, float(links.time_s[0]), RoundRules())
            spent += [timing.end_s - timing.start_s for timing in timings if not timing.dropped]
    return float(np.mean(spent)) if spent else None
