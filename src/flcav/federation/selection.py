"""Client selection: which clients take part in a round, and with what probability.

Every round has a separate random stream, so that a resumed federation draws as an uninterrupted one.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flcav.config import Config, InputError
from flcav.statistics.streams import stream

Rule = Literal["all", "uniform", "poisson", "round-robin", "importance", "deadline", "planned"]

LONGEST = 3.0  # cap on norms in importance selection, as a multiple of the clients' median
NEEDED: Mapping[Rule, str | None] = {  # the required field of a rule, which other rules refuse
    "all": None,
    "uniform": "clients",
    "poisson": "probability",
    "round-robin": "clients",
    "importance": "clients",
    "deadline": "deadline_s",
    "planned": None,
}


class Selection(Config):
    """Selection of the clients of a round.

    all: every client. uniform: `clients` of them, drawn without replacement. poisson: each by itself with
    `probability`. round-robin: `clients` of them in turn. importance: `clients` of them in the mean, each by itself
    with a probability that grows with the norm of its update, which all train for and report (Chen et al., TMLR 2022).
    deadline: those whose predicted round time `seconds` is at most `deadline_s` (Nishio and Yonetani, ICC 2019, with
    the bound on the time of a client instead of their sum); `seconds` name every client, or none where a network is to
    predict them. planned: those whose `joins` contain the round; clients that `joins` does not name join every round,
    and where none of those that join is there, all do.

    unbiased: of uniform and poisson, changes are weighted by share of all samples / probability of taking part, so that
    their sum is the Horvitz-Thompson estimate of the mean of all clients (Horvitz and Thompson, JASA 47, 1952; in
    federated averaging scheme II of Li et al., ICLR 2020). Importance selection always is.
    """

    rule: Rule = "all"
    clients: int | None = Field(default=None, ge=1, le=10**6)  # per round
    probability: float | None = Field(default=None, gt=0, le=1)  # that a client takes part in a round
    unbiased: bool = False  # weigh by the inverse of the probability of taking part, of uniform and poisson
    deadline_s: float | None = Field(default=None, gt=0)
    seconds: Mapping[str, Annotated[float, Field(ge=0)]] = {}  # predicted time of a round, by client
    joins: Mapping[str, tuple[int, ...]] = {}  # rounds of a plan, by client

    @model_validator(mode="after")
    def _fields_of_the_rule(self) -> Self:
        needed = NEEDED[self.rule]
        for name in ("clients", "probability", "deadline_s"):
            if (getattr(self, name) is not None) != (name == needed):
                raise ValueError(f"the rule {self.rule} {'needs' if name == needed else 'takes no'} '{name}'")
        if self.unbiased and self.rule not in ("uniform", "poisson"):
            raise ValueError(f"the rule {self.rule} takes no 'unbiased'")
        if self.seconds and self.rule != "deadline":
            raise ValueError(f"the rule {self.rule} takes no 'seconds'")
        if self.joins and self.rule != "planned":
            raise ValueError(f"the rule {self.rule} takes no 'joins'")
        return self

    @property
    def weighs(self) -> bool:
        """Return whether updates are weighted by the inverse of their clients' selection probability."""
        return self.unbiased or self.rule == "importance"

    @property
    def predicts(self) -> bool:
        """Return whether a network has to predict the round times that are compared with a deadline."""
        return self.rule == "deadline" and not self.seconds

    def check_clients(self, names: Sequence[str]) -> None:
        """Raise `InputError` where the rule cannot select among these clients."""
        if self.clients is not None and self.clients > len(names):
            raise InputError(f"selection: {self.clients} clients are wanted in a round, and there are {len(names)}")
        if self.seconds and (unknown := [name for name in names if name not in self.seconds]):
            missing = f"{len(unknown)} of {len(names)} clients, such as {unknown[0]}"
            raise InputError(f"selection: 'seconds' has no time of a round for {missing}")
        if self.rule == "deadline" and not self.choose(names, 1, 0):
            raise InputError(f"selection: no client is predicted to end a round within {self.deadline_s:g} s")

    def choose(self, names: Sequence[str], round_: int, seed: int, earlier: int = 0) -> list[str]:
        """Return the clients of round `round_` (from 1) in their order, among `names` that `check_clients` accepts.

        Round-robin continues after `earlier` rounds of previous federations with the same clients. Importance selection
        returns all, since every client reports its norm, and so does a deadline whose round times are yet to be
        predicted.
        """
        count = self.clients or 0
        rng = stream(seed, "selection")
        match self.rule:
            case "uniform":
                chosen = set(rng.permutation(len(names))[:count].tolist())
            case "poisson":
                assert self.probability is not None
                chosen = set(np.flatnonzero(rng.random(len(names)) < self.probability).tolist())
            case "round-robin":
                chosen = {((earlier + round_ - 1) * count + place) % len(names) for place in range(count)}
            case "deadline":
                assert self.deadline_s is not None
                in_time = [self.predicts or self.seconds[name] <= self.deadline_s for name in names]
                chosen = set(np.flatnonzero(in_time).tolist())
            case "planned":
                chosen = {i for i, name in enumerate(names) if round_ in self.joins.get(name, (round_,))}
                chosen = chosen or set(range(len(names)))
            case _:
                chosen = set(range(len(names)))
        return [name for i, name in enumerate(names) if i in chosen]

    def inclusion_probability(self, clients: int) -> float:
        """Return a client's probability of taking part in a round, one of `clients`, by the rule uniform or poisson."""
        if self.rule == "uniform":
            assert self.clients is not None
            return self.clients / clients
        assert self.probability is not None
        return self.probability

    def draw(self, norms: Mapping[str, float], seed: int) -> dict[str, float]:
        """Return the clients drawn by importance selection, with their probabilities.

        norms: L2 norms of the clients' updates times their shares of all samples, by client. They are capped at
        `LONGEST` times their lower median, so that a minority of clients cannot crowd the others out of the draw by
        reporting large norms. The mean stays unbiased, since its weights are the inverses of the same probabilities.
        """
        assert self.clients is not None
        reported = np.array([*norms.values()])
        # with fewer than half of the clients lying, the lower median lies among the honest reports
        middle = float(np.sort(reported)[(len(reported) - 1) // 2]) if len(reported) else 0.0
        probabilities = optimal_probabilities(np.minimum(reported, LONGEST * middle), self.clients)
        drawn = stream(seed, "importance").random(len(norms)) < probabilities
        return {name: float(p) for name, p, taken in zip(norms, probabilities, drawn, strict=True) if taken}


def optimal_probabilities(norms: NDArray[np.float64], expected: int) -> NDArray[np.float64]:
    """Return the clients' probabilities (clients,) of taking part that minimise the variance of the unbiased mean.

    norms: (clients,) weighted norms u of updates. They sum to at most m = `expected`: p_i = (m + l - n) u_i /
    (u_1 + ... + u_l) for the l smallest of n norms, and 1 for the others, with the largest l for which none is above
    1 (Chen, Horváth and Richtárik, "Optimal Client Sampling for Federated Learning", TMLR 2022, equation 7). Where no
    norm is above 0, all probabilities are equal.
    """
    count = len(norms)
    if expected >= count:
        return np.ones(count)
    if not (norms > 0).any():
        return np.full(count, expected / count)
    order = np.argsort(norms, kind="stable")
    total = np.cumsum(norms[order])
    for small in range(count, 0, -1):
        share = expected + small - count
        if share > 0 and share * norms[order[small - 1]] <= total[small - 1]:
            break
    else:
        raise AssertionError("the smallest norm alone is at most itself")
    found = np.ones(count)
    found[order[:small]] = share * norms[order[:small]] / total[small - 1] if total[small - 1] > 0 else 0.0
    return found
