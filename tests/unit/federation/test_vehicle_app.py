"""The app of a deployed vehicle: what it keeps in its folder, and the same answer to the same request."""

import os
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cryptography import x509
from flwr.app import ConfigRecord, Context, Message, MessageType, RecordDict
from flwr.common.serde import recorddict_to_proto
from flwr.supercore.task_identity import TaskIdentity

from flcav.config import InputError
from flcav.federation.conduct import recall_answered
from flcav.federation.links.in_process import keep_identity, wire_bytes
from flcav.federation.links.vehicle_app import Assignment, VehicleApp, load_assignment, load_identity
from flcav.federation.privacy import draw_secret
from flcav.federation.rules import Rules
from flcav.federation.secure import parties
from flcav.federation.secure.parties import Identity, SecureClient
from flcav.federation.strategies import strategy_named
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import LocalUpdate
from flcav.federation.wire import (
    ARRAYS,
    ASK,
    CONFIG,
    GRANT,
    GRANTED,
    OVER_BUDGET,
    LocalWork,
    read_arrays,
    to_array_record,
)
from flcav.fleet.authority import SERVER, SERVER_KEY, found_authority
from flcav.fleet.keys import AUTHORITY, load_key, request_certificate, take_certificate
from flcav.fleet.vehicle import VehicleSettings
from flcav.perception.client import SentOutputs

TRAINED: list[int] = []


@dataclass(frozen=True)
class Counting:
    """A client that notes each training."""

    def train(self, weights, *, steps, learning_rate, seed, shift=None):
        TRAINED.append(seed)
        moved = {name: array + len(TRAINED) for name, array in weights.items()}
        return LocalUpdate(moved, 3, 0.5, {name: np.full_like(array, len(TRAINED)) for name, array in weights.items()})


@pytest.fixture(autouse=True)
def server():
    TRAINED.clear()
    with keep_identity():
        TaskIdentity.run_id, TaskIdentity.node_id, TaskIdentity.task_id = 1, 1, 1
        yield


@pytest.fixture
def folder(tmp_path):
    rules, strategy = Rules(), strategy_named("scaffold")
    Assignment("f", "town/cav0", Counting(), strategy, rules).save(tmp_path)
    return tmp_path


def ask(folder: Path, round_: int, grant: int | None = None, start: float = 0.0) -> Message:
    """Return the answer of a new process's app, with Flower's node having forgotten all."""
    weights = {"w": np.full(4, start, np.float32)}
    content = {ARRAYS: to_array_record(weights), CONFIG: LocalWork(round_, 1, 0.1, 7 + round_).record()}
    content["extra"] = to_array_record({"w": np.zeros(4, np.float32)})
    if grant is not None:
        content[GRANT] = ConfigRecord({GRANTED: grant})
    message = Message(RecordDict(content), 2, MessageType.TRAIN)
    message.metadata.__dict__["_message_id"] = "1"
    return VehicleApp(folder)(message, Context(1, 2, {}, RecordDict(), {}))


def kept(folder: Path) -> bytes:
    return (folder / "f.state.bin").read_bytes()


def test_same_request_again_gets_the_same_answer_without_training(folder):
    first = ask(folder, 1)
    state = kept(folder)
    again = ask(folder, 1, grant=10**6)  # as after a kill of the SuperLink; what is granted may have changed
    assert len(TRAINED) == 1
    assert kept(folder) == state
    for key in first.content.array_records:
        np.testing.assert_array_equal(read_arrays(first.content, key)["w"], read_arrays(again.content, key)["w"])
    assert ask(folder, 2, start=1.0).has_content()
    assert len(TRAINED) == 2


def test_round_that_is_over_is_not_trained_again(folder):
    ask(folder, 1)
    ask(folder, 2)
    with pytest.raises(ValueError, match="after update of round 2 was answered"):
        ask(folder, 1)
    with pytest.raises(ValueError, match="after update of round 2 was answered"):
        ask(folder, 2, start=5.0)  # another request in the place of one that was answered
    assert len(TRAINED) == 2


def test_answer_over_the_grant_stays(folder):
    size = wire_bytes(ask(folder, 1).content)
    for grant, sent in ((size, True), (size - 1, False)):
        answer = ask(folder, 1, grant)
        assert answer.has_content() == sent
        if not sent:
            assert answer.error.code == OVER_BUDGET
    assert len(TRAINED) == 1


@dataclass(frozen=True)
class Talking(Counting):
    """A client that answers any question with what it was asked, and the sum of what came with it."""

    def answer(self, question, arrays):
        return {question: np.array([sum(array.sum() for array in arrays.values())])}


