"""A deployed federation ends with the weights of the embedded one, bit by bit, by every strategy and every rule."""

import os

import numpy as np
import pytest
from fleet_clients import Walker

from flcav.federation.links.flower import RegionalDeployment
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.state import FederationState
from flcav.federation.strategies import STRATEGIES, strategy_named
from flcav.federation.upload import Upload
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes

SCHEDULE = Schedule(2, 2, 0.1, 0.05, 7)


def both(clients, weights, deployment, **how):
    """Return weights, records and ledger of the federation in this process, and of the deployed one."""
    found = []
    for runtime in (None, deployment):
        account = Account(Ledger(LinkMegabytes(10, 10)), "edge", "test", "wireless")
        state = FederationState()
        ended = federate(clients, weights, SCHEDULE, account, state=state, runtime=runtime, **how)
        found.append((ended.weights, state.records, account.ledger.entries))
    return found


def check_same(embedded, deployed):
    for name, array in embedded[0].items():
        np.testing.assert_array_equal(array, deployed[0][name])
    assert embedded[1] == deployed[1]
    assert embedded[2] == deployed[2]


@pytest.mark.parametrize("name", [name for name in STRATEGIES if name != "fedmd"])
def test_strategies(name, clients, weights, deployment):
    settings = {"krum": {"krum": {"byzantine": 0}}, "trimmed-mean": {"trimmed-mean": {"fraction": 0.34}}}.get(
        name, name
    )
    check_same(*both(clients, weights, deployment, strategy=strategy_named(settings)))


@pytest.mark.parametrize(
    "rules",
    [
        Rules(upload=Upload(compression="top-k")),
        Rules(privacy=Privacy(noise=1.0, clip=0.5, where="local", seeded=True)),
    ],
    ids=["top-k", "local-noise"],
)
def test_rules(rules, clients, weights, deployment):
    check_same(*both(clients, weights, deployment, rules=rules))


def test_the_edge_server_s_own_client_trains_here(clients, weights, deployment, tmp_path):
    """A roadside unit beside two deployed vehicles."""
    log = tmp_path / "log"
    clients = {**clients, "town/cav2": Walker(3, log)}
    partly = RegionalDeployment(deployment.folder, {"town": 2}).beside({"town/cav2"})
    check_same(*both(clients, weights, partly, strategy=strategy_named("scaffold")))
    assert {line.split()[1] for line in log.read_text().splitlines()} == {str(os.getpid())}
    assert len(log.read_text().splitlines()) == 2 * SCHEDULE.rounds


def test_masks(clients, weights, deployment):
    """Masks are drawn anew by each vehicle, and the sum is the same."""
    embedded, deployed = both(clients, weights, deployment, rules=Rules(secure=SecureAggregation()))
    for name, array in embedded[0].items():
        np.testing.assert_array_equal(array, deployed[0][name])


def test_update_over_the_budget_is_not_sent(clients, weights, deployment):
    """The budget affords the requests alone: the vehicles keep their answers, so that nothing enters the uplink."""
    account = Account(Ledger(LinkMegabytes(1000e-6, 10)), "edge", "test", "wireless")
    with pytest.raises(BudgetExceeded, match="an answer of"):
        federate(clients, weights, SCHEDULE, account, runtime=deployment)
    assert {entry.direction for entry in account.ledger.entries} == {"down"}
