"""The three stages of training: centralised pretraining, edge federated learning, cloud federated learning.

Stage I: labelled samples are uploaded to the cloud, which trains on them. Stage II:
vehicles federate with their edge server. Stage III: edge servers federate with the cloud (Wang et al., IEEE Network
37(3), 2023). Every message is entered in a ledger.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flcav.federation.privacy import affordable_rounds
from flcav.federation.rounds import OnRound
from flcav.federation.rules import Rules
from flcav.federation.runtimes.choice import open_runtime
from flcav.federation.runtimes.metered import Account, Outage
from flcav.federation.stages import EdgeServer, Schedule, afford_cloud_rounds, federate, federate_outputs
from flcav.federation.state import FederationState
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import Budget, Ledger
from flcav.network.messages import send
from flcav.perception.client import TaskClient, as_shared
from flcav.perception.distillation import OutputClient, SharedSamples
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.training import Checkpointing, Validation, train, train_steps
from flcav.perception.weights import from_arrays, load_network, save_network, to_arrays
from flcav.pipeline.federations.checkpoint import LAST
from flcav.pipeline.federations.replanning import Driven, Replanning
from flcav.pipeline.federations.rounds import FederationCheckpoints, load_round_network
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import CLOUD, EDGE, PRETRAIN, Training
from flcav.pipeline.results import WEIGHTS, Validated
from flcav.progress import Report
from flcav.seeds import derive_seed, stream

OnStart = Callable[[int, Weights], None]  # called before a round with its number and weights
CHECKPOINT, ROUND = "checkpoint.pt", LAST
VALIDATIONS, APART = 10, 5  # during pretraining; at least so many steps apart


def _begin(round_: int, weights: Weights) -> None:
    pass


@dataclass(frozen=True)
class Learning:
    """Settings of a task's training in a run: network configuration, schedule, and seed."""

    task: Task
    network: str | None  # name of the configuration
    training: Training
    seed: int

    @property
    def batch(self) -> int:
        """Return the batch size: samples of an optimiser step."""
        return self.training.batch or self.task.practice.batch

    @property
    def config(self) -> Any:
        """Return the network's configuration."""
        return find_configuration(self.task, self.network)

    def build_network(self) -> Any:
        """Return a network with initial weights drawn from the seed."""
        return build_network(self.task, self.config, self.seed)

    def schedule(self, rounds: int, steps: int, *names: str, earlier: int = 0) -> Schedule:
        """Return the clients' schedule of `rounds` rounds with `steps` local steps; `names` seed the stream.

        The learning rate falls over the first rounds after pretraining; where there were `earlier` ones, it stays at
        its end. Begun anew it costs what the earlier rounds reached: reproductions/runs/retraining.
        """
        rate, training = self.task.practice.learning_rate, self.training
        first = training.final_rate if earlier else training.local_rate
        return Schedule(rounds, steps, first * rate, training.final_rate * rate, derive_seed(self.seed, *names))


def choose_uploads(pools: Mapping[str, Sequence[int]], samples: int, seed: int) -> dict[str, tuple[int, ...]]:
    """Draw the frames to upload at random from the union of all regions' pools; return them by region."""
    every = [(region, frame) for region, frames in pools.items() for frame in frames]
    drawn = np.sort(stream(seed, "upload").permutation(len(every))[:samples])
    chosen: dict[str, list[int]] = {region: [] for region in pools}
    for number in drawn:
        region, frame = every[number]
        chosen[region].append(frame)
    return {region: tuple(frames) for region, frames in chosen.items()}


def choose_planned_uploads(
    pools: Mapping[str, Mapping[str, Sequence[int]]], uploads: Mapping[str, int], seed: int
) -> dict[str, tuple[int, ...]]:
    """Draw the frames that each vehicle uploads from its own, as many as `uploads` says; return them by region.

    pools: by region the frames of each vehicle, "region/vehicle".
    """
    chosen: dict[str, tuple[int, ...]] = {}
    for region, vehicles in pools.items():
        drawn = [
            frames[number]
            for name, frames in vehicles.items()
            for number in stream(seed, "upload", name).permutation(len(frames))[: uploads.get(name, 0)]
        ]
        chosen[region] = tuple(sorted(drawn))
    return chosen


