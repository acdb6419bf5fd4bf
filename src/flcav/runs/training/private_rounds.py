"""Privacy of a run: rounds that a budget affords, and what a vehicle spends in all trainings with its data."""

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
    clients: int
    rounds: int
    noise: float | None = None  # found for them; None: it was given


class PrivateRounds(NamedTuple, Generic[RulesT]):
    """Rules with noise, and the edge rounds of stages II and III that their privacy budget affords."""

    rules: RulesT
    edge: int
    further: int  # in stage III, or instead of it


def plan_private_rounds(
    rules: RulesT, clients: Iterable[int], edge: int, further: int, at_once: int
) -> PrivateRounds[RulesT]:
    """Return the rounds that a privacy budget affords in every region, shared by both stages as they are planned.

    clients: of each region. at_once: edge rounds of a cloud round, of which the further rounds are a multiple. Rules
    without noise get that for all of these rounds. Raises `InputError` where a region's budget affords no round.
    """
    privacy, most = rules.privacy, edge + further
    if privacy is None or privacy.epsilon is None:
        return PrivateRounds(rules, edge, further)
    numbers = sorted(set(clients))
    found = (find_noise(privacy, rules.selection, each, most) for each in numbers)
    private = max(found, key=lambda own: own.deviation)
    for each in numbers:
        names = [str(number) for number in range(each)]
        most = min(most, affordable_rounds(private, rules.selection, names, most, 0))
    if most < edge + further:
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
    """Return the edge rounds of a region in which a vehicle took part that took part in all, from `results` by stage.

    Where rounds are buffers, those of the vehicle that took part most often in each stage.
    """
    k = how.edge_rounds_per_cloud_round
    if not fills_buffers(how.strategy):
        return sum(own.rounds * (k if stage == CLOUD else 1) for stage, own in results.items())
    of_region = [[each for each in own.records or () if each.server == region] for own in results.values()]
    counts = [count_participations([(each.clients, [*each.failed]) for each in own]) for own in of_region]
    return sum(max(each.values(), default=0) for each in counts)


def compose_trainings(rules: Rules, trainings: Iterable[PrivateTraining]) -> PrivacySpent | None:
    """Return what a vehicle spends that takes part in every training of its region, the most of all regions.

    None without noise, or without a round.
    """
    of_region: dict[str, list[PrivateTraining]] = {}
    for each in trainings:
        if each.rounds:
            of_region.setdefault(each.region, []).append(each)
    privacy = rules.privacy
    if privacy is None or not of_region:
        return None
    epsilon = max(
        compose_epsilon(
            privacy, rules.selection, [(each.clients, each.rounds) for each in own], [each.noise for each in own]
        )
        for own in of_region.values()
    )
    found = {each.noise for own in of_region.values() for each in own if each.noise is not None}
    return PrivacySpent(epsilon, privacy.delta, privacy.seeded, tuple(sorted(found)) or None)
