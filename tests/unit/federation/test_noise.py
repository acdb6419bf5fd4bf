"""Noise by secrets: how it is distributed, what repeats it, and that neither messages nor the seed tell it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flwr.common.serde import recorddict_to_proto
from regression import ledger
from scipy.stats import kstest

from flcav.federation import loop
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.in_process import EmbeddedGrid
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import (
    SECRET_BYTES,
    Privacy,
    add_noise,
    average_privately,
    clip_change,
    derive_key,
    draw_secret,
    secret_noise,
)
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.selection import Selection
from flcav.federation.state import SERVER, FederationState, RoundRecord
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.federation.upload import Upload
from flcav.federation.wire import ARRAYS, read_arrays
from flcav.statistics.streams import derive_seed, stream

START = {"w": np.zeros((60, 50), np.float32), "b": np.ones(30, np.float32)}
SCHEDULE = Schedule(rounds=3, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=3)
NAMES = [f"cav{i}" for i in range(5)]
POISSON, UNIFORM = Selection(rule="poisson", probability=0.5), Selection(rule="uniform", clients=2)
CENTRAL, LOCAL = Privacy(clip=0.5, noise=0.4), Privacy(where="local", clip=0.5, noise=0.4)
DEVIATION = 0.4 * 0.5
ROUGHLY = 5 / np.sqrt(2 * 3000)  # relative error of a standard deviation of 3000 numbers, five times over


@pytest.fixture(autouse=True)
def no_account(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave epsilon out, whose account takes seconds: `test_privacy.py` has it."""
    monkeypatch.setattr(loop, "account_epsilon", lambda *_: 1.0)


class Mover:
    """Moves every weight by the same length in every round, whatever its seed."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        return LocalUpdate({name: (array + 0.25).astype(np.float32) for name, array in weights.items()}, 2, 0.5)


class Watched(Mover):
    """Moves every weight, notes by which seed, and says that it has as many samples as it is given."""

    def __init__(self, seeds: list[int], samples: int) -> None:
        self.seeds, self.samples = seeds, samples

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        self.seeds.append(seed)
        update = super().train(weights, steps=steps, learning_rate=learning_rate, seed=seed)
        return replace(update, samples=self.samples, loss=float(self.samples))


def run(rules: Rules, state: FederationState, number: int = 3) -> Weights:
    account = Account(ledger(10.0), "edge", "mover", "wireless")
    clients, schedule = {name: Mover() for name in NAMES}, replace(SCHEDULE, rounds=number)
    return federate(clients, START, schedule, account, rules=rules, state=state).weights


def watch(rules: Rules, number: int) -> tuple[list[list[str]], FederationState, Account]:
    """Return who trained in each round of a federation in which vehicles have 1, 4, 16, ... samples."""
    account, state = Account(ledger(90.0), "edge", "mover", "wireless"), FederationState()
    seeds: dict[str, list[int]] = {f"grid/{name}": [] for name in NAMES}
    clients = {name: Watched(own, 4**i) for i, (name, own) in enumerate(seeds.items())}
    schedule = replace(SCHEDULE, rounds=number)
    federate(clients, START, schedule, account, rules=rules, state=state)
    works = [schedule.work(round_).seed for round_ in range(1, number + 1)]
    return [[name for name in seeds if derive_seed(seed, name) in seeds[name]] for seed in works], state, account


def listen(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list that all messages and replies of federations to come are added to."""
    heard: list[Any] = []
    send = EmbeddedGrid.send_and_receive

    def listening(grid: Any, messages: Any, **options: Any) -> Any:
        asked = [*messages]
        replies = [*send(grid, asked, **options)]
        heard.extend([*asked, *replies])
        return replies

    monkeypatch.setattr(EmbeddedGrid, "send_and_receive", listening)
    return heard


def sent_noise(heard: Sequence[Any]) -> list[np.ndarray]:
    """Return the noise of each update that was sent under local noise: clients send their changes, all alike."""
    change = clip_change({name: np.full(array.shape, 0.25) for name, array in START.items()}, LOCAL.clip)
    replies = [each.content for each in heard if each.metadata.src_node_id != 1 and ARRAYS in each.content]
    return [read_arrays(content, ARRAYS)["w"] - START["w"] - change["w"] for content in replies]


