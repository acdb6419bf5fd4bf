"""Differential privacy of a run: rounds that a budget affords, and epsilon of all trainings with a vehicle's data."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from flcav.federation.modes.buffered import count_participations
from flcav.federation.privacy import affordable_rounds, compose_epsilon, find_noise
from flcav.federation.rules import Rules
from flcav.federation.strategies import fills_buffers
from flcav.runs.recipe import CLOUD, Federation
from flcav.runs.results.training import PrivacySpent, StageResult

RulesT = TypeVar("RulesT", bound=Rules)


@dataclass(frozen=True)
class PrivateTraining:
    """The rounds of one training of a task with the vehicles of a region, stages II and III together."""

    region: str
    clients: int  # number of vehicles
    rounds: int  # edge rounds
    noise: float | None = None  # multiplier found for them; None: it was given


class PrivateRounds(NamedTuple, Generic[RulesT]):
    """Rules with noise, and the edge rounds of stages II and III that their privacy budget affords."""

    rules: RulesT
    edge: int
    further: int  # edge rounds in stage III, or instead of it


def plan_private_rounds(
    rules: RulesT, clients: Iterable[int], edge: int, further: int, at_once: int
) -> PrivateRounds[RulesT]:
    """Return the rounds that a privacy budget affords in every region, divided between the stages as they are planned.

    `clients`: numbers of vehicles by region. `at_once`: edge rounds of a cloud round, of which the further rounds are a
    multiple. Rules without a noise multiplier get the one for all of these rounds. Raises `InputError` where a region's
    budget affords no round.
    """
    privacy = rules.privacy
    most = edge + further
    if privacy is None or privacy.epsilon is None:
        return PrivateRounds(rules, edge, further)
    numbers = sorted(set(clients))
    # One multiplier for all regions: the largest that any of them needs.
    found = (find_noise(privacy, rules.selection, count, most) for count in numbers)
    private = max(found, key=lambda noisy: noisy.deviation)
    for count in numbers:
        names = [str(number) for number in range(count)]
        most = min(most, affordable_rounds(private, rules.selection, names, most, 0))
    if most < edge + further:  # both stages are cut in proportion, stage III in whole cloud rounds
        further = most * further // (edge + further) // at_once * at_once
        edge = min(edge, most - further)
    return PrivateRounds(rules.model_copy(update={"privacy": private}), edge, further)


def find_budget_noise(asked: Rules, private: Rules) -> float | None:
    """Return the noise multiplier found for the privacy budget; None if the rules give it, or have no privacy."""
    if asked.privacy is None or asked.privacy.noise is not None or private.privacy is None:
        return None
    return private.privacy.noise


def take_noise(rules: RulesT, noise: float | None) -> RulesT:
    """Return rules with this noise multiplier; unchanged for None."""
    if rules.privacy is None or noise is None:
        return rules
    return rules.model_copy(update={"privacy": rules.privacy.model_copy(update={"noise": noise})})


def count_private_rounds(how: Federation, results: Mapping[str, StageResult], region: str) -> int:
    """Return the edge rounds of a region that count against a vehicle's privacy, from `results` by stage.

    They are all rounds; in buffered rounds, by stage, those of the vehicle that took part most often.
    """
    k = how.edge_rounds_per_cloud_round
    if not fills_buffers(how.strategy):
        return sum(result.rounds * (k if stage == CLOUD else 1) for stage, result in results.items())
    of_stage = [[record for record in result.records or () if record.server == region] for result in results.values()]
    counts = [count_participations([(record.clients, [*record.failed]) for record in stage]) for stage in of_stage]
    return sum(max(by_vehicle.values(), default=0) for by_vehicle in counts)


def compose_trainings(rules: Rules, trainings: Iterable[PrivateTraining]) -> PrivacySpent | None:
    """Return the privacy spent by a vehicle in all trainings of its region, the maximum over regions.

    Its data are the same in all tasks and trainings, so that their losses of privacy are composed. None without noise,
    or without a round.
    """
    of_region: dict[str, list[PrivateTraining]] = {}
    for training in trainings:
        if training.rounds:
            of_region.setdefault(training.region, []).append(training)
    privacy = rules.privacy
    if privacy is None or not of_region:
        return None
    epsilon = max(
        compose_epsilon(
            privacy,
            rules.selection,
            [(each.clients, each.rounds) for each in together],
            [each.noise for each in together],
        )
        for together in of_region.values()
    )
    found = {each.noise for together in of_region.values() for each in together if each.noise is not None}
    return PrivacySpent(epsilon, privacy.delta, privacy.seeded, tuple(sorted(found)) or None)
