"""Privacy that a vehicle spends in all trainings with its data: of several tasks, stages and retrainings together."""

from collections.abc import Iterable
from dataclasses import dataclass

from flcav.federation.privacy import compose_epsilon
from flcav.federation.rules import Rules
from flcav.pipeline.results.spending import PrivacySpent


@dataclass(frozen=True)
class Training:
    """The rounds of one training of a task with the vehicles of a region, stages II and III together."""

    region: str
    clients: int
    rounds: int


def compose_trainings(rules: Rules, trainings: Iterable[Training]) -> PrivacySpent | None:
    """Return what a vehicle spends that takes part in every training of its region, the most of all regions.

    None without noise, or without a round.
    """
    of_region: dict[str, list[tuple[int, int]]] = {}
    for each in trainings:
        if each.rounds:
            of_region.setdefault(each.region, []).append((each.clients, each.rounds))
    privacy = rules.privacy
    if privacy is None or not of_region:
        return None
    epsilon = max(compose_epsilon(privacy, rules.selection, each) for each in of_region.values())
    return PrivacySpent(epsilon, privacy.delta, privacy.seeded)
