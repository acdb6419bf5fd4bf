"""Stage III: edge servers federate with the cloud, vehicles with edge servers."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from flcav.federation.divergence import RoundDivergence, measure_divergence
from flcav.federation.edge_server import EdgeServer, afford_cloud_rounds
from flcav.federation.rounds import federate
from flcav.federation.rules import Rules
from flcav.federation.runtimes.link import open_processes
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.runtimes.processes import ClientProcesses
from flcav.federation.state import FederationState
from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import Trainable, Weights
from flcav.interface.progress import Report
from flcav.network.ledger import Ledger
from flcav.perception.client import TaskClient
from flcav.perception.distillation import SharedSamples
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.pipeline.federations.rounds import FederationCheckpoints
from flcav.pipeline.learning import Learning, load_stage_network, regional_weights
from flcav.pipeline.recipe import CLOUD, EDGE
from flcav.pipeline.stages.clients import Strategies, describe_federation, give_outputs
from flcav.pipeline.stages.statistics import keep_statistics


@dataclass(frozen=True)
class RegionStart:
    """The start of a region's edge server in stage III."""

    clients: Mapping[str, TaskClient]  # its vehicles, by name
    weights: Weights  # of stage II
    earlier: int  # rounds of stage II


@dataclass(frozen=True)
class CloudFederation:
    """The federation of edge servers with the cloud: what its rounds begin with, and where they are kept."""

    learning: Learning
    network: Any  # that the cloud begins with
    regions: Mapping[str, RegionStart]
    edge_rounds: int  # of an edge server in a cloud round
    strategies: Strategies
    book: Ledger
    folder: Path  # of checkpoints, weights and ledger
    report: Report
    shared: SharedSamples | None = None  # that vehicles send outputs on, instead of weights
    keeps_statistics: bool = False  # whether each region's statistics of batch normalisation are written, too
    rate: float | None = None  # of the first round, where it is begun anew

    def afford(self, rules: Rules, rounds: int) -> int:
        """Return as many of `rounds` as the privacy budget affords in every region; without one all."""
        for own in self.regions.values() if rules.privacy is not None else ():
            rounds = min(rounds, afford_cloud_rounds(rules, [*own.clients], rounds, self.edge_rounds, own.earlier))
        return rounds

    def vehicles(self, region: str) -> Mapping[str, Trainable]:
        """Return the clients of a region's edge server, by name."""
        own = self.regions[region]
        return own.clients if self.shared is None else give_outputs(own.clients, self.shared, own.weights)

    def open_servers(
        self,
        rules: Rules,
        account: Account,
        done: int,
        states: Mapping[str, FederationState],
        runtime: ClientProcesses | None,
    ) -> dict[str, EdgeServer]:
        """Return the edge servers by region, after `done` cloud rounds; `states` are their own.

        The vehicles of one after another train, in the processes of `runtime`.
        """
        return {
            region: EdgeServer(
                self.vehicles(region),
                self.edge_rounds,
                account,
                own.weights,
                cloud_rounds_done=done,
                strategy=self.strategies.edge,
                rules=rules,
                state=states[region],
                earlier=own.earlier,
                runtime=runtime,
                distiller=self.shared,
            )
            for region, own in self.regions.items()
        }


def federate_cloud(
    federation: CloudFederation,
    rounds: int,
    rules: Rules,
    outages: Mapping[tuple[int, str], Outage] = {},
    *,
    processes: int = 1,
) -> tuple[float | None, ...]:
    """Run stage III; write weights and ledger, return each round's loss.

    Edge rounds are run by `rules`, and lose the vehicles that `outages` names; the cloud's rounds need all edge
    servers. Where rules make arrays personal, the weights have the mean of the regions' own, and each region's model is
    beside them, as are regional models. A privacy budget may end it before `rounds`. The vehicles of one region after
    another train, in so many `processes`.
    """
    own, learning, task = federation, federation.learning, federation.learning.task
    state, states = FederationState(), {region: FederationState() for region in federation.regions}
    rounds = own.afford(rules, rounds)
    checkpoints = FederationCheckpoints(
        task,
        own.folder,
        own.book,
        own.report,
        {CLOUD: state, **{f"{EDGE}/{region}": each for region, each in states.items()}},
        describe_federation(own.strategies, rules),
        rounds,
        rules.privacy,
    )
    rules.check_personal(to_arrays(own.network))
    start, done = checkpoints.resume(to_arrays(own.network))
    parties = {f"{EDGE}/{region}": rules.secret_parties([*each.clients]) for region, each in own.regions.items()}
    checkpoints.keep_secrets(parties)
    earlier = max(each.earlier for each in own.regions.values())
    schedule = learning.schedule(rounds, learning.training.local_steps, CLOUD, "", earlier=earlier, anew=own.rate)
    wireless = Account(own.book, CLOUD, task.name, "wireless", outages)
    everybody = {name: client for region in own.regions for name, client in own.vehicles(region).items()}
    with checkpoints.refusals(), open_processes(everybody, processes) as runtime:
        servers = own.open_servers(rules, wireless, done, states, runtime)
        federate(
            servers,
            start,
            schedule,
            Account(own.book, CLOUD, task.name, "wireline"),
            strategy=own.strategies.cloud,
            rules=rules.of_servers(),
            state=state,
            done=done,
            on_round=partial(_keep_round, own, servers, state, checkpoints),
        )
    losses = checkpoints.finish(own.network, learning.training.average_rounds)
    if rules.personal:
        _save_regional_models(learning, own.folder, states)
    return losses


def _keep_round(
    own: CloudFederation,
    servers: Mapping[str, EdgeServer],
    state: FederationState,
    checkpoints: FederationCheckpoints,
    number: int,
    weights: Weights,
    loss: float | None,
) -> None:
    """Keep the divergence of the regions in a cloud round, their statistics, and the checkpoint.

    The checkpoint has the mean of the regions' personal arrays.
    """
    regions = [*servers.values()]
    if len(regions) > 1:
        both = ([each.begun for each in regions], [each.trained for each in regions])
        divergence = RoundDivergence(*(measure_divergence(models) for models in both))
        state.records[-1] = replace(state.records[-1], divergence=divergence)
    for region, server in servers.items() if own.keeps_statistics else ():
        keep_statistics(server.trained, own.folder, region)
    personal = [each.state.personal for each in regions if each.state.personal and each.rules.personal_arrays]
    checkpoints.save(number, {**weights, **(average(personal, [1.0] * len(personal)) if personal else {})}, loss)


def _save_regional_models(learning: Learning, folder: Path, states: Mapping[str, FederationState]) -> None:
    """Write each region's own model: the common weights with what its edge server keeps."""
    for region, own in states.items():
        model = load_stage_network(learning.task, folder)
        from_arrays(model, {**to_arrays(model), **own.personal})
        save_network(learning.task, model, folder / regional_weights(region))
