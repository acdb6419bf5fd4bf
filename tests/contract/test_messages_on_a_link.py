"""What a socket carries in all three stages is what the ledger has, message by message."""

import socket
import threading
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, ConfigRecord, Message, MetricRecord, RecordDict
from flwr.common.serde import recorddict_from_proto, recorddict_to_proto
from flwr.proto.recorddict_pb2 import RecordDict as Serialised
from flwr.serverapp import Grid
from task_drives import Drives

from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links import link as links
from flcav.federation.links.in_process import wire_bytes
from flcav.federation.links.metered import Account, MeteredGrid
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG, STRATEGIES, Strategy, of_servers, strategy_named
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.fusion.road import RoadView
from flcav.geometry import Boxes
from flcav.network import ledger
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes
from flcav.perception.errors import MISS, PerceptionError, Registry
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.runs.frames import Frames
from flcav.runs.training.messages import release_network, report_errors, upload_samples


class Wire:
    """A socket, and how many bytes came out of it by message."""

    def __init__(self) -> None:
        self.near, self.far = socket.socketpair()
        self.arrived: list[int] = []

    def carry(self, message: bytes) -> bytes:
        sender = threading.Thread(target=self.near.sendall, args=(message,))
        sender.start()
        received = bytearray()
        while len(received) < len(message):
            received += self.far.recv(1 << 20)
        sender.join()
        self.arrived.append(len(received))
        return bytes(received)

    def carry_content(self, content: RecordDict) -> RecordDict:
        """Send the content of a message of Flower; return it as it was received."""
        received = Serialised.FromString(self.carry(recorddict_to_proto(content).SerializeToString()))
        return recorddict_from_proto(received)


class WiredGrid(Grid):
    """A grid whose messages and replies go through a socket, one by one."""

    def __init__(self, grid: Grid, wire: Wire) -> None:
        self.grid, self.wire = grid, wire

    def carried(self, message: Message) -> Message:
        if message.has_content():
            message.content = self.wire.carry_content(message.content)
        return message

    def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
        return self.grid.push_messages([self.carried(message) for message in messages])

    def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
        return [self.carried(reply) for reply in self.grid.pull_messages(message_ids)]

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        sent = (self.carried(message) for message in messages)
        return (self.carried(reply) for reply in self.grid.send_and_receive(sent, timeout=timeout))

    def get_node_ids(self) -> Iterable[int]:
        return self.grid.get_node_ids()

    def create_message(self, *arguments: Any, **named: Any) -> Message:
        return self.grid.create_message(*arguments, **named)

    def set_run(self, run: Any) -> None:
        self.grid.set_run(run)

    @property
    def run(self) -> Any:
        return self.grid.run


class Walk:
    """Walks at random, whatever corrects its steps; keeps where it went by itself."""

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, own: Weights | None = None, **_: Any
    ) -> LocalUpdate:
        rng = np.random.default_rng(seed)
        drawn = {name: rng.normal(size=array.shape).astype(np.float32) for name, array in weights.items()}
        walked = {name: array + drawn[name] for name, array in weights.items()}
        return LocalUpdate(walked, 3, 0.5, drawn, own={} if own is None else drawn)

    def count_samples(self, steps: int) -> int:
        return 3


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    found = Wire()
    monkeypatch.setattr(ledger, "carry", found.carry)
    monkeypatch.setattr(
        links, "MeteredGrid", lambda grid, account, names: WiredGrid(MeteredGrid(grid, account, names), found)
    )
    return found


def test_the_ledger_has_what_a_socket_carried_in_every_stage(wire: Wire, tmp_path: Path) -> None:
    record(Drives(spins=2), tmp_path / "data")
    data, config = Dataset.open(tmp_path / "data"), find_configuration(OBJECTS, "tiny")
    split, book = Frames(data, tuple(range(len(data))), {}), Ledger(LinkMegabytes(100.0, 100.0))

    received = upload_samples(book, OBJECTS, config, "suburb", split, [0, 3])
    assert all(
        np.array_equal(one.points, other.points)
        for one, other in zip(received, OBJECTS.samples(data, config, [0, 3]), strict=True)
    )
    whole = [entry.bytes for entry in book.entries]
    compressed = upload_samples(book, OBJECTS, config, "suburb", split, [0, 3], compressed=True)
    assert all(np.allclose(a.points, b.points, atol=0.006) for a, b in zip(compressed, received, strict=True))
    assert all(np.array_equal(a.boxes.array(), b.boxes.array()) for a, b in zip(compressed, received, strict=True))
    assert sum(entry.bytes for entry in book.entries) - sum(whole) < sum(whole) / 3  # sweeps of few returns
    network = build_network(OBJECTS, config, 1)
    before = {name: array.copy() for name, array in to_arrays(network).items()}
    after = to_arrays(release_network(book, OBJECTS, network, "grid", split))
    assert all(np.array_equal(before[name], after[name]) for name in before)
    missed = PerceptionError(1.0, 2.0, 3.0, 1.0, MISS, "Car", 7, 0.5, "a", "veh1", 21.0)
    assert report_errors(book, OBJECTS, Registry.of({0: [missed], 3: [missed]}), "grid", split).errors == (missed,)
    assert report_errors(book, OBJECTS, Registry((missed,)), "grid", split).errors == (missed,)
    view = RoadView(Boxes.empty(), np.zeros(2), np.ones((3, 5), bool), np.zeros((3, 5), bool))
    about: Any = {"stage": "edge", "task": "objects", "link": "wireless", "direction": "down", "client": "grid/cav0"}
    assert RoadView.from_message(ledger.send_message(book, view.message(), **about)).ground.all()

    start, schedule = {"w": np.zeros(300, np.float32)}, Schedule(2, 1, 0.1, 0.1, 3)
    vehicles: dict[str, Trainable] = {f"grid/cav{i}": Walk() for i in range(3)}
    wireless, wireline = (Account(book, "cloud", "objects", link) for link in ("wireless", "wireline"))
    for rules in ({}, {"secure": {}}, {"selection": {"rule": "importance", "clients": 2}, "least_clients": 1}):
        how = Rules.model_validate(rules)
        federate(vehicles, start, schedule, Account(book, "edge", "objects", "wireless"), rules=how)
    server: dict[str, Trainable] = {"grid": EdgeServer(vehicles, 2, wireless, start)}
    federate(server, start, schedule, wireline)

    assert sorted(entry.bytes for entry in book.entries) == sorted(wire.arrived)
    assert sum(wire.arrived) == sum(
        book.used_bytes(link, direction=direction) for link in ("wireless", "wireline") for direction in ("up", "down")
    )
    kinds = {(entry.stage, entry.link, entry.direction) for entry in book.entries}
    assert len(kinds) == 2 + 3 + 4  # samples up; network, mistakes, views and rounds; edge and cloud rounds


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_ledger_has_what_a_socket_carried_for_every_strategy(wire: Wire, name: str) -> None:
    book = federate_twice(strategy_named(name), Rules())
    assert sorted(entry.bytes for entry in book.entries) == sorted(wire.arrived)


