"""The app of a deployed vehicle: what it keeps in its folder, and the same answer to the same request."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from flwr.app import ConfigRecord, Context, Message, MessageType, RecordDict
from flwr.supercore.task_identity import TaskIdentity

from flcav.config import InputError
from flcav.federation.fleet.vehicle import VehicleSettings
from flcav.federation.messages.records import (
    ARRAYS,
    ASK,
    CONFIG,
    GRANT,
    GRANTED,
    OVER_BUDGET,
    LocalWork,
    read_arrays,
    to_arrays,
)
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import keep_identity, wire_bytes
from flcav.federation.runtimes.vehicle_app import Assignment, VehicleApp, load_assignment
from flcav.federation.strategies import strategy_named
from flcav.federation.trainable import LocalUpdate

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
    content = {ARRAYS: to_arrays(weights), CONFIG: LocalWork(round_, 1, 0.1, 7 + round_).record()}
    content["extra"] = to_arrays({"w": np.zeros(4, np.float32)})
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
    content = {ASK: ConfigRecord({ASK: asked}), ARRAYS: to_arrays(arrays)}
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
