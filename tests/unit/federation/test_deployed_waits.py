"""Whom the server of a deployed federation waits for: not for vehicles that hang, nor for revoked ones."""

import json
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from flwr.app import ArrayRecord, ConfigRecord, Error, Message, MessageType, RecordDict
from flwr.supercore.task_identity import TaskIdentity

from flcav.federation.links import flower_grid
from flcav.federation.links.flower_grid import ALLOWANCE_S, RAISED, DeployedGrid
from flcav.federation.links.in_process import keep_identity
from flcav.federation.links.metered import open_account
from flcav.federation.wire import LOST_BY_NETWORK
from flcav.fleet.authority import found_authority
from flcav.fleet.keys import request_certificate
from flcav.fleet.status import PROGRESS, FederationProgress, RoundProgress

NAMES = {1: "town/cav1", 2: "town/cav2", 3: "town/cav3"}
SILENT = 2


class Nodes:
    """Flower's grid, whose node `SILENT` answers only what `answers` has for it."""

    def __init__(self):
        self.out, self.pushed, self.answers = {}, [], {}

    def push_messages(self, messages):
        sent = []
        for message in messages:
            node = message.metadata.dst_node_id
            self.pushed.append(node)
            sent.append(f"{len(self.pushed)}")
            error = self.answers.get(node)
            content = RecordDict({"told": ConfigRecord({"node": node})})
            self.out[sent[-1]] = node, Message(error or content, reply_to=message)
        return sent

    def pull_messages(self, ids):
        for each in ids:
            node, reply = self.out[each]
            if node != SILENT or SILENT in self.answers:
                reply.metadata.__dict__["_reply_to_message_id"] = each
                yield reply


@pytest.fixture
def fleet(tmp_path):
    authority = found_authority(tmp_path / "fleet")
    for node in NAMES:
        authority.register(request_certificate(tmp_path / f"v{node}", f"vehicle-{node}"))
    vehicles = dict(zip(NAMES, authority.registry.list_vehicles(), strict=True))
    nodes = Nodes()
    run = SimpleNamespace(grid=nodes, identify=lambda: None, end=lambda failed=False: None)
    link = SimpleNamespace(wait=lambda _: None, begin=lambda: run)

    def open_grid(limit_s=None):
        return DeployedGrid(authority.folder, link, NAMES, vehicles, open_account(), limit_s)  # type: ignore[arg-type]

    with keep_identity():
        TaskIdentity.task_id, TaskIdentity.run_id, TaskIdentity.node_id = 1, 1, 1
        yield SimpleNamespace(registry=authority.registry, nodes=nodes, open=open_grid, folder=authority.folder)


def ask(grid):
    content = RecordDict({"config": ConfigRecord({"round": 1})})
    messages = [Message(content, node, MessageType.TRAIN) for node in NAMES]
    return {reply.metadata.src_node_id: reply for reply in grid.send_and_receive(messages)}


def test_a_vehicle_that_hangs_is_given_up_and_not_waited_for_while_it_is_away(fleet, monkeypatch):
    monkeypatch.setattr(flower_grid, "ALLOWANCE_S", 0.6)
    grid, begun = fleet.open(0.2), time.monotonic()
    replies = ask(grid)
    assert 0.8 <= time.monotonic() - begun < 3
    assert (replies[SILENT].error.code, replies[SILENT].error.reason) == (RAISED, "it had not answered after 1 s")
    assert [node for node, reply in replies.items() if reply.has_content()] == [1, 3]
    fleet.nodes.answers[SILENT] = Error(3, "node is not available")
    monkeypatch.setattr(flower_grid, "ALLOWANCE_S", 60.0)
    assert ask(grid)[SILENT].error.code == LOST_BY_NETWORK
    assert time.monotonic() - begun < 6
    fleet.nodes.answers[SILENT] = None
    assert ask(grid)[SILENT].has_content()


def test_a_silent_vehicle_is_asked_again_ever_more_seldom(fleet, monkeypatch):
    monkeypatch.setattr(flower_grid, "ALLOWANCE_S", 1.8)
    monkeypatch.setattr(flower_grid, "AGAIN_S", 0.4)
    ask(fleet.open(0.2))
    assert fleet.nodes.pushed == [1, 2, 3, SILENT, SILENT]  # after 0.4 s, and 0.8 s more; given up before 1.6 s more


def test_limit_of_answers(fleet):
    messages = [Message(RecordDict({"a": ArrayRecord([np.zeros(10**6, np.uint8)])}), node, "train") for node in NAMES]
    assert fleet.open()._limit_answers(messages) == float("inf")
    assert fleet.open(5.0)._limit_answers(messages) == pytest.approx(5 + ALLOWANCE_S + 16, abs=0.1)  # 1 MB at 1 Mbit/s


def test_a_revoked_vehicle_is_not_asked(fleet):
    grid = fleet.open()
    fleet.registry.revoke("vehicle-2")
    replies, told = ask(grid), "the certificate of vehicle-2 is revoked"
    assert (replies[SILENT].error.code, replies[SILENT].error.reason) == (LOST_BY_NETWORK, told)
    assert fleet.nodes.pushed == [1, 3]
    assert (
        f"; without town/cav2: {told}"
        in FederationProgress.from_json(json.loads((fleet.folder / PROGRESS).read_bytes()), "").describe()
    )


def test_revocation_ends_the_wait(fleet):
    grid, revoked = fleet.open(), []

    def revoke():
        fleet.registry.revoke("vehicle-2")
        revoked.append(time.monotonic())

    timer = threading.Timer(0.5, revoke)
    timer.start()
    assert ask(grid)[SILENT].error.code == LOST_BY_NETWORK
    assert time.monotonic() - revoked[0] < 2  # a second, on a machine that is busy
    timer.join()


def test_a_registry_that_cannot_be_read_ends_no_round(fleet):
    fleet.nodes.answers[SILENT] = None
    grid = fleet.open()
    (fleet.folder / "registry.sqlite").write_bytes(b"none")
    assert all(reply.has_content() for reply in ask(grid).values())


def test_words_of_vehicles_are_fit_for_a_terminal(fleet):
    fleet.nodes.answers[SILENT] = Error(RAISED, "\x1b[2Jfine\nvehicle-1: revoked" + "x" * 10**6)
    reason = ask(fleet.open())[SILENT].error.reason
    assert reason.isprintable()
    assert len(reason) < 600
    odd = FederationProgress(
        "edge", "weather", "wireless", 1.0, 2.0, (RoundProgress(1, 0.0, 2, {"cav": "\x1b[31m\n" * 99}),)
    )
    told = replace(odd, waits={"cav2": "\x07"}).in_plain_words().describe()
    assert told.isprintable()
    assert "round 1 without cav: \\x1b[31m\\n" in told
    assert len(told) < 500
