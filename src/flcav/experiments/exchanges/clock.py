"""Seconds of the rounds of an arm: its messages on the radio links of the region's recorded training drives.

Round n of a region is driven in the n-th scene of its training data, as in `flcav.runs.driving`. The
ledger says what each vehicle sent and received in the round, so that every arm has seconds, also one whose federation
knew of no network. Training takes no time here: the arms train alike.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from flcav.network.clock.rounds import NetworkSettings, RoundRules, time_clients
from flcav.network.clock.work import ClientWork, work_of_messages
from flcav.network.ledger import LedgerEntry
from flcav.network.radio.links import RadioLinks
from flcav.runs.arms import name_steps
from flcav.runs.driving import link_scenes
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MAIN, RunRecipe
from flcav.runs.results.plans import Placed


def link_regions(recipe: RunRecipe, task: str, work: Path, rounds: int) -> dict[str, list[RadioLinks]]:
    """Return by federating region the radio links in the scenes of its first `rounds` rounds.

    `work`: the folder of the run's steps. Raises `InputError` as `link_scenes`.
    """
    names = name_steps(recipe)
    found = {}
    for region in recipe.with_role("federate"):
        split = Frames.open(work / names.recording(region, EDGE, task))
        placed = Placed.load(work / names.place(MAIN, region))
        found[region] = link_scenes(split, placed, NetworkSettings(), rounds, recipe.seed)
    return found


def mean_round_s(
    entries: Iterable[LedgerEntry], links: Mapping[str, Sequence[RadioLinks]], edge_rounds: int
) -> float | None:
    """Return the mean time [s] of the rounds of stages II and III in all regions; None where no vehicle gets through.

    A round lasts until the last message of its vehicles has arrived. Vehicles that the radio loses do not count. In
    stage III the scenes go on after those of the `edge_rounds` rounds of stage II.
    """
    rounds: dict[tuple[str, str, int], list[LedgerEntry]] = {}
    for entry in entries:
        if entry.link == "wireless" and entry.stage in (EDGE, CLOUD) and entry.round > 0:
            region = entry.client.partition("/")[0]
            rounds.setdefault((region, entry.stage, entry.round), []).append(entry)
    lasted = []
    for (region, stage, number), sent in rounds.items():
        vehicles = {entry.client.rpartition("/")[2] for entry in sent}
        scenes = links[region]
        driven = number + (edge_rounds if stage == CLOUD else 0)
        works = work_of_messages(sent, dict.fromkeys(vehicles, 0.0))
        ends = _time_round(scenes[(driven - 1) % len(scenes)], works, driven)
        lasted += [] if ends is None else [ends]
    return float(np.mean(lasted)) if lasted else None


def _time_round(links: RadioLinks, works: Mapping[str, ClientWork], number: int) -> float | None:
    present = dict(zip(links.vehicle, links.present[0].tolist(), strict=True))
    there = [work for name, work in works.items() if present.get(name)]
    if not there:
        return None
    start = float(links.time_s[0])
    timings = time_clients(links, there, number, start, RoundRules())
    return max((timing.end_s - start for timing in timings if not timing.dropped), default=None)