@pytest.mark.parametrize(
    "rules",
    [
        {"upload": {"compression": "fp16"}},
        {"upload": {"compression": "int8"}},
        {"upload": {"compression": "top-k", "fraction": 0.1}},
        {"upload": {"layers": ["v"]}},
        {"selection": {"rule": "uniform", "clients": 2, "unbiased": True}},
        {"selection": {"rule": "planned", "joins": {"grid/cav1": [2]}}},
        {"privacy": {"where": "local", "clip": 1, "noise": 1}},
        {"privacy": {"where": "central", "clip": 1, "noise": 1}},
        {"secure": {}, "privacy": {"where": "local", "clip": 1, "noise": 1}},
        {"personal": ["v"]},
        {"personal": {"pull": 0.1}},
    ],
    ids=str,
)
def test_the_ledger_has_what_a_socket_carried_by_every_rule(wire: Wire, rules: dict[str, Any]) -> None:
    book = federate_twice(FEDAVG, Rules.model_validate(rules))
    assert sorted(entry.bytes for entry in book.entries) == sorted(wire.arrived)


def federate_twice(strategy: Strategy, rules: Rules) -> Ledger:
    """Return the ledger of two edge rounds of five vehicles, and of two cloud rounds with five regions."""
    book, start = Ledger(LinkMegabytes(100.0, 100.0)), {"w": np.zeros(300, np.float32), "v": np.zeros(30, np.float32)}
    schedule, vehicles = Schedule(2, 1, 0.1, 0.1, 3), {f"grid/cav{i}": Walk() for i in range(5)}
    how: Any = {"strategy": strategy, "rules": rules}
    federate(vehicles, start, schedule, Account(book, "edge", "objects", "wireless"), **how)
    air, line = (Account(book, "cloud", "objects", link) for link in ("wireless", "wireline"))
    servers = {
        region: EdgeServer(vehicles, 1, air, start, **how) for region in ("grid", "ring", "hills", "suburb", "mine")
    }
    federate(servers, start, schedule, line, strategy=of_servers(strategy), rules=rules.of_servers())
    return book


def test_an_update_over_the_budget_is_not_sent(wire: Wire) -> None:
    start, schedule = {"w": np.zeros(300, np.float32)}, Schedule(2, 1, 0.1, 0.1, 3)
    vehicles: dict[str, Trainable] = {f"grid/cav{i}": Walk() for i in range(3)}
    free = Ledger(LinkMegabytes(1.0, 1.0))
    federate(vehicles, start, replace(schedule, rounds=1), Account(free, "edge", "objects", "wireless"))
    wire.arrived.clear()
    tight = Ledger(
        LinkMegabytes(1.4 * free.used_mb("wireless"), 1.0)
    )  # of the second round, for one more update of three
    with pytest.raises(BudgetExceeded, match=r"grid/cav1 wants .* for round 2"):
        federate(vehicles, start, schedule, Account(tight, "edge", "objects", "wireless"))
    assert sorted(entry.bytes for entry in tight.entries) == sorted(wire.arrived)
    assert [entry.direction for entry in tight.entries].count("up") == 4


def test_sizes_are_those_of_flower_s_serialisation():
    sizes = [0, 1, 100, *range(118, 130), *range(16370, 16386), 2_097_140, 2_097_152]  # lengths get a byte longer
    arrays = {f"layer{size}.weight": Array("uint8", (size,), "numpy.ndarray", bytes(size)) for size in sizes}
    records = {
        **{name: ArrayRecord({name: array}) for name, array in arrays.items()},
        "all": ArrayRecord(arrays),
        "none": ArrayRecord({}),
        "scalar": ArrayRecord({"": Array(np.array(3, np.int64)), "ä": Array(np.ones((2, 0, 300)))}),
        "config": ConfigRecord({"round": 3, "secret": bytes(300), "names": ["a", "b"]}),
        "metrics": MetricRecord({"loss": 0.5}),
    }
    for key, each in records.items():
        for content in (RecordDict({key: each}), RecordDict({key: each, "again": each})):
            assert wire_bytes(content) == len(recorddict_to_proto(content).SerializeToString()), key
    assert wire_bytes(RecordDict(records)) == len(recorddict_to_proto(RecordDict(records)).SerializeToString())
    assert wire_bytes(RecordDict({})) == 0