def question(folder: Path, asked: str, arrays: dict[str, np.ndarray], grant: int | None = None) -> Message:
    content = {ASK: ConfigRecord({ASK: asked}), ARRAYS: to_array_record(arrays)}
    if grant is not None:
        content[GRANT] = ConfigRecord({GRANTED: grant})
    message = Message(RecordDict(content), 2, f"{MessageType.QUERY}.{ASK}")
    message.metadata.__dict__["_message_id"] = "1"
    return VehicleApp(folder)(message, Context(1, 2, {}, RecordDict(), {}))


def test_questions_beside_training(tmp_path):
    Assignment("f", "town/cav0", Talking(), strategy_named("fedavg"), Rules()).save(tmp_path)
    answer = question(tmp_path, "loss", {"w": np.arange(4.0)})
    assert read_arrays(answer.content, ARRAYS) == {"loss": np.array([6.0])}
    assert not TRAINED
    assert not [*tmp_path.glob("*state*")]  # nothing is kept of it
    size = wire_bytes(answer.content)
    for grant, sent in ((size, True), (size - 1, False)):
        assert question(tmp_path, "loss", {"w": np.arange(4.0)}, grant).has_content() == sent


def test_a_client_that_answers_no_questions(folder):
    with pytest.raises(TypeError, match="Counting answers no questions, such as 'loss'"):
        question(folder, "loss", {})


