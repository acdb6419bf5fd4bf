"""Secure aggregation: sums come out exactly, with drop-outs too, and the server holds no client's update."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.exceptions import InvalidTag
from flwr.app import ConfigRecord, Context, Message, RecordDict
from flwr.common.serde import recorddict_to_proto
from flwr.supercore.task_identity import TaskIdentity

from flcav.config import InputError
from flcav.federation.checks import check_federation
from flcav.federation.links.in_process import keep_identity
from flcav.federation.links.metered import Account, MeteredGrid
from flcav.federation.links.vehicle_app import load_identity
from flcav.federation.loop import Schedule, federate
from flcav.federation.privacy import Privacy, account_epsilon
from flcav.federation.rules import Rules, SecureAggregation
from flcav.federation.secure.messages import TooFewClients, answer_secretly
from flcav.federation.secure.parties import Identity, SecureClient, SumLost, add_mask, settle_complaints, unmask_sum
from flcav.federation.secure.primitives import (
    SHARE_BYTES,
    add_vectors,
    agree,
    draw_keys,
    expand,
    find_wrong_shares,
    join_shares,
    seal,
    split_secret,
    to_integers,
    to_values,
    unseal,
)
from flcav.federation.selection import Selection
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.fedopt import FedAdam
from flcav.federation.strategies.robust import Median
from flcav.federation.trainable import LocalUpdate
from flcav.federation.upload import Upload
from flcav.federation.wire import ASK
from flcav.fleet.authority import found_authority
from flcav.fleet.keys import AUTHORITY, request_certificate, take_certificate
from flcav.network.ledger import Ledger, LinkMegabytes

NAMES = [f"grid/cav{i}" for i in (3, 0, 4, 1, 2)]


def updates(size: int = 50) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    return {name: to_integers(rng.normal(size=size), 8.0, len(NAMES)) for name in NAMES}


def protocol(lost_before: tuple[str, ...], lost_after: tuple[str, ...], threshold: int = 3) -> tuple[Any, list[Any]]:
    """Return the sum as the server computes it, and all that the server was sent."""
    held: list[Any] = []
    clients = {name: SecureClient.draw(name) for name in NAMES}
    keys = {name: client.keys for name, client in clients.items()}
    sealed = {name: client.share(keys, threshold) for name, client in clients.items()}
    held += [share for shares in sealed.values() for share in shares.values()]
    peers = [name for name in NAMES if name not in lost_before]
    for_one = {name: {other: sealed[other][name] for other in peers if other != name} for name in peers}
    survivors = [name for name in peers if name not in lost_after]
    given = updates()
    assert not any(clients[name].take(for_one[name]) for name in survivors)
    masked = {name: clients[name].mask(given[name]) for name in survivors}
    held += [*masked.values()]
    dropped = [name for name in peers if name in lost_after]
    shares = {name: clients[name].reveal(survivors, dropped) for name in survivors}
    held += [share for revealed in shares.values() for share in revealed.values()]
    total = add_vectors([*masked.values()])
    return unmask_sum(total, keys, survivors, dropped, shares), held


@pytest.mark.parametrize(
    ("before", "after"), [((), ()), ((NAMES[1],), ()), ((), (NAMES[0], NAMES[4])), ((NAMES[2],), (NAMES[3],))]
)
def test_the_sum_is_that_of_those_who_are_left(before: tuple[str, ...], after: tuple[str, ...]):
    given = updates()
    expected = sum(given[name].astype(np.int64) for name in NAMES if name not in before + after) % 2**32
    np.testing.assert_array_equal(protocol(before, after)[0], expected)


def test_the_server_holds_no_client_s_update():
    for before, after in (((), ()), ((), (NAMES[0],))):
        _, held = protocol(before, after)
        vectors = [each for each in held if isinstance(each, np.ndarray)]
        assert len(vectors) == len(NAMES) - len(after)
        for vector, (_, update) in itertools.product(vectors, updates().items()):
            assert np.mean(vector == update) < 0.05
            for other in vectors:  # nor does a difference of two give one away
                assert np.mean(vector - other == update) < 0.05 or np.array_equal(vector, other)
        shares = [each for each in held if isinstance(each, bytes)]
        seeds = [update.tobytes()[:16] for update in updates().values()]
        assert not any(seed in share for seed, share in itertools.product(seeds, shares))


def test_masks_look_uniform_and_differ_from_round_to_round():
    client = {name: SecureClient.draw(name) for name in NAMES}
    keys = {name: each.keys for name, each in client.items()}
    sealed = {name: each.share(keys, 3) for name, each in client.items()}
    zero = np.zeros(100_000, np.uint32)
    name = NAMES[0]
    client[name].take({other: sealed[other][name] for other in NAMES if other != name})
    masked = client[name].mask(zero)
    counts = np.bincount(masked >> 24, minlength=256)
    assert ((counts - len(zero) / 256) ** 2).sum() / (len(zero) / 256) < 360  # chi-squared, 255 degrees: p > 1e-5
    assert SecureClient.draw(name).keys != client[name].keys


def test_a_client_does_not_reveal_both_masks_of_another():
    clients = {name: SecureClient.draw(name) for name in NAMES}
    keys = {name: client.keys for name, client in clients.items()}
    sealed = {name: client.share(keys, 3) for name, client in clients.items()}
    one = clients[NAMES[0]]
    one.take({name: sealed[name][NAMES[0]] for name in NAMES[1:]})
    for survivors, dropped in ((NAMES, NAMES[:1]), (NAMES[:2], NAMES[2:]), (NAMES[1:], ()), ([*NAMES[:3], "x"], ())):
        with pytest.raises(ValueError, match="shares are revealed"):
            one.reveal(survivors, dropped)
    one.reveal(NAMES[:3], NAMES[3:])
    with pytest.raises(ValueError, match="revealed once"):
        one.reveal(NAMES, ())
    for threshold in (2, 6):
        with pytest.raises(ValueError, match="more than half of them is wanted"):
            one.share(keys, threshold)
    with pytest.raises(ValueError, match="2 clients are left, and 3 are needed"):
        clients[NAMES[1]].take({NAMES[0]: b""})


def test_any_threshold_of_the_shares_make_the_secret_and_fewer_do_not():
    secret = bytes(range(32))
    shares = dict(enumerate(split_secret(secret, 3, 6)))
    for places in itertools.combinations(shares, 3):
        assert join_shares({place: shares[place] for place in places}) == secret
    assert join_shares(shares) == secret
    with pytest.raises(OverflowError):  # a random element of the field, of 521 bits
        join_shares({place: shares[place] for place in (0, 1)})
    assert split_secret(secret, 3, 6) != [*shares.values()]


def test_keys_are_common_to_two_for_one_purpose():
    (private, public), (other_private, other_public) = draw_keys(), draw_keys()
    assert agree(private, other_public, "mask") == agree(other_private, public, "mask")
    assert agree(private, other_public, "mask") != agree(private, other_public, "shares")
    sealed = seal(agree(private, other_public, "shares"), b"share")
    assert unseal(agree(other_private, public, "shares"), sealed) == b"share"
    with pytest.raises(InvalidTag):
        unseal(agree(other_private, public, "mask"), sealed)
    assert not np.array_equal(expand(b"a" * 32, 8), expand(b"b" * 32, 8))


def test_fixed_point_sums_do_not_overflow():
    rng = np.random.default_rng(3)
    values = rng.uniform(-9, 9, size=(7, 1000))
    total = add_vectors([to_integers(each, 8.0, 7) for each in values])
    np.testing.assert_allclose(to_values(total, 8.0, 7), np.clip(values, -8, 8).sum(axis=0), atol=7 * 8.0 * 7 / 2**31)
    every = add_vectors([to_integers(np.full(3, 8.0), 8.0, 7)] * 7)
    np.testing.assert_allclose(to_values(every, 8.0, 7), 56.0)
    with pytest.raises(ValueError, match="not finite"):
        to_integers(np.array([np.nan]), 1.0, 2)


class Walk:
    def __init__(self, stride: float, fails: tuple[int, ...] = ()) -> None:
        self.stride, self.fails, self.calls = stride, fails, 0

    def train(self, weights: Any, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        self.calls += 1
        if self.calls in self.fails:
            raise OSError("no power")
        noise = np.random.default_rng(seed).normal(size=(40, 5))
        moved = (weights["w"] + self.stride + learning_rate * noise).astype(np.float32)
        return LocalUpdate(
            {"w": moved, "norm.running_var": weights["norm.running_var"] + 0.5, "n": weights["n"]}, 3, 0.5
        )


START = {"w": np.zeros((40, 5), np.float32), "norm.running_var": np.ones(4, np.float32), "n": np.array(2)}
SCHEDULE = Schedule(rounds=3, steps=1, learning_rate=0.1, final_learning_rate=0.1, seed=3)
SECURE = Rules(secure=SecureAggregation(), least_clients=3)


def run(clients: dict[str, Walk], rules: Rules, **how: Any) -> tuple[Any, FederationState, Ledger]:
    book, state = Ledger(LinkMegabytes(10.0, 0.0)), FederationState()
    account = Account(book, "edge", "walk", "wireless")
    return federate(clients, START, SCHEDULE, account, rules=rules, state=state, **how).weights, state, book


def walks(**fails: tuple[int, ...]) -> dict[str, Walk]:
    return {f"cav{i}": Walk(0.1 * i, fails.get(f"cav{i}", ())) for i in range(5)}


@pytest.mark.parametrize("strategy", [FEDAVG, FedAdam()], ids=["fedavg", "fedadam"])
def test_a_masked_federation_ends_as_an_open_one(strategy: Any):
    open_weights, _, open_book = run(walks(), Rules(), strategy=strategy)
    weights, _, book = run(walks(), SECURE, strategy=strategy)
    np.testing.assert_allclose(weights["w"], open_weights["w"], atol=2e-6)
    np.testing.assert_allclose(weights["norm.running_var"], open_weights["norm.running_var"], atol=2e-6)
    again = run(walks(), SECURE, strategy=strategy)[0]
    assert all(np.array_equal(weights[name], again[name]) for name in weights)  # whatever the keys were
    assert len([entry for entry in book.entries if entry.direction == "up"]) == 4 * 5 * 3  # four messages a round
    assert book.used_mb("wireless") > open_book.used_mb("wireless")


def test_a_vehicle_that_drops_out_is_named_and_the_sum_is_of_the_others():
    weights, state, _ = run(walks(cav2=(1,)), SECURE)
    assert state.records[0].clients == ("cav0", "cav1", "cav3", "cav4")
    assert "no power" in state.records[0].failed["cav2"]
    expected = run(walks(cav2=(1,)), Rules(least_clients=3))[0]
    np.testing.assert_allclose(weights["w"], expected["w"], atol=2e-6)
    with pytest.raises(TooFewClients, match="secure aggregation: 2 clients sent an update, and 3 are needed"):
        run(walks(cav0=(1,), cav1=(1,), cav2=(1,)), Rules(secure=SecureAggregation(), least_clients=1))


def test_local_noise_is_under_the_masks():
    privacy = Privacy(where="local", clip=0.25, noise=2.0, seeded=True)
    noisy, masked = Rules(privacy=privacy), Rules(privacy=privacy, secure=SecureAggregation())
    expected, told, _ = run(walks(), noisy)
    found, state, _ = run(walks(), masked)
    np.testing.assert_allclose(found["w"], expected["w"], atol=2e-6)  # the same draws, summed under masks
    np.testing.assert_array_equal(found["norm.running_var"], START["norm.running_var"])  # no noise covers it
    assert [(each.epsilon, each.samples, each.loss) for each in state.records] == [
        (account_epsilon(privacy, Selection(), [*walks()], number), 5, 0.0) for number in (1, 2, 3)
    ]
    assert [each.epsilon for each in told.records] == [each.epsilon for each in state.records]
    quiet = Rules(privacy=privacy.model_copy(update={"noise": 1e-9}), secure=SecureAggregation())
    clipped = run(walks(), quiet)[0]["w"]
    assert 0 < np.linalg.norm(clipped) <= 3 * 0.25 * (1 + 1e-5)  # a mean of three rounds' clipped changes
    added = (found["w"] - clipped).ravel()
    deviation = 2.0 * 0.25 * np.sqrt(3 / 5)  # of a mean of five, in three rounds
    assert np.std(added) == pytest.approx(deviation, rel=4 / np.sqrt(2 * added.size))


def test_the_server_is_sent_no_update_that_it_could_read(monkeypatch: pytest.MonkeyPatch):
    held: list[bytes] = []
    receive = MeteredGrid.send_and_receive

    def listening(grid: Any, messages: Any, **options: Any) -> Any:
        replies = list(receive(grid, messages, **options))
        held.extend(recorddict_to_proto(reply.content).SerializeToString() for reply in replies)
        return replies

    trained: list[np.ndarray] = []
    train = Walk.train

    def telling(walk: Walk, weights: Any, **how: Any) -> LocalUpdate:
        update = train(walk, weights, **how)
        trained.append(np.concatenate([update.weights["w"].ravel() - weights["w"].ravel(), np.full(4, 0.5)]))
        return update

    monkeypatch.setattr(MeteredGrid, "send_and_receive", listening)
    monkeypatch.setattr(Walk, "train", telling)
    everything = {"open": Rules(), "masked": SECURE}
    found = {}
    for name, rules in everything.items():
        held.clear()
        trained.clear()
        run(walks(), rules)
        integers = [to_integers(change.astype(np.float64), 8.0, 5) for change in trained]
        read = [np.frombuffer(each[at:], np.uint32, (len(each) - at) // 4) for each in held for at in range(4)]
        near = [
            np.isin(each >> 12, integer >> 12).mean()
            for each, integer in itertools.product(read, integers)
            if len(each) >= len(integer)
        ]
        weights = [np.float32(change[:8]).tobytes() for change in trained[:5]]  # the first round starts at 0
        found[name] = max(near), any(weight in each for weight, each in itertools.product(weights, held))
    assert found["open"][1]
    assert found["masked"] == (pytest.approx(0, abs=0.05), False)


def test_what_makes_no_sense_is_one_sentence():
    secure, clients = SecureAggregation(), walks()
    poisson = Selection(rule="poisson", probability=0.5)
    for strategy, rules, said in (
        (Median(), Rules(secure=secure), r"Median looks at each update, and secure aggregation shows their sum alone"),
        (FEDAVG, Rules(secure=secure, selection=poisson), r"secure aggregation needs a known number of clients"),
        (
            FEDAVG,
            Rules(secure=secure, upload=Upload(compression="fp16")),
            r"integers of 32 bits, and fp16 sends others",
        ),
        (
            FEDAVG,
            Rules(secure=secure, privacy=Privacy(clip=1.0, noise=1.0)),
            r"goes with local noise: a server that adds",
        ),
        (FEDAVG, Rules(secure=SecureAggregation(threshold=2)), r"secure.threshold: more than half of the 5 clients"),
        (FEDAVG, Rules(secure=SecureAggregation(threshold=6)), r"secure.threshold: .* and not 6"),
    ):
        with pytest.raises(InputError, match=said):
            check_federation(clients, strategy, rules)


@pytest.mark.parametrize(("threshold", "count", "wrong"), [(3, 5, 1), (3, 5, 2), (4, 9, 4), (11, 20, 3), (2, 3, 1)])
def test_wrong_shares_are_found_among_enough_right_ones(threshold: int, count: int, wrong: int):
    rng = np.random.default_rng(count)
    shares = dict(enumerate(split_secret(bytes(range(32)), threshold, count)))
    assert find_wrong_shares(shares, threshold) == set()
    odd = {*rng.permutation(count)[:wrong].tolist()}
    told = shares | {place: split_secret(bytes(32), 2, 1)[0] for place in odd}
    assert find_wrong_shares(told, threshold) == odd
    with pytest.raises(ValueError, match=f"no {threshold} of {threshold} shares make a secret"):
        find_wrong_shares({place: told[place] for place in [*odd, *({*shares} - odd)][:threshold]}, threshold)


def test_shares_of_what_is_too_long_for_a_secret_make_none():
    shares = dict.fromkeys(range(3), (256**32).to_bytes(SHARE_BYTES))  # of a constant polynomial
    with pytest.raises(ValueError, match="no 2 of 3 shares make a secret"):
        find_wrong_shares(shares, 2)


@pytest.mark.parametrize(("certified", "needed"), [(False, 3), (True, 4)])
def test_a_client_shares_its_secrets_at_the_threshold_that_its_authority_asks_for(
    certified: bool, needed: int, tmp_path: Path
):
    """Of five: more than half of clients that trust their server, two thirds of certified ones."""
    authority, names = found_authority(tmp_path), [f"cav{i}" for i in range(5)]
    contexts = {name: Context(1, 2, {}, RecordDict(), {}) for name in names}
    identities: dict[str, Identity | None] = dict.fromkeys(names)
    for name in names if certified else ():
        own, root = tmp_path / name, (tmp_path / AUTHORITY).read_bytes()
        take_certificate(own, authority.register(request_certificate(own, name)), root)
        identities[name] = load_identity(own)

    def answer(name: str, **asked: Any) -> Any:
        message = Message(RecordDict({ASK: ConfigRecord(asked)}), 2, "train")
        reply = answer_secretly(message, contexts[name], name, SecureAggregation(), 1, identities[name])
        return reply.content.config_records[ASK]

    with keep_identity():
        TaskIdentity.task_id = TaskIdentity.run_id = TaskIdentity.node_id = 1
        keys = [answer(name, ask="keys") for name in names]
        kinds = ("ciphers", "masks", *(("certificates", "signatures") if certified else ()))
        both = {kind: [each[kind] for each in keys] for kind in kinds}
        with pytest.raises(ValueError, match=f"a threshold of {needed - 1} of 5 clients: {needed} are agreed on"):
            answer("cav0", ask="shares", names=names, threshold=needed - 1, **both)
        sealed = answer("cav0", ask="shares", names=names, threshold=needed, **both)
    assert {*sealed["names"]} == {*names[1:]}


def test_the_fewest_liars_that_explain_all_complaints_are_out_and_of_two_alone_both():
    for complaints, liars in (
        ({name: ["a"] for name in "bcde"}, {"a"}),  # a sealed garbage for all
        ({"a": [*"bcde"]}, {"a"}),  # a complains about all
        ({"b": ["a"], "c": ["a"]}, {"a"}),
        ({"b": ["a"]}, {"a", "b"}),  # it cannot be told which
        ({"b": ["a"], "c": ["a"], "e": ["d"]}, {"a", "d", "e"}),
        ({"b": ["a"], "a": ["b"]}, {"a", "b"}),
    ):
        assert settle_complaints(complaints).keys() == liars


def test_a_key_of_another_than_the_client_s_own_is_told_when_it_drops_out():
    clients = {name: SecureClient.draw(name) for name in NAMES}
    keys = {name: client.keys for name, client in clients.items()}
    clients[NAMES[0]].private = draw_keys()[0]  # shares another one than its public key's
    sealed = {name: client.share(keys, 3) for name, client in clients.items()}
    for name, client in clients.items():
        assert not client.take({other: sealed[other][name] for other in NAMES if other != name})
    total = add_vectors([clients[name].mask(np.zeros(4, np.uint32)) for name in NAMES[1:]])
    shares = {name: clients[name].reveal(NAMES[1:], NAMES[:1]) for name in NAMES[1:]}
    with pytest.raises(SumLost, match=f"{NAMES[0]} dropped out, and had shared a key that is not its own"):
        unmask_sum(total, keys, NAMES[1:], NAMES[:1], shares)


def lie_to_each(threshold: int) -> Any:
    """Return the update of the first of five clients, to which a server shows two others, and each another list.

    Raises ValueError where a client reveals nothing.
    """
    one, *others = names = [f"cav{i}" for i in range(5)]
    clients = {name: SecureClient.draw(name) for name in names}
    keys = {name: client.keys for name, client in clients.items()}
    sealed = {name: client.share(keys, threshold) for name, client in clients.items()}
    shown = {name: [other for other in names if other != name] for name in names} | {one: others[: threshold - 1]}
    for name, client in clients.items():
        assert not client.take({other: sealed[other][name] for other in shown[name]})
    masked = clients[one].mask(np.arange(7, dtype=np.uint32))
    shares = {}
    for name in others:
        gone = [other for other in shown[one] if other != name]
        shares[name] = clients[name].reveal([each for each in names if each not in gone], gone)
    places = {name: place for place, name in enumerate(names)}

    def joined(owner: str) -> bytes:
        return join_shares({places[holder]: each[owner] for holder, each in shares.items() if holder != owner})

    masked = add_mask(masked, joined(one), plus=False)
    for other in shown[one]:
        masked = add_mask(masked, agree(joined(other), keys[one].mask, "mask"), plus=other < one)
    return masked


def test_a_threshold_of_two_thirds_keeps_an_update_from_a_server_that_tells_each_client_another_list():
    secure = SecureAggregation()
    np.testing.assert_array_equal(lie_to_each(secure.needed(5)), np.arange(7))
    with pytest.raises(ValueError, match="shares are revealed once, one of each client, to a server that has enough"):
        lie_to_each(secure.needed(5, certified=True))
    for number in range(2, 300):
        threshold = secure.needed(number, certified=True)
        assert number / 2 < threshold <= number
        beyond = number - threshold  # so many keys at most are revealed by each client
        for shown in range(threshold - 1, number):  # of one client's peers; `threshold` shares of each key are wanted
            by_others, by_shown = (number - 1 - shown) * min(shown, beyond), shown * min(shown - 1, beyond)
            assert by_others + by_shown + shown + 1 - threshold < threshold * shown  # and by the client itself
    assert SecureAggregation(threshold=3).needed(5, certified=True) == 3