def test_secret_numbers_are_normal_and_repeat_by_their_key():
    assert len({draw_secret().tobytes() for _ in range(100)}) == 100
    secret = draw_secret()
    assert secret.nbytes == SECRET_BYTES == 32
    key = derive_key(np.arange(32, dtype=np.uint8), "noise", 1, 7)
    noise = secret_noise(key, START)
    first, second = (noise.normal(scale=3.0, size=(501, 401)) for _ in range(2))
    assert np.std(first) == pytest.approx(3.0, rel=4 / np.sqrt(2 * first.size))
    assert kstest(first.ravel() / 3.0, "norm").pvalue > 0.01
    odd, even = np.array_split(first.ravel()[:-1], 2)  # the two of a pair of Box and Muller
    for one, other in ((first, second), (odd, even), (abs(odd), abs(even))):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(odd.size)
    again = secret_noise(key, START)
    np.testing.assert_array_equal(again.normal(scale=3.0, size=(501, 401)), first)
    assert again.normal(scale=1.0, size=()).shape == ()


def test_a_key_is_of_one_secret_purpose_and_round_and_noise_of_one_change():
    one, other = (np.full(32, value, np.uint8) for value in (1, 2))
    asked = [(one, "noise", 1, 7), (other, "noise", 1, 7), (one, "selection", 1, 7), (one, "noise", 2, 7)]
    keys = [derive_key(*each) for each in (*asked, (one, "noise", 1, 8))]
    assert len({*keys}) == len(keys) == 5
    nearly = {**START, "b": START["b"] + np.float32(1e-6)}
    one_noise, other_noise = (secret_noise(keys[0], change).normal(scale=1.0, size=(9,)) for change in (START, nearly))
    assert not np.isin(one_noise, other_noise).any()  # so that no difference of two changes comes without noise


def test_noise_without_a_secret_is_refused():
    for where in (CENTRAL, LOCAL):
        with pytest.raises(ValueError, match="noise without a secret"):
            add_noise(START, where, 3, None)
    with pytest.raises(ValueError, match="noise without a secret"):
        average_privately(START, [], ["w"], CENTRAL, 1.0, 3)


def test_the_noise_of_parties_and_rounds_differs_and_has_its_deviation(monkeypatch: pytest.MonkeyPatch):
    heard = listen(monkeypatch)
    state = FederationState()
    run(Rules(privacy=LOCAL), state)
    found = sent_noise(heard)
    assert len(found) == len(NAMES) * 3
    for place, one in enumerate(found):
        assert np.std(one) == pytest.approx(DEVIATION, rel=ROUGHLY)
        for other in found[:place]:
            assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 5 / np.sqrt(one.size)
    assert [*state.secrets] == NAMES
    assert len({secret.tobytes() for secret in state.secrets.values()}) == len(NAMES)


@pytest.mark.parametrize("selection", [Selection(), UNIFORM, POISSON], ids=lambda each: each.rule)
@pytest.mark.parametrize("privacy", [CENTRAL, LOCAL], ids=lambda each: each.where)
def test_the_same_secrets_give_the_same_weights_and_others_do_not(privacy: Privacy, selection: Selection):
    rules, state = Rules(privacy=privacy, selection=selection), FederationState()
    whole = run(rules, state)
    same = run(rules, FederationState(secrets=state.secrets))
    np.testing.assert_array_equal(same["w"], whole["w"])
    assert not np.isin(run(rules, FederationState())["w"], whole["w"]).mean() > 0.5
    seeded = Rules(privacy=privacy.model_copy(update={"seeded": True}), selection=selection)
    state = FederationState()
    np.testing.assert_array_equal(run(seeded, state)["w"], run(seeded, FederationState())["w"])
    assert state.secrets == {}


def test_draws_that_amplify_epsilon_are_not_those_of_the_seed():
    for selection in (POISSON, UNIFORM):
        names = [f"grid/{name}" for name in NAMES]
        by_seed = [selection.choose(names, number, SCHEDULE.work(number).seed) for number in range(1, 21)]

        def drawn(privacy: Privacy, selection: Selection = selection) -> list[list[str]]:
            return watch(Rules(privacy=privacy, selection=selection), 20)[0]

        found = [drawn(CENTRAL) for _ in range(2)]
        assert found[0] != by_seed != found[1] != found[0]
        assert np.mean([len(each) for each in found[0]]) == pytest.approx(2.5 if selection is POISSON else 2, abs=1.2)
        assert drawn(CENTRAL.model_copy(update={"seeded": True})) == by_seed
        assert drawn(LOCAL) == by_seed  # is not amplified