def test_own_client_of_a_vehicle(tmp_path, monkeypatch):
    """A vehicle's own module says what it takes part in; nothing is read from its folder."""
    source = (
        "from test_vehicle_app import *\nPART = Assignment('f', 'cav', Counting(), strategy_named('fedavg'), Rules())\n"
    )
    (tmp_path / "own_part.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    VehicleSettings("192.0.2.1:9443", 1, 2, "own_part:PART").save(tmp_path / "cav")
    assert ask(tmp_path / "cav", 1).content.metric_records["metrics"]["num-examples"] == 3
    VehicleSettings("192.0.2.1:9443", 1, 2, "own_part:NOTHING").save(tmp_path / "cav")
    with pytest.raises(InputError, match="has no 'NOTHING'"):
        ask(tmp_path / "cav", 2)


def test_another_assignment_begins_with_its_own_state(folder):
    ask(folder, 1)
    strategy = strategy_named("scaffold")
    Assignment("g", "town/cav0", Counting(), strategy, Rules(), state={"own": {"w": np.ones(4, np.float32)}}).save(
        folder
    )
    assert load_assignment(folder).federation == "g"
    assert ask(folder, 1).has_content()
    assert len(TRAINED) == 2


@dataclass(frozen=True)
class Imitating:
    """A client of FedMD, whose network is the sum of what it was sent."""

    def train(self, weights, *, steps, learning_rate, seed, own=None, imitation_steps=1):
        before = own["net"] if own else np.full(3, 100.0, np.float32)
        return SentOutputs(weights, 3, 0.5, {"net": before + weights["w"].sum()})


def query(folder: Path, content: RecordDict | None = None) -> RecordDict:
    message = Message(content or RecordDict(), 2, MessageType.QUERY)
    message.metadata.__dict__["_message_id"] = "1"
    return VehicleApp(folder)(message, Context(1, 2, {}, RecordDict(), {})).content


def train(folder: Path, federation: str, round_: int, state: dict | None = None, start: float = 1.0) -> None:
    """Train in a round, of a federation that begins where a state is given."""
    if state is not None:
        Assignment(federation, "town/cav0", Imitating(), FedMD(), Rules(), state=state).save(folder)
    content = {
        ARRAYS: to_array_record({"w": np.full(4, start, np.float32)}),
        CONFIG: LocalWork(round_, 1, 0.1, 7).record(),
    }
    message = Message(RecordDict(content), 2, MessageType.TRAIN)
    message.metadata.__dict__["_message_id"] = "1"
    assert VehicleApp(folder)(message, Context(1, 2, {}, RecordDict(), {})).has_content()


def network(folder: Path, federation: str) -> float:
    """Return a weight of the network in a vehicle's folder."""
    _, state, _ = VehicleApp(folder)._read(load_assignment(folder))
    assert load_assignment(folder).federation == federation
    return float(read_arrays(state, "own")["net"][0])


def test_the_network_of_fedmd_stays_with_its_vehicle_and_goes_on_in_the_next_federation(tmp_path):
    train(tmp_path, "f", 1, {})
    states = []
    for round_ in (1, 2, 3):
        if round_ > 1:
            train(tmp_path, "f", round_)
        told = query(tmp_path)
        assert "own" not in told
        assert (
            np.full(3, network(tmp_path, "f"), np.float32).tobytes()
            not in recorddict_to_proto(told).SerializeToString()
        )
        states.append({"own-digests": read_arrays(told, "own-digests")})
        assert query(tmp_path) == told
        assert len([*tmp_path.glob("*.network.bin")]) == min(round_, 2)
    assert network(tmp_path, "f") == 112
    train(tmp_path, "g", 1, states[2])  # as in the next cloud round
    assert network(tmp_path, "g") == 116
    train(tmp_path, "h", 1, states[1])  # as where the server was stopped before its checkpoint of the third round
    assert network(tmp_path, "h") == 112
    with pytest.raises(InputError, match="its network of the last round is no longer in the vehicle's folder"):
        train(tmp_path, "i", 1, states[0])
    train(tmp_path, "j", 1, {})
    assert network(tmp_path, "j") == 104
    train(tmp_path, "k", 1, {"own": {"net": np.zeros(3, np.float32)}})  # of a run that began within one process
    assert network(tmp_path, "k") == 4
    with pytest.raises(ValueError, match="a client's state is its own"):
        query(tmp_path, RecordDict({"own": to_array_record({"net": np.zeros(3)})}))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Folders of three vehicles of an authority, of one of another, and the authority's."""
    folders = {}
    for place, vehicles in (("ours", ("v1", "v2", "v3")), ("theirs", ("x1", "x2"))):
        authority = found_authority(tmp_path_factory.mktemp(place))
        folders[place] = authority.folder
        for name in vehicles:
            own = folders[name] = authority.folder / "vehicles" / name
            certificate = authority.register(request_certificate(own, name))
            take_certificate(own, certificate, (authority.folder / AUTHORITY).read_bytes())
        authority.registry.close()
    return folders


NOISY = {"secure": {}, "privacy": {"where": "local", "clip": 1, "noise": 4}}


@pytest.fixture
def masked(fleet):
    """Three vehicles' folders, by client, with local noise under masks."""
    clients = {f"town/cav{number}": fleet[f"v{number}"] for number in (1, 2, 3)}
    assign(clients, NOISY)
    return clients


def assign(clients: dict[str, Path], rules: dict) -> None:
    for name, own in clients.items():
        found = Rules.model_validate(rules).settle_threshold([*clients], certified=True)
        Assignment(os.urandom(4).hex(), name, Counting(), strategy_named("fedavg"), found, draw_secret()).save(own)


def answer(folder: Path, ask: dict, round_: int = 1, seed: int = 7) -> RecordDict:
    content = {
        ARRAYS: to_array_record({"w": np.zeros(4, np.float32)}),
        CONFIG: LocalWork(round_, 1, 0.1, seed).record(),
    }
    message = Message(RecordDict({**content, ASK: ConfigRecord(ask)}), 2, MessageType.TRAIN)
    message.metadata.__dict__["_message_id"] = "1"
    return VehicleApp(folder)(message, Context(1, 2, {}, RecordDict(), {})).content


def keys_of(folder: Path, round_: int = 1) -> dict:
    return dict(answer(folder, {ASK: "keys"}, round_).config_records[ASK])


def roster(keys: dict[str, dict], **others) -> dict:
    """Return a request for shares by the keys of clients."""
    kinds = {kind: [each[kind] for each in keys.values()] for kind in next(iter(keys.values()))}
    return {ASK: "shares", "names": [*keys], **kinds, "threshold": 2, **others}


def test_a_vehicle_shares_masks_with_vehicles_that_the_authority_certified_alone(fleet, masked, tmp_path):
    """A server that invents peers, or uses keys of others, gets no shares, and so no update."""
    me = masked["town/cav1"]
    keys = {name: keys_of(own) for name, own in masked.items()}
    mine, other = keys["town/cav1"], keys["town/cav2"]
    identity = load_identity(fleet["x1"])
    made = {name: SecureClient.draw(name) for name in ("a", "b")}
    bare = {name: {"ciphers": own.keys.cipher, "masks": own.keys.mask} for name, own in made.items()}

    def signed(by: Identity, name: str, round_: int = 1) -> dict:
        certificate, signature = by.sign(name, round_, made[name].keys)
        return {**bare[name], "certificates": certificate, "signatures": signature}

    ours = load_identity(fleet["v2"])
    server = x509.load_pem_x509_certificate((fleet["ours"] / SERVER).read_bytes())
    posing = Identity(load_key(fleet["ours"] / SERVER_KEY), server, ours.authority)
    nobody = {"certificates": b"", "signatures": b""}
    for peers, why in (
        ({"a": {**bare["a"], **nobody}, "b": {**bare["b"], **nobody}}, "a certificate or a signature is missing"),
        ({"a": signed(identity, "a"), "b": signed(identity, "b")}, "no certified vehicle has signed"),
        ({"a": signed(Identity(identity.key, ours.certificate, ours.authority), "a")}, "another signature"),
        ({"a": {**other, **bare["a"]}}, "another signature"),  # a vehicle's certificate and signature of its own keys
        ({"a": other}, "another signature"),  # that vehicle under another name
        ({"a": signed(ours, "a", 2)}, "another signature"),  # of another round
        ({"a": signed(ours, "a"), "b": signed(ours, "b")}, "'b' takes part with keys of the vehicle of 'a'"),
        ({"a": signed(posing, "a")}, "the certificate is no vehicle's"),
        ({"a": {**signed(ours, "a"), "certificates": b"x"}}, "no certified vehicle has signed"),
        ({"a": {**signed(ours, "a"), "signatures": bytes(96)}}, "another signature"),
        ({"a": {**signed(ours, "a"), "signatures": bytes(95)}}, "a certificate or a signature is missing"),
    ):
        with pytest.raises(ValueError, match=why):
            answer(me, roster({"town/cav1": mine, **peers}))
    bare_ask = {kind: each for kind, each in roster(keys).items() if kind not in ("certificates", "signatures")}
    with pytest.raises(ValueError, match="a certificate or a signature is missing"):
        answer(me, bare_ask)
    with pytest.raises(ValueError, match="a threshold of 1 of"):
        answer(me, roster({"town/cav1": mine}, threshold=1))
    assert "shares" in answer(me, roster(keys)).config_records[ASK]
    Assignment("none", "a", Counting(), strategy_named("fedavg"), Rules.model_validate(NOISY)).save(tmp_path)
    with pytest.raises(InputError, match="has no certificate yet"):
        keys_of(tmp_path)


def test_a_certificate_that_is_not_in_force_is_no_peer_s(masked, monkeypatch: pytest.MonkeyPatch):
    keys = {name: keys_of(own) for name, own in masked.items()}
    for days in (-1, 400):
        later = SimpleNamespace(now=lambda zone, days=days: datetime.now(zone) + timedelta(days=days))
        monkeypatch.setattr(parties, "datetime", later)
        with pytest.raises(ValueError, match="the certificate is not in force"):
            answer(masked["town/cav1"], roster(keys))


def mask_all(masked: dict[str, Path], seed: int = 7, round_: int = 1) -> dict[str, np.ndarray]:
    """Return the masked update of each vehicle, in a round that begins, or begins anew."""
    keys = {name: keys_of(own, round_) for name, own in masked.items()}
    shared: dict[str, Any] = {
        name: dict(answer(own, roster(keys), round_).config_records[ASK]) for name, own in masked.items()
    }
    sealed = {other: dict(zip(each["names"], each["shares"], strict=True)) for other, each in shared.items()}
    found = {}
    for name, own in masked.items():
        others = {other: sealed[other][name] for other in masked if other != name}
        asked = answer(own, {ASK: "masked", "names": [*others], "shares": [*others.values()]}, round_, seed)
        found[name] = read_arrays(asked, ARRAYS)["#masked"].astype(np.uint32)
    return found


def test_a_vehicle_hides_one_update_of_a_round_whatever_processes_answer(masked):
    """Each message finds another process; what was answered is on the disk before it is sent."""
    sums = [sum(mask_all(masked).values(), np.zeros(4, np.uint32)) for _ in range(3)]
    assert len(TRAINED) == 3  # once by each vehicle
    hidden = {
        name: read_arrays(VehicleApp(own)._read(load_assignment(own))[1], "hidden") for name, own in masked.items()
    }
    with pytest.raises(ValueError, match="another training of round 1 than that whose update was masked"):
        mask_all(masked, seed=8)
    for name, own in masked.items():
        after = VehicleApp(own)._read(load_assignment(own))[1]
        np.testing.assert_array_equal(read_arrays(after, "hidden")["#masked"], hidden[name]["#masked"])
        assert recall_answered(Context(1, 2, {}, after, {})).rounds == 1
    assert len(TRAINED) == 3
    assert not np.array_equal(sums[0], sums[1])  # the sums still have each client's own mask


def test_a_vehicle_answers_no_more_rounds_than_its_budget_affords(masked):
    assign(masked, {**NOISY, "privacy": {**NOISY["privacy"], "epsilon": 2.5}})
    keys_of(masked["town/cav1"])
    with pytest.raises(ValueError, match="more than the 1 that the privacy budget of town/cav1 affords"):
        keys_of(masked["town/cav1"], 2)
