"""The rounds of a group in stage II: a lead that leaves, roadside units, a loss that has levelled off."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from federations import edge_federation, federate_edge
from line_task import LineTask, Slope

from flcav.federation.links.link import open_questions
from flcav.federation.links.metered import Outage, open_account
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.runs.extras.groups import forming
from flcav.runs.extras.groups.choosing import GroupWatch
from flcav.runs.extras.groups.forming import Called
from flcav.runs.extras.groups.members import GroupMember, measure_loss
from flcav.runs.extras.groups.rows import Group, LeadTerm
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.recipe import Training
from flcav.runs.results.saved import WEIGHTS
from flcav.runs.training.learning import Learning, load_stage_network, make_clients

LEARNING = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=1, start_share=0.0), 3)
NAMES = ("a/cav0", "a/cav1", "a/cav2")


def federate_group(
    folder: Path,
    outages: dict[tuple[int, str], Outage],
    rounds: int = 3,
    terms: tuple[LeadTerm, ...] = (),
    roadside: tuple[str, ...] = (),
    watch: GroupWatch | None = None,
) -> tuple[bytes, Ledger]:
    """Run a group's rounds; return its weights and ledger."""
    book, samples = Ledger(LinkMegabytes(1.0, 1.0)), {name: [np.float32(i)] for i, name in enumerate(NAMES)}
    clients, schedule = make_clients(LEARNING, Slope(), samples), LEARNING.schedule(rounds, 2, "edge", "a")
    group = Group(0.0, {}, "", NAMES, roadside=roadside)
    conduct = Called(group, samples, watch or GroupWatch(Requests(), {}, [0.0]), LEARNING.task, book, terms)
    how = (LEARNING, LEARNING.build_network(), clients, schedule, FEDAVG, 0, book, folder, ignore_progress)
    federate_edge(edge_federation(*how, conduct=conduct), Rules(), outages)
    return (folder / WEIGHTS).read_bytes(), book


def test_a_lead_that_leaves_in_mid_round_leaves_the_weights_of_the_next_from_the_round_s_start(tmp_path: Path) -> None:
    gone = {(2, "a/cav0"): Outage("left the town", 7), (3, "a/cav0"): Outage("not in the town")}
    terms = (LeadTerm("a/cav0", 1, 2, 1), LeadTerm("a/cav1", 2))
    found, book = federate_group(tmp_path / "led", gone, terms=terms)
    away = {key: Outage("gone") for key in gone}
    expected, other = federate_group(tmp_path / "from", away, terms=(LeadTerm("a/cav1", 1),))
    assert found == expected
    assert [e.client for e in book if (e.round, e.direction) == (2, "up")] == ["a/cav1", "a/cav2"]  # lost; asked again
    assert [e.client for e in other if (e.round, e.direction) == (2, "up")] == ["a/cav2"]
    assert Ledger.load(tmp_path / "led/ledger.parquet").entries == book.entries


def test_roadside_units_train_without_a_message_on_the_radio(tmp_path: Path) -> None:
    alone, book = federate_group(tmp_path / "radio", {})
    same, less = federate_group(tmp_path / "unit", {}, roadside=("a/cav2",))
    assert same == alone
    assert {e.client for e in book} == set(NAMES)
    assert {e.client for e in less} == {"a/cav0", "a/cav1"}


def test_a_group_dissolves_by_the_loss_on_what_it_holds_back_whatever_validation_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network that has learned what is held back gains no more; its rounds do not depend on the score told."""
    held = {"a/cav0": [np.float32(0)], "a/cav1": [np.float32(1)]}

    def end(name: str, scores: tuple[float, float]) -> tuple[bytes, Group]:
        start = LEARNING.build_network()
        about = (to_arrays(start), 0.1, 0, np.zeros((1, 3)))
        members = {who: GroupMember(LEARNING.task, Slope(), 2, own, own, *about) for who, own in held.items()}
        first = np.mean([measure_loss(LEARNING.task, Slope(), to_arrays(start), own, 2) for own in held.values()])
        watch = GroupWatch(Requests(patience=1, least_gain=0.5), members, [float(first)])
        weights, book = federate_group(tmp_path / name, {}, 9, watch=watch)
        assert {(e.round, e.client) for e in book if e.bytes < 100} <= {(n, who) for n in range(1, 10) for who in held}
        left = iter(scores)
        monkeypatch.setattr(forming, "score_network", lambda *_: next(left))
        (tmp_path / f"{name}-start").mkdir()
        monkeypatch.setattr(
            forming,
            "load_stage_network",
            lambda task, at: start if "start" in str(at) else load_stage_network(task, at),
        )
        called = Called(Group(0.1, {}, "pole1", NAMES), {}, watch, LEARNING.task, book)
        shown: Any = SimpleNamespace(data=None, vehicles=())  # that nobody looks at: their score is given
        with open_questions(members, None, open_account()) as ask:
            return weights, called.dissolve(tmp_path / name, tmp_path / f"{name}-start", shown, 9, ask)

    (one, group), (other, same) = end("up", (0.1, 0.9)), end("down", (0.9, 0.1))
    assert one == other
    assert group.losses == same.losses
    assert 2 <= len(group.losses) < 10
    assert group.dissolved == "the loss has levelled off"
    assert (group.scores, same.scores) == ((0.1, 0.9), (0.9, 0.1))
