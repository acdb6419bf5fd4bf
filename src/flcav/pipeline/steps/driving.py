"""The radio network of a region's vehicles, in the steps of stages II and III."""

from collections.abc import Callable, Sequence

from flcav.federation.rules import RegionalModels, Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.strategies import exchanges_more
from flcav.network.clock.records import save_rounds
from flcav.network.radio.links import RadioLinks
from flcav.perception.weights import to_arrays
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.network import CLOCK, DrivenRounds, Fleet, drive_rounds, link_scenes
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import Learning
from flcav.pipeline.results.placement import Placed
from flcav.pipeline.steps.settings import FederationSettings, RegionInputs


def open_network(
    work: Work,
    settings: FederationSettings,
    learning: Learning,
    inputs: RegionInputs,
    clients: Sequence[str],
    earlier: int,
) -> Callable[[Rules, Sequence[int]], DrivenRounds]:
    """Return what simulates a region's rounds, after `earlier` ones, by rules and by the seeds of the rounds.

    It writes their clock. Without a network no client is lost.
    """
    how, network = settings.federation, settings.federation.network
    if network is None:
        return lambda rules, seeds: DrivenRounds(rules, {}, ())
    weights = to_arrays(learning.build_network())
    both = isinstance(how.personal, RegionalModels)  # the region's and the global model go down together
    sizes = (
        update_bytes(weights, exchanging=both),
        update_bytes(weights, how.upload, exchanging=exchanges_more(how.strategy)),
    )
    fleet = Fleet(inputs.region, tuple(clients), *sizes, settings.train_s, settings.speeds)
    split, placed = Frames.open(work.inputs[inputs.frames]), Placed.load(work.inputs[inputs.place])
    scenes: list[RadioLinks] = []

    def drive(rules: Rules, seeds: Sequence[int]) -> DrivenRounds:
        scenes[:] = link_scenes(split, placed, network, earlier + len(seeds), learning.seed, scenes)
        driven = drive_rounds(fleet, scenes, network, rules, seeds, earlier)
        save_rounds(driven.records, work.folder / f"{CLOCK}-{inputs.region}.parquet")
        return driven

    return drive