@pytest.mark.parametrize("selection", [POISSON, UNIFORM], ids=lambda each: each.rule)
def test_records_and_ledger_do_not_tell_who_was_drawn_in_secret(selection: Selection):
    drawn, state, account = watch(Rules(privacy=CENTRAL, selection=selection), 6)
    assert len({*map(tuple, drawn)}) > 1
    assert state.records == [RoundRecord(number, (), epsilon=1.0) for number in range(1, 7)]
    entries = account.ledger.entries
    assert {entry.client for entry in entries} == {"grid/undisclosed"}
    sizes = {(entry.round, entry.direction, entry.bytes) for entry in entries}
    assert len(sizes) == len({(round_, direction) for round_, direction, _ in sizes})  # whatever samples and losses are
    assert len(entries) == 2 * sum(map(len, drawn))
    told, state, account = watch(Rules(privacy=CENTRAL.model_copy(update={"seeded": True}), selection=selection), 6)
    assert [[*record.clients] for record in state.records] == told
    assert {entry.client for entry in account.ledger.entries} == {name for each in told for name in each}


def test_weights_of_regions_do_not_tell_who_was_drawn():
    """Each vehicle has a power of two of samples, so that the sum of a draw would name it."""
    rules = Rules(privacy=CENTRAL, selection=POISSON)
    for seed in range(10):
        account = Account(ledger(90.0), "cloud", "mover", "wireless")
        servers = {
            region: EdgeServer(
                {f"{region}/{i}": Watched([], 2**i) for i in range(number)}, 1, account, START, rules=rules
            )
            for region, number in (("grid", 6), ("ring", 3))
        }
        clients: dict[str, Any] = {**servers}
        wireline, schedule = Account(ledger(90.0), "cloud", "mover", "wireline"), replace(SCHEDULE, rounds=1, seed=seed)
        found = federate(clients, START, schedule, wireline, rules=rules.of_servers()).weights["w"].astype(float)
        grid, ring = (server.trained["w"].astype(float) for server in servers.values())
        np.testing.assert_allclose(found, (6 * grid + 3 * ring) / 9, atol=1e-6)


@pytest.mark.parametrize(
    "rules",
    [
        Rules(privacy=CENTRAL, selection=Selection(rule="poisson", probability=0.99)),  # in secret: some come for sure
        Rules(privacy=LOCAL),
        Rules(privacy=LOCAL, upload=Upload(compression="top-k", fraction=0.5)),
        Rules(privacy=LOCAL, secure=SecureAggregation()),
    ],
    ids=["central", "local", "top-k", "masked"],
)
def test_no_message_and_no_record_has_a_secret_nor_a_key(rules: Rules, monkeypatch: pytest.MonkeyPatch):
    heard, state = listen(monkeypatch), FederationState()
    run(rules, state)
    everything = b"".join(recorddict_to_proto(each.content).SerializeToString() for each in heard)
    everything += b"".join(array.tobytes() for array in state.to_arrays().values())
    assert "secrets" not in repr(state)
    assert [*state.secrets] == ([SERVER] if rules.privacy is CENTRAL else NAMES)
    assert START["b"].tobytes() in everything  # the search finds what is there
    for secret in state.secrets.values():
        keys = [
            derive_key(secret, purpose, number, SCHEDULE.work(number).seed)
            for purpose in ("noise", "selection")
            for number in (1, 2, 3)
        ]
        for hidden in (secret.tobytes(), *keys):
            pieces = [hidden[at : at + 8] for at in range(0, len(hidden), 8)]
            assert not any(part in everything or part.hex().encode() in everything for part in pieces)


@pytest.mark.parametrize("seeded", [True, False])
def test_who_knows_the_seed_can_take_off_seeded_noise_alone(seeded: bool, monkeypatch: pytest.MonkeyPatch):
    """The seed is in every message; of an update that is known but for its noise, the guess of it is subtracted."""
    heard, work = listen(monkeypatch), SCHEDULE.work(1)
    run(Rules(privacy=LOCAL.model_copy(update={"seeded": seeded})), FederationState(), 1)
    after = run(Rules(privacy=CENTRAL.model_copy(update={"seeded": seeded})), FederationState(), 1)
    change = clip_change({name: np.full(array.shape, 0.25) for name, array in START.items()}, CENTRAL.clip)
    left = [(after["w"] - START["w"] - change["w"]) * len(NAMES) - guess(work.seed)]
    left += [noise - guess(derive_seed(work.seed, name)) for name, noise in zip(NAMES, sent_noise(heard), strict=False)]
    assert len(left) == 1 + len(NAMES)
    for each in left:
        if seeded:
            np.testing.assert_allclose(each, 0, atol=1e-5)
        else:  # the guess is noise of its own on top
            assert np.std(each) == pytest.approx(np.sqrt(2) * DEVIATION, rel=ROUGHLY)


def guess(seed: int) -> np.ndarray:
    """Return the noise of the first array that is drawn by a seed."""
    return stream(seed, "noise").normal(scale=DEVIATION, size=START["w"].shape)
