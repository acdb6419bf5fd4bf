"""Arrays that regions keep for themselves: never averaged between them, never sent to the cloud, kept over a kill."""

from typing import Any

import numpy as np
import pytest

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.ledger import Ledger, LinkMegabytes

START = {
    "body.weight": np.zeros(400, np.float32),
    "norm.running_mean": np.zeros(4, np.float32),
    "head.weight": np.zeros(300, np.float32),
}
RULES = Rules(personal=("head.*", "*.running_*"))


class Step:
    """A client that adds to all arrays, and halves what it started from."""

    def __init__(self, stride: float) -> None:
        self.stride = stride

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        moved = {name: (array / 2 + np.float32(self.stride)).astype(np.float32) for name, array in weights.items()}
        return LocalUpdate(moved, 1, 0.5)


def servers(book: Ledger, states: dict[str, FederationState], done: int = 0) -> dict[str, Trainable]:
    wireless = Account(book, "cloud", "t", "wireless")
    return {
        region: EdgeServer(
            {f"{region}/cav0": Step(stride), f"{region}/cav1": Step(3 * stride)},
            2,
            wireless,
            START,
            cloud_rounds_done=done,
            rules=RULES,
            state=states[region],
        )
        for region, stride in (("grid", 1.0), ("ring", 10.0))
    }


def run(rounds: int, done: int, start: Weights, states: dict[str, FederationState]) -> tuple[Weights, Ledger]:
    book = Ledger(LinkMegabytes(1.0, 1.0))
    account, schedule = Account(book, "cloud", "t", "wireline"), Schedule(rounds, 1, 0.1, 0.1, 3)
    how: Any = {"rules": RULES.of_servers(), "done": done}
    return federate(servers(book, states, done), start, schedule, account, **how).weights, book


def test_heads_and_norms_stay_in_their_region_and_the_body_is_averaged() -> None:
    states = {"grid": FederationState(), "ring": FederationState()}
    weights, book = run(3, 0, START, states)
    body, heads = 0.0, {"grid": 0.0, "ring": 0.0}
    for _ in range(3):  # a region's two edge rounds halve and add the mean stride of its vehicles, 2 or 20, twice
        ends = {}
        for region, mean in (("grid", 2.0), ("ring", 20.0)):
            heads[region] = (heads[region] / 2 + mean) / 2 + mean
            ends[region] = (body / 2 + mean) / 2 + mean
        body = (ends["grid"] + ends["ring"]) / 2
    np.testing.assert_allclose(weights["body.weight"], body, rtol=1e-6)
    np.testing.assert_array_equal(weights["head.weight"], START["head.weight"])  # the cloud has none of them
    for region, head in heads.items():
        assert set(states[region].personal) == {"head.weight", "norm.running_mean"}
        for array in states[region].personal.values():
            np.testing.assert_allclose(array, head, rtol=1e-6)
    ups = {
        link: [e.bytes for e in book.entries if (e.link, e.direction) == (link, "up")]
        for link in ("wireless", "wireline")
    }
    assert max(ups["wireline"]) < 400 * 4 + 500 < 704 * 4 < min(ups["wireless"])  # bodies; whole networks


def test_a_killed_federation_goes_on_with_each_region_s_own() -> None:
    whole = {"grid": FederationState(), "ring": FederationState()}
    weights, _ = run(3, 0, START, whole)
    first = {"grid": FederationState(), "ring": FederationState()}
    middle, _ = run(1, 0, START, first)
    restored = {region: FederationState() for region in first}
    for region, state in restored.items():
        state.restore(first[region].to_arrays(), first[region].records)
    again, _ = run(3, 1, middle, restored)
    for name in START:
        np.testing.assert_array_equal(again[name], weights[name])
    for region, state in restored.items():
        for name, array in whole[region].personal.items():
            np.testing.assert_array_equal(state.personal[name], array)


def test_what_cannot_be_personal_is_one_sentence() -> None:
    Rules().check_personal(START)
    RULES.check_personal(START)
    for personal, said in (
        (("tail.*",), "personal: 'tail.\\*' matches none of 3 arrays, such as 'body.weight'"),
        (("*.weight",), "personal: \\*.weight leave nothing for the regions to average"),
    ):
        with pytest.raises(InputError, match=said):
            Rules(personal=personal).check_personal(START)
