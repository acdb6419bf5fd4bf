"""The radio network of a region's vehicles, in the steps of stages II and III."""

from collections.abc import Sequence

from flcav.federation.rules import RegionalModels, Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.strategies import exchanges_more
from flcav.network.clock.records import save_rounds
from flcav.perception.weights import to_arrays
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.network import CLOCK, DrivenRounds, Fleet, drive_rounds, link_scenes
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import Learning
from flcav.pipeline.results.placement import Placed
from flcav.pipeline.steps.settings import FederationSettings, RegionInputs


def drive_region(
    work: Work,
    settings: FederationSettings,
    learning: Learning,
    inputs: RegionInputs,
    clients: Sequence[str],
    earlier: int,
    rules: Rules,
    seeds: Sequence[int],
) -> DrivenRounds:
    """Return what the radio network makes of a region's rounds by `rules`, and write their clock.

    `seeds` are those of the rounds, which follow `earlier` ones. Without a network no client is lost.
    """
    how, network = settings.federation, settings.federation.network
    if network is None:
        return DrivenRounds(rules, {}, ())
    weights = to_arrays(learning.build_network())
    both = isinstance(how.personal, RegionalModels)  # the region's and the global model go down together
    down = update_bytes(weights, exchanging=both)
    up = update_bytes(weights, how.upload, exchanging=exchanges_more(how.strategy))
    fleet = Fleet(inputs.region, tuple(clients), down, up, settings.train_s, settings.speeds)
    split, placed = Frames.open(work.inputs[inputs.frames]), Placed.load(work.inputs[inputs.place])
    scenes = link_scenes(split, placed, network, earlier + len(seeds), learning.seed)
    driven = drive_rounds(fleet, scenes, network, rules, seeds, earlier)
    save_rounds(driven.records, work.folder / f"{CLOCK}-{inputs.region}.parquet")
    return driven
