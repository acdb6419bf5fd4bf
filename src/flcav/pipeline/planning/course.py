"""The course of a stage whose rest is planned anew after each round: its rounds, one by one, and its plans."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flcav.federation.rules import Rules
from flcav.federation.runtimes.metered import Outage
from flcav.federation.stages import Schedule
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.network.ledger import BYTES_PER_MB, LINKS, Ledger
from flcav.network.plan import Price
from flcav.pipeline.frames import Frames
from flcav.pipeline.planning.rounds import Replan
from flcav.pipeline.recipe import EDGE
from flcav.pipeline.results.plans import RoundPlan, TaskPlan


class Course:
    """The course of a stage: its plan, made anew after each round, and the number of rounds by the plan before each."""

    def __init__(self, plan: TaskPlan, planner: Replan, book: Ledger, most: int | None = None) -> None:
        """Begin with `plan`; `book` is the stage's ledger. most: rounds of the federation that is followed."""
        self.plan, self._planner, self._book, self._most = plan, planner, book, most
        self.made: list[RoundPlan] = []
        self._planned = [planner.terms.rounds(plan)]

    @property
    def rounds(self) -> int:
        """Return the number of rounds of the stage by the plan of now."""
        return self._planned[-1] if self._most is None else min(self._planned[-1], self._most)

    def schedule(self, schedule: Schedule, number: int) -> Schedule:
        """Return the schedule that ends with the round `number`, at the rates of the plans before each round."""
        return replace(schedule, rounds=number, planned=tuple(self._planned[:number]))

    def go_on(self, done: int, reached: float | None) -> None:
        """Plan the rest anew after the round `done`."""
        terms, sent = self._planner.terms, self._sent(done)
        self.plan = self._planner.replan(self.plan, done, reached, sent)
        self._planned.append(max(terms.rounds(self.plan), done))
        self.made.append(RoundPlan(done, reached, terms.price(self.plan, done), sent, self.plan))

    def _sent(self, done: int) -> Price:
        """Return what was sent upwards until the end of the round `done`; the ledger may hold later rounds."""
        terms = self._planner.terms
        sent = dict.fromkeys(LINKS, 0)
        for entry in self._book.entries:
            last = done if terms.stage == EDGE or entry.link == "wireline" else terms.k * done
            if entry.direction == "up" and (entry.stage != terms.stage or entry.round <= last):
                sent[entry.link] += entry.bytes
        return Price(sent["wireless"] / BYTES_PER_MB, sent["wireline"] / BYTES_PER_MB)


class Driven(Protocol):
    """Rounds of a stage: by which rules, and whom the network loses, by round and client."""

    @property
    def rules(self) -> Rules:
        """Return the rules of the rounds."""
        ...

    @property
    def outages(self) -> Mapping[tuple[int, str], Outage]:
        """Return who is lost and why, by round, from 1, and client."""
        ...


@dataclass(frozen=True)
class Replanning:
    """A stage whose rest is planned anew after each round: its course, and how a plan is carried out."""

    course: Course
    drive: Callable[[TaskPlan, int], Driven]  # of the first rounds by a plan, so many
    score: Callable[[Mapping[str, float]], float | None]  # of a round, from the scores by region

    def run(
        self,
        weights: Weights,
        done: int,
        scores: Sequence[Mapping[str, float]],
        run_round: Callable[[Weights, int, Driven], LocalUpdate | None],
    ) -> None:
        """Run the rounds after the first `done` one by one, each followed by a plan of the rest.

        scores: of each round by region, to which `run_round` adds. It returns None for a round that a privacy budget
        does not afford, which is the end.
        """
        for number in range(1, done + 1):
            self.course.go_on(number, self._reached(scores, number))
        while done < self.course.rounds:
            update = run_round(weights, done + 1, self.drive(self.course.plan, done + 1))
            if update is None:
                return
            weights, done = update.weights, done + 1
            self.course.go_on(done, self._reached(scores, done))

    def _reached(self, scores: Sequence[Mapping[str, float]], number: int) -> float | None:
        return self.score(scores[number - 1]) if scores else None


def mean_by_frames(scores: Mapping[str, float], watched: Mapping[str, Frames]) -> float:
    """Return the mean of the regions' scores, weighted by the numbers of frames `watched` in them."""
    return float(
        np.average([scores[name] for name in watched], weights=[len(own.vehicles) for own in watched.values()])
    )
