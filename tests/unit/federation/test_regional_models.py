"""Regional models: pulled to the cloud's model, which is their mean, and never replaced by it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError
from flcav.federation.checks import check_rules
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies import strategy_named
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.ledger import Ledger, LinkMegabytes

START = {"w": np.zeros(500, np.float64)}
GOALS = {"grid": 1.0, "ring": 5.0}
RATE, EDGE_ROUNDS = 0.1, 2


@dataclass
class Descent:
    """Gradient descent of (w - goal)^2 / 2."""

    goal: float

    def train(
        self,
        weights: Weights,
        *,
        steps: int,
        learning_rate: float,
        seed: int,
        proximal: float = 0.0,
        centre: Weights | None = None,
    ) -> LocalUpdate:
        w = weights["w"]
        about = (weights if centre is None else centre)["w"]
        for _ in range(steps):
            w = w - learning_rate * (w - self.goal + proximal * (w - about))
        return LocalUpdate({"w": w}, 1, 0.0)


def run(pull: float, rounds: int, done: int, start: Weights, states: dict[str, FederationState]) -> Any:
    book, rules = Ledger(LinkMegabytes(1.0, 1.0)), Rules.model_validate({"personal": {"pull": pull}})
    wireless, wireline = (Account(book, "cloud", "t", link) for link in ("wireless", "wireline"))
    servers: dict[str, Trainable] = {
        region: EdgeServer(
            {f"{region}/cav0": Descent(goal)},
            EDGE_ROUNDS,
            wireless,
            START,
            cloud_rounds_done=done,
            rules=rules,
            state=states[region],
        )
        for region, goal in GOALS.items()
    }
    schedule = Schedule(rounds, 3, RATE, RATE, 3)
    found = federate(servers, start, schedule, wireline, rules=rules.of_servers(), done=done)
    return found.weights, book


def new_states() -> dict[str, FederationState]:
    return {region: FederationState() for region in GOALS}


@pytest.mark.parametrize("pull", [0.0, 0.7, 4.0])
def test_each_region_s_model_descends_its_own_loss_and_the_pull(pull: float) -> None:
    states = new_states()
    weights, book = run(pull, 3, 0, START, states)
    own, cloud = dict.fromkeys(GOALS, 0.0), 0.0
    for round_ in range(3):
        for region, goal in GOALS.items():
            for _ in range(3 * EDGE_ROUNDS):
                own[region] -= RATE * (own[region] - goal + (pull if round_ else 0.0) * (own[region] - cloud))
        cloud = sum(own.values()) / 2
    np.testing.assert_allclose(weights["w"], cloud, rtol=1e-12)
    for region, model in own.items():
        np.testing.assert_allclose(states[region].personal["w"], model, rtol=1e-12)
    down = [e.bytes for e in book.entries if (e.link, e.direction, e.client) == ("wireless", "down", "grid/cav0")]
    up = [e.bytes for e in book.entries if (e.link, e.direction, e.client) == ("wireless", "up", "grid/cav0")]
    assert down[2] - down[0] > START["w"].nbytes  # from the second cloud round on, the cloud's model comes along
    assert np.ptp(up) < 50


def test_the_pull_brings_regions_together() -> None:
    apart = []
    for pull in (0.0, 1.0, 5.0):
        states = new_states()
        run(pull, 6, 0, START, states)
        apart.append(abs(states["ring"].personal["w"][0] - states["grid"].personal["w"][0]))
    assert apart[0] > apart[1] > apart[2]


def test_a_killed_federation_goes_on_with_each_region_s_model() -> None:
    whole, first = new_states(), new_states()
    weights, _ = run(1.0, 3, 0, START, whole)
    middle, _ = run(1.0, 1, 0, START, first)
    restored = new_states()
    for region, state in restored.items():
        state.restore(first[region].to_arrays(), first[region].records)
    again, _ = run(1.0, 3, 1, middle, restored)
    np.testing.assert_array_equal(again["w"], weights["w"])
    for region, state in restored.items():
        np.testing.assert_array_equal(state.personal["w"], whole[region].personal["w"])


def test_what_cannot_be_combined_is_one_sentence() -> None:
    rules = Rules.model_validate({"personal": {"pull": 0.1}})
    for name in ("fedprox", "scaffold"):
        with pytest.raises(InputError, match="corrects local steps, and so does the pull of regional models"):
            check_rules(strategy_named(name), rules, ["cav0", "cav1"])
    for name in ("fedavg", "fedadam", "median"):
        check_rules(strategy_named(name), rules, ["cav0", "cav1"])
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        Rules.model_validate({"personal": {"pull": -1}})

    class Plain:
        def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
            return LocalUpdate(weights, 1, 0.0)

    account = Account(Ledger(LinkMegabytes(1.0, 1.0)), "edge", "t", "wireless")
    with pytest.raises(InputError, match="personal: needs clients whose training takes 'proximal', and that of cav0"):
        federate({"cav0": Plain()}, START, Schedule(1, 1, 0.1, 0.1, 3), account, rules=rules)