def upload_samples(
    book: Ledger, task: Task, config: Any, region: str, pool: Frames, chosen: Sequence[int]
) -> Sequence[Any]:
    """Return the samples of frames as they reach the cloud: from vehicle to edge server (wireless), then by wireline.

    Samples of a task without messages of its own are read from the recording, each on access.
    """
    shared, received = as_shared(task), []
    about: Any = {"stage": PRETRAIN, "task": task.name, "direction": "up"}
    for frame, message in zip(chosen, shared.pack_samples(pool.data, config, chosen), strict=True):
        key = pool.data.keys[frame]
        at_edge = send(book, message, **about, link="wireless", client=f"{key.scene}/{key.agent}")
        received.append(send(book, at_edge, **about, link="wireline", client=region))
    samples = shared.unpack_samples(received, config)
    return task.samples(pool.data, config, chosen) if samples is None else samples


def pretrain(
    learning: Learning, samples: Sequence[Any], validation: Sequence[Frames], folder: Path, report: Report
) -> tuple[Validated, ...]:
    """Pretrain with the task's schedule of the learning rate; return the validations on the way.

    Writes the weights of the last step. An interrupted training resumes after its last validation.
    """
    task, steps = learning.task, learning.training.steps
    every = max(steps // VALIDATIONS, min(APART, steps))
    network = learning.build_network()
    history = train(
        task,
        network,
        samples,
        steps=steps,
        batch=learning.batch,
        seed=derive_seed(learning.seed, PRETRAIN),
        checkpointing=Checkpointing(folder / CHECKPOINT, every),
        validation=Validation(lambda now: mean_score(task, now, validation), every),
        progress=report,
    )
    save_network(task, network, folder / WEIGHTS)
    (folder / CHECKPOINT).unlink()
    means = history.losses[: every * len(history.scores)].reshape(-1, every).mean(axis=1)
    return tuple(
        Validated(every * number, float(loss), float(score))
        for number, (loss, score) in enumerate(zip(means, history.scores, strict=True), start=1)
    )


def mean_score(task: Task, network: Any, splits: Sequence[Frames]) -> float:
    """Return the task's measure on the vehicles' frames, as the mean over `splits`."""
    return float(np.mean([score_network(task, network, split.data, split.vehicles) for split in splits]))


def train_centrally(
    learning: Learning, network: Any, samples: Sequence[Any], rounds: int, clients: int, name: str
) -> tuple[float, ...]:
    """Train centrally, in place, for as many steps as a federation of `clients` takes in `rounds`, at the same rates.

    Returns the mean loss of each round.
    """
    schedule = learning.schedule(rounds, learning.training.local_steps * clients, "more", name)
    losses = []
    for round_ in range(1, rounds + 1):
        work = schedule.work(round_)
        losses.append(
            train_steps(
                learning.task,
                network,
                samples,
                steps=work.steps,
                batch=learning.batch,
                learning_rate=work.learning_rate,
                seed=work.seed,
            )
        )
    return tuple(losses)


def make_clients(learning: Learning, config: Any, samples: Mapping[str, Sequence[Any]]) -> dict[str, TaskClient]:
    """Return a federation's clients by vehicle; vehicles without samples are left out."""
    return {
        name: TaskClient(learning.task, config, samples[name], batch=learning.batch)
        for name in sorted(samples)
        if len(samples[name])
    }


def give_outputs(clients: Mapping[str, TaskClient], shared: SharedSamples, start: Weights) -> dict[str, OutputClient]:
    """Return clients that send outputs on `shared` samples, and begin with a network of the weights `start`."""
    return {name: OutputClient(client, shared, start) for name, client in clients.items()}


@dataclass(frozen=True)
class RegionStart:
    """Where a region's edge server starts in stage III."""

    clients: Mapping[str, TaskClient]  # its vehicles, by name
    weights: Weights  # of stage II
    earlier: int  # rounds of stage II


@dataclass(frozen=True)
class Strategies:
    """Strategies of stage III: of edge servers with their vehicles, and of the cloud with edge servers."""

    edge: Strategy
    cloud: Strategy


def describe_federation(strategy: Strategy | Strategies, rules: Rules) -> str:
    """Return strategies and rules, as far as they are not the defaults, in words: what a checkpoint is of."""
    changed = rules.model_dump(mode="json", include=set(Rules.model_fields), exclude_defaults=True)
    return f"{strategy} by {json.dumps(changed)}" if changed else str(strategy)


def federate_edge(
    learning: Learning,
    network: Any,
    clients: Mapping[str, TaskClient],
    schedule: Schedule,
    strategy: Strategy,
    rules: Rules,
    earlier: int,
    book: Ledger,
    folder: Path,
    report: Report,
    outages: Mapping[tuple[int, str], Outage] = {},
    validation: Mapping[str, Frames] = {},
    processes: int = 1,
    runtime: str = "embedded",
    replanning: Replanning | None = None,
    shared: SharedSamples | None = None,
    before_round: OnStart = _begin,
) -> tuple[float, ...]:
    """Run the rounds of stage II of a region from `network`; write weights and ledger, return each round's loss.

    A privacy budget, which `earlier` rounds with the same vehicles count against, may end it before the schedule's end.
    After each round the network that a federation of so many rounds ends with is scored on `validation`, frames by
    region. Vehicles train in so many `processes` of a `runtime` of `RUNTIMES`, to the same weights.
    The vehicles that `outages` name by round are lost in it. Under `replanning` the number of rounds, who joins them
    and who is lost are those of the plan before each. With `shared` samples vehicles send outputs on these.
    `before_round` is called before each round with its number and the weights that it begins with.
    """
    state, task, averaged = FederationState(), learning.task, learning.training.average_rounds
    share = 0.0 if earlier else learning.training.start_share

    def score(round_: int) -> Mapping[str, float]:
        reached = load_round_network(task, network, folder, round_, averaged, share)
        return {name: score_network(task, reached, own.data, own.vehicles) for name, own in validation.items()}

    identity = describe_federation(strategy, rules)
    scored = score if validation else None
    federating = FederationCheckpoints(task, folder, book, report, {EDGE: state}, identity, scored)
    start, done = federating.resume(to_arrays(network))
    account = Account(book, EDGE, task.name, "wireless", outages)
    how: Any = {"strategy": strategy, "state": state, "earlier": earlier}
    run, asked = (
        (federate, clients)
        if shared is None
        else (partial(federate_outputs, shared), give_outputs(clients, shared, to_arrays(network)))
    )

    def afford(rounds: int) -> int:
        privacy = rules.privacy
        return rounds if privacy is None else affordable_rounds(privacy, rules.selection, [*clients], rounds, earlier)

    with open_runtime(runtime, asked, processes) as where:
        how["runtime"] = where
        if replanning is None:
            save, last = federating.make_saver(schedule.rounds), afford(schedule.rounds)

            def keep(round_: int, weights: Weights, loss: float) -> None:
                save(round_, weights, loss)
                if round_ < last:
                    before_round(round_ + 1, weights)

            if done < last:
                before_round(done + 1, start)
            run(asked, start, schedule, account, **how, rules=rules, done=done, on_round=keep)
        else:
            course = replanning.course

            def run_round(weights: Weights, number: int, driven: Driven) -> LocalUpdate | None:
                if afford(number) < number:
                    return None
                before_round(number, weights)
                own, lossy = course.schedule(schedule, number), replace(account, outages=driven.outages)
                keep = federating.make_saver(course.rounds)
                given: Any = {**how, "rules": driven.rules, "done": number - 1, "on_round": keep}
                return run(asked, weights, own, lossy, **given)

            replanning.run(start, done, federating.scores, run_round)
    federating.finish(network, len(federating.losses), averaged, share)
    return tuple(federating.losses)


def federate_cloud(
    learning: Learning,
    network: Any,
    regions: Mapping[str, RegionStart],
    rounds: int,
    edge_rounds: int,
    strategies: Strategies,
    rules: Rules,
    book: Ledger,
    folder: Path,
    report: Report,
    outages: Mapping[tuple[int, str], Outage] = {},
    validation: Mapping[str, Frames] = {},
    replanning: Replanning | None = None,
    shared: SharedSamples | None = None,
) -> tuple[float, ...]:
    """Run stage III from `network`; `regions`: where each edge server starts.

    An edge server runs `edge_rounds` rounds in a cloud round, by `rules`; the cloud's rounds need all edge servers, and
    an edge round loses the vehicles that `outages` names. Writes weights and ledger, returns each round's loss. Where
    rules make arrays personal, the weights have the mean of the regions' own, and each region's model is beside them,
    as are regional models. Validation and `replanning` are as in `federate_edge`. With `shared` samples vehicles, which
    begin with their region's weights, send outputs.
    """
    state, own_states = FederationState(), {region: FederationState() for region in regions}
    states = {CLOUD: state, **{f"{EDGE}/{region}": own for region, own in own_states.items()}}
    averaged = learning.training.average_rounds

    def afford(rounds: int) -> int:
        for own in regions.values() if rules.privacy is not None else ():
            rounds = min(rounds, afford_cloud_rounds(rules, [*own.clients], rounds, edge_rounds, own.earlier))
        return rounds

    def score(round_: int) -> Mapping[str, float]:
        reached = load_round_network(learning.task, network, folder, round_, averaged)
        return {name: score_network(learning.task, reached, own.data, own.vehicles) for name, own in validation.items()}

    rounds = afford(rounds)
    identity = describe_federation(strategies, rules)
    scored = score if validation else None
    federating = FederationCheckpoints(learning.task, folder, book, report, states, identity, scored)
    rules.check_personal(to_arrays(network))
    start, done = federating.resume(to_arrays(network))
    wireless = Account(book, CLOUD, learning.task.name, "wireless", outages)
    wireline = Account(book, CLOUD, learning.task.name, "wireline")
    servers = {
        region: EdgeServer(
            own.clients if shared is None else give_outputs(own.clients, shared, own.weights),
            edge_rounds,
            wireless,
            own.weights,
            cloud_rounds_done=done,
            strategy=strategies.edge,
            rules=rules,
            state=own_states[region],
            earlier=own.earlier,
            distiller=shared,
        )
        for region, own in regions.items()
    }
    earlier = max(own.earlier for own in regions.values())
    schedule = learning.schedule(rounds, learning.training.local_steps, CLOUD, "", earlier=earlier)

    def make_saver(rounds: int) -> OnRound:
        keep = federating.make_saver(rounds)

        def keep_whole(round_: int, weights: Weights, loss: float) -> None:
            personal = [own.personal for own in own_states.values() if own.personal and rules.personal_arrays]
            keep(round_, {**weights, **(average(personal, [1.0] * len(personal)) if personal else {})}, loss)

        return keep_whole

    how: Any = {"strategy": strategies.cloud, "rules": rules.of_servers(), "state": state}
    if replanning is None:
        federate(servers, start, schedule, wireline, **how, done=done, on_round=make_saver(rounds))
    else:
        course = replanning.course

        def run_round(weights: Weights, number: int, driven: Driven) -> LocalUpdate | None:
            if afford(number) < number:
                return None
            for server in servers.values():
                server.rules, server.account = driven.rules, replace(wireless, outages=driven.outages)
            asked: Any = {**how, "done": number - 1, "on_round": make_saver(course.rounds)}
            return federate(servers, weights, course.schedule(schedule, number), wireline, **asked)

        replanning.run(start, done, federating.scores, run_round)
    federating.finish(network, len(federating.losses), averaged)
    for region, own in own_states.items() if rules.personal else ():
        model = load_stage_network(learning.task, folder)
        from_arrays(model, {**to_arrays(model), **own.personal})
        save_network(learning.task, model, folder / regional_weights(region))
    return tuple(federating.losses)


def share_budget(budget: Budget, planned: Mapping[str, tuple[float, float]], task: str) -> Budget:
    """Return a task's share of both budgets, in proportion to its planned traffic [MB wireless, wireline].

    Shares are rounded down to bytes, so that their sum never exceeds the budget.
    """
    parts = []
    for link, whole_mb in enumerate((budget.wireless_mb, budget.wireline_mb)):
        total = sum(each[link] for each in planned.values())
        share = planned[task][link] / total if total else 1 / len(planned)
        parts.append(whole_mb if len(planned) == 1 else np.floor(share * whole_mb * 1e6) / 1e6)
    return Budget(*map(float, parts))


def region_budget(stage_one: Ledger, vehicles: Mapping[str, int], region: str) -> Budget:
    """Return the budget of a region's stage II: its share, by vehicles, of the wireless budget that stage I left."""
    share = vehicles[region] / sum(vehicles.values())
    return Budget(share * stage_one.left_mb("wireless"), 0.0)


def regional_weights(region: str) -> str:
    """Return the name of the file of a region's own model, of a stage III with personal arrays."""
    return f"weights-{region}.safetensors"


def load_stage_network(task: Task, folder: Path, region: str | None = None) -> Any:
    """Return the trained network of the stage in `folder`; with a `region` its own model."""
    return load_network(task, folder / (WEIGHTS if region is None else regional_weights(region)))
