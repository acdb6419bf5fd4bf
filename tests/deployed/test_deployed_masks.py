"""Servers and vehicles that lie, on a fleet that is up: masks, claims of a budget, and a network that is to stay."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from fleet_clients import Imitator, Liar, Walker
from flwr.app import ConfigRecord, Message, MessageType, RecordDict

from flcav.federation.acceptance import Expected, read_masked
from flcav.federation.client import ClientAgreement
from flcav.federation.links.flower_grid import DeployedGrid
from flcav.federation.links.metered import Account, open_account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import draw_secret
from flcav.federation.rules import Rules
from flcav.federation.secure.messages import SecureSum
from flcav.federation.secure.parties import SecureClient
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, strategy_named
from flcav.federation.wire import ARRAYS, ASK, CONFIG, LocalWork, to_array_record
from flcav.network.ledger import Ledger, LinkMegabytes

NOISY = {"secure": {}, "privacy": {"where": "local", "clip": 1, "noise": 4}}
ANSWER_S = 60.0


class Server:
    """A server that asks vehicles whatever it likes."""

    def __init__(self, grid: DeployedGrid, weights: Mapping[str, np.ndarray]) -> None:
        self.grid, self.weights = grid, weights

    def ask(self, asks: Mapping[str, ConfigRecord], seed: int = 7, kind: str = MessageType.TRAIN) -> dict[str, Any]:
        """Return by client its answer, or why there is none."""
        nodes = {name: node for node, name in self.grid.names.items()}
        about = {CONFIG: LocalWork(1, 1, 0.1, seed).record(), ARRAYS: to_array_record(self.weights)}
        sent = (Message(RecordDict({**about, ASK: ask}), nodes[name], kind) for name, ask in asks.items())
        return {
            self.grid.names[reply.metadata.src_node_id]: reply.content if reply.has_content() else reply.error.reason
            for reply in self.grid.send_and_receive(sent, timeout=ANSWER_S)
        }

    def exchange(self, asks: Mapping[str, ConfigRecord], read: Any) -> dict[str, Any]:
        return {name: read(name, answer) for name, answer in self.ask(asks).items()}


def test_a_server_neither_invents_vehicles_nor_begins_a_round_of_masks_anew_with_another_training(
    clients, weights, deployment
):
    rules = Rules.model_validate(NOISY).settle_threshold([*clients], certified=True)
    agreed = ClientAgreement(FEDAVG, rules, {name: draw_secret() for name in clients}, 0)
    with deployment.open(clients, agreed, {}, open_account()) as grid:
        server = Server(grid, weights)
        one = next(iter(clients))
        keys = dict(server.ask({one: ConfigRecord({ASK: "keys"})})[one].config_records[ASK])
        evil = [SecureClient.draw(name).keys for name in ("e1", "e2")]
        lists: Any = {
            "names": [one, "e1", "e2"],
            "ciphers": [keys["ciphers"], *(each.cipher for each in evil)],
            "masks": [keys["masks"], *(each.mask for each in evil)],
            "certificates": [keys["certificates"]] * 3,
            "signatures": [keys["signatures"]] * 3,
        }
        told = server.ask({one: ConfigRecord({ASK: "shares", **lists, "threshold": 2})})[one]
        assert "'e1' takes part with keys that no certified vehicle has signed" in told

        expected = Expected(rules, weights)
        for seed, begun in ((7, True), (8, False)):
            total = SecureSum(server.exchange, 2, 1, grid.authority)
            answers = server.ask(total.agree([*clients]), seed)
            if begun:
                masked = {name: read_masked(answer, expected, [*clients]) for name, answer in answers.items()}
                assert {each.samples for each in masked.values()} == {1}  # type: ignore[union-attr]
            else:
                assert all("another training of round 1 than that whose update" in told for told in answers.values())


LIES = {
    "over the budget": r"no answer, as if \d+ bytes were too few for it",
    "lost by the network": r"an answer of \d+ bytes, and \d+ are left",
    "large": r"an answer of 2\d+ bytes, where \d+ were granted",
    "raises": "no power",
}


@pytest.mark.parametrize("lie", LIES)
def test_a_vehicle_that_lies_about_its_answer_is_named_and_the_round_goes_on(lie, weights, deployment):
    clients = {"town/cav0": Walker(1), "town/cav1": Liar(2, lie=lie), "town/cav2": Walker(3)}
    account = Account(Ledger(LinkMegabytes(1000, 10)), "edge", "test", "wireless")
    state = FederationState()
    found = federate(clients, weights, Schedule(1, 2, 0.1, 0.05, 7), account, state=state, runtime=deployment)
    (record,) = state.records
    assert record.clients == ("town/cav0", "town/cav2")
    assert record.failed.keys() == {"town/cav1"}
    assert re.search(LIES[lie], record.failed["town/cav1"])
    assert all(np.isfinite(array).all() for array in found.weights.values())
    assert account.ledger.used_mb("wireless") < 0.01


def test_networks_of_vehicles_that_send_outputs_stay_there_and_go_on(deployment):
    """Two federations after one another, as a region's rounds in stages II and III."""
    start = {"w": np.arange(5, dtype=np.float32)}
    found = []
    for runtime in (None, deployment):
        state, network = FederationState(), start
        for seed in (7, 8):
            clients = {f"town/cav{number}": Imitator(number / 4) for number in range(3)}
            about = {"state": state, "runtime": runtime, "distiller": Imitator(), "strategy": strategy_named("fedmd")}
            network = federate(clients, network, Schedule(1, 1, 0.1, 0.1, seed), **about).weights
        found.append((network, state.clients))
    (embedded, near), (deployed, far) = found
    np.testing.assert_array_equal(embedded["w"], deployed["w"])
    assert {kind for own in near.values() for kind in own} == {"own"}
    assert {kind for own in far.values() for kind in own} == {"own-digests"}
