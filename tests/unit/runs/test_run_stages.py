"""Stages as functions: how pretraining ends, what a kill leaves, who pays, how many steps a control takes."""

import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from line_task import LineTask, Slope
from safetensors.numpy import load_file, save

from flcav.config import InputError
from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG, Strategy, of_servers
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.strategies.fedopt import FedAdam
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.clock.records import save_rounds
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import Task
from flcav.perception.training import train
from flcav.perception.weights import to_arrays
from flcav.runs.recipe import Training
from flcav.runs.results.saved import WEIGHTS
from flcav.runs.stages import centralised
from flcav.runs.stages.centralised import pretrain, train_centrally
from flcav.runs.stages.settings import region_budget, share_budget
from flcav.runs.training.checkpoints import FederationCheckpoints, find_checkpoint, round_path
from flcav.runs.training.learning import Learning
from flcav.runs.training.messages import choose_planned_uploads, choose_uploads
from flcav.runs.training.records import ROUNDS, SCHEMA
from flcav.statistics.streams import derive_seed
from flcav.storage import files
from flcav.storage.files import write_bytes
from flcav.storage.records import write_any_table

START = {"w": np.zeros(3, dtype=np.float32), "count": np.array(0, dtype=np.int64)}
STAGE_ONE = LedgerEntry("pretrain", "t", "wireless", "up", 0, "suburb/cav0", 4_000_000)
ROAD = LedgerEntry("edge", "t", "wireless", "down", 0, "grid/cav0", 900)
SCHEDULE = Schedule(rounds=3, steps=4, learning_rate=0.1, final_learning_rate=0.05, seed=5)


class Walk:
    """A client whose weights walk at random: any other round, seed, start or rate ends elsewhere."""

    def train(
        self, weights: Weights, *, steps: int, learning_rate: float, seed: int, shift: Weights | None = None
    ) -> LocalUpdate:
        gradient = np.random.default_rng(seed).normal(size=3).astype(np.float32)
        stride = (gradient + (shift or {}).get("w", 0)) * learning_rate * steps
        moved = (0.9 * weights["w"] + stride).astype(np.float32)
        return LocalUpdate({"w": moved, "count": weights["count"] + np.int64(steps)}, 3, 0.5, {"w": gradient})


def edge(folder: Path, strategy: Strategy = FEDAVG, report: Report = ignore_progress) -> tuple[Weights, Ledger]:
    """Federate as stage II does: the road's views are booked before the rounds."""
    book = Ledger(LinkMegabytes(1.0, 0.0))
    book.enter(ROAD)
    states = {"edge": FederationState()}
    federating = FederationCheckpoints(OBJECTS, folder, book, report, states, str(strategy), SCHEDULE.rounds)
    start, done = federating.resume(START)
    clients = {f"grid/cav{i}": Walk() for i in range(2)}
    account = Account(book, "edge", "t", "wireless")
    federate(
        clients, start, SCHEDULE, account, strategy=strategy, state=states["edge"], done=done, on_round=federating.save
    )
    assert [record.round for record in states["edge"].records] == [1, 2, 3]
    assert len(federating.losses) == SCHEDULE.rounds
    return load_file(round_path(folder, SCHEDULE.rounds)), book


def cloud(folder: Path, strategy: Strategy = FEDAVG) -> tuple[Weights, Ledger]:
    """Federate as stage III does: on top of what was spent before, edge servers nested below the cloud."""
    book = Ledger(LinkMegabytes(10.0, 1.0), [STAGE_ONE, ROAD])
    states = {name: FederationState() for name in ("cloud", "grid", "ring")}
    federating = FederationCheckpoints(
        OBJECTS, folder, book, lambda done, total, note="": None, states, str(strategy), SCHEDULE.rounds
    )
    start, done = federating.resume(START)
    servers: dict[str, Trainable] = {}
    for town, own in (("grid", 1.0), ("ring", -1.0)):
        vehicles = {f"{town}/cav{i}": Walk() for i in range(2)}
        model = {"w": np.full(3, own, dtype=np.float32), "count": START["count"]}
        wireless, own_state = Account(book, "cloud", "t", "wireless"), states[town]
        servers[town] = EdgeServer(vehicles, 2, wireless, model, done, strategy, state=own_state)
    account = Account(book, "cloud", "t", "wireline")
    how: Any = {"strategy": of_servers(strategy), "state": states["cloud"]}
    federate(servers, start, SCHEDULE, account, **how, done=done, on_round=federating.save)
    return load_file(round_path(folder, SCHEDULE.rounds)), book


class Killed(BaseException):
    pass


@pytest.mark.slow
@pytest.mark.parametrize("strategy", [FEDAVG, FedAdam(), Scaffold()], ids=["fedavg", "fedadam", "scaffold"])
@pytest.mark.parametrize("stage", [edge, cloud])
def test_a_federation_killed_at_any_write_ends_the_same(
    stage: Callable[[Path, Strategy], tuple[Weights, Ledger]],
    strategy: Strategy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fresh(name: str) -> Path:
        (tmp_path / name).mkdir()
        return tmp_path / name

    weights, book = stage(fresh("whole"), strategy)
    writes, last = 0, 0

    def dying(write: Callable[..., object]) -> Callable[..., None]:
        def counted(*arguments: object) -> None:
            nonlocal writes
            writes += 1
            if writes == last:
                raise Killed
            write(*arguments)

        return counted

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", dying(Path.replace))  # the end of every write
        stage(fresh("counted"), strategy)
        total = writes
        for last in range(1, total + 1):
            folder, writes = fresh(str(last)), 0
            with pytest.raises(Killed):
                stage(folder, strategy)
            found, resumed = stage(folder, strategy)
            assert all(np.array_equal(found[name], weights[name]) for name in weights), last
            assert resumed.entries == book.entries, last
    assert total >= 3 * SCHEDULE.rounds


def test_a_damaged_checkpoint_is_found_and_the_one_before_it_is_used(tmp_path: Path) -> None:
    weights, book = edge(tmp_path / "whole", Scaffold())
    for name in ("round3.safetensors", "state3.safetensors", "ledger3.parquet", "round.json", "round2.safetensors"):
        folder, told = tmp_path / name, list[str]()
        shutil.copytree(tmp_path / "whole", folder)
        held = bytearray((folder / name).read_bytes())
        held[len(held) // 2] ^= 1
        (folder / name).write_bytes(held)
        if name == "round2.safetensors":  # which both checkpoints rest on
            with pytest.raises(InputError, match="the last two checkpoints are damaged; remove the folder"):
                edge(folder, Scaffold())
            continue
        found, resumed = edge(folder, Scaffold(), lambda done, total, note="", told=told: told.append(note))
        assert told == [f"{folder / name} is damaged, the checkpoint before it is used", "loss 0.500"]
        assert all(np.array_equal(found[key], weights[key]) for key in weights)
        assert resumed.entries == book.entries


def test_a_full_disk_at_any_write_is_named_keeps_the_checkpoint_before_and_the_federation_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, names = files.write_in_pieces, []

    def full(path: Path, data: bytes) -> None:
        names.append(path.name)
        last = len(names) == fails
        whole(path, data[: len(data) // 2] if last else data)
        if last:
            raise OSError(errno.ENOSPC, "No space left on device")

    fails = 0  # counted from 1: the write for which there is no space
    monkeypatch.setattr(files, "write_in_pieces", full)
    weights, book = edge(tmp_path / "whole", Scaffold())
    writes = len(names)
    assert writes == 3 * 4 + 2, "of each round weights, state, ledger and record; from the second on the record before"
    for fails in range(1, writes + 1):
        folder = tmp_path / str(fails)
        names.clear()
        with pytest.raises(OSError, match=rf"No space left on device: '{folder}/") as told:
            edge(folder, Scaffold())
        assert told.value.errno == errno.ENOSPC
        assert not [path for path in folder.iterdir() if path.name.endswith(".part")]
        done = sum(name.startswith(".round.json.") for name in names[:-1])
        found, damage = find_checkpoint(folder)
        assert (0 if found is None else found.round, damage) == (done, "")
        names.clear()
        fails = 0
        resumed, own = edge(folder, Scaffold())
        assert all(np.array_equal(resumed[name], weights[name]) for name in weights)
        assert own.entries == book.entries


def test_a_full_disk_leaves_the_tables_of_rounds_that_were_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        path.write_bytes(data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    clock, rounds = tmp_path / "clock.parquet", tmp_path / ROUNDS
    writes: dict[Path, Callable[[], None]] = {
        clock: lambda: save_rounds([], clock),
        rounds: lambda: write_any_table(SCHEMA.empty_table(), rounds),
    }
    for write in writes.values():
        write()
    monkeypatch.setattr(files, "write_in_pieces", full)
    for path, write in writes.items():
        before = path.read_bytes()
        with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
            write()
        assert path.read_bytes() == before
    assert {*tmp_path.iterdir()} == {*writes}


def test_a_checkpoint_of_another_strategy_is_refused(tmp_path: Path) -> None:
    edge(tmp_path)
    with pytest.raises(InputError, match=r"a checkpoint of FedAvg\(\), which FedAdam\(.*\) cannot go on with"):
        edge(tmp_path, FedAdam())


LINEAR = cast(Task, LineTask())


def test_the_mean_of_the_last_rounds_is_the_federation_s_result(tmp_path: Path) -> None:
    network = LINEAR.build(Slope())
    rounds = []
    for number in range(1, 4):
        rounds.append({name: array + np.float32(number**2) for name, array in to_arrays(network).items()})
        write_bytes(round_path(tmp_path, number), save(rounds[-1]))
    federating = FederationCheckpoints(
        LINEAR, tmp_path, Ledger(LinkMegabytes(1.0, 1.0)), ignore_progress, {}, "", losses=[0.5] * 3
    )
    for averaged, last in ((1, rounds[2:]), (2, rounds[1:]), (9, rounds)):
        federating.finish(network, averaged)
        found = load_file(tmp_path / WEIGHTS)
        for name in found:
            np.testing.assert_allclose(found[name], np.mean([each[name] for each in last], axis=0), rtol=1e-6)
    start = to_arrays(network)
    federating.finish(network, 2, 0.3)
    for name, array in load_file(tmp_path / WEIGHTS).items():
        np.testing.assert_allclose(array, 0.7 * (start[name] + (4 + 9) / 2) + 0.3 * start[name], rtol=1e-6)


SAMPLES = [np.float32(number) for number in range(5)]


def test_pretraining_takes_the_tasks_schedule_and_ends_with_its_last_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learning = Learning(LINEAR, None, Training(steps=25), 3)
    monkeypatch.setattr(centralised, "average_splits", lambda task, network, splits: -float(network.weight.detach()))
    found = pretrain(learning, learning.build_network(), SAMPLES, (), tmp_path, ignore_progress)
    other = learning.build_network()
    history = train(LINEAR, other, SAMPLES, steps=25, schedule="one_cycle", seed=derive_seed(3, "pretrain"))
    kept = load_file(tmp_path / WEIGHTS)
    assert all(np.array_equal(kept[name], array) for name, array in to_arrays(other).items())
    assert [each.step for each in found] == list(range(5, 26, 5))
    assert [each.loss for each in found] == pytest.approx(history.losses.reshape(5, 5).mean(axis=1))
    assert max(found, key=lambda each: each.score) != found[-1]  # the best validation is not what is kept


def test_a_kill_does_not_change_pretraining(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(centralised, "average_splits", lambda task, network, splits: float(network.bias.detach()))

    def killed(done: int, total: int, note: str = "") -> None:
        if done == 70:
            raise KeyboardInterrupt

    learning = Learning(LINEAR, None, Training(steps=90), 3)
    whole = pretrain(learning, learning.build_network(), SAMPLES, (), tmp_path, ignore_progress)
    (tmp_path / "killed").mkdir()
    with pytest.raises(KeyboardInterrupt):
        pretrain(learning, learning.build_network(), SAMPLES, (), tmp_path / "killed", killed)
    taken: list[int] = []
    again = pretrain(
        learning,
        learning.build_network(),
        SAMPLES,
        (),
        tmp_path / "killed",
        lambda done, total, note="": taken.append(done),
    )
    assert taken[0] == 64  # validated, and kept, every 9 steps
    assert again == whole
    assert (tmp_path / "killed" / WEIGHTS).read_bytes() == (tmp_path / WEIGHTS).read_bytes()


def test_regions_share_what_stage_one_left_by_their_vehicles() -> None:
    stage_one = Ledger(LinkMegabytes(11.0, 5.0), [STAGE_ONE])
    shares = [region_budget(stage_one, {"grid": 4, "ring": 3}, town) for town in ("grid", "ring")]
    assert [share.wireless_mb for share in shares] == pytest.approx([4.0, 3.0])
    assert [share.wireline_mb for share in shares] == [0.0, 0.0]  # stage II has no business there


def test_tasks_share_both_budgets_as_planned_and_never_more() -> None:
    whole = LinkMegabytes(100.0, 50.0)
    assert share_budget(whole, {"a": (30.0, 20.0)}, "a") == whole
    planned = {"a": (10.0, 10.0), "b": (20.0, 0.0), "c": (7.1, 3.3)}
    parts = [share_budget(whole, planned, task) for task in planned]
    assert sum(part.bytes_on("wireless") for part in parts) <= whole.bytes_on("wireless")
    assert sum(part.bytes_on("wireline") for part in parts) <= whole.bytes_on("wireline")
    assert parts[1].wireless_mb == pytest.approx(100 * 20 / 37.1, abs=1e-5)


def test_a_central_control_takes_the_steps_of_all_vehicles_at_the_same_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[dict[str, Any]] = []

    def counted(task: Any, network: Any, samples: Any, **how: Any) -> float:
        taken.append(how)
        return 0.5

    monkeypatch.setattr(centralised, "train_steps", counted)
    learning = Learning(OBJECTS, "tiny", Training(local_steps=16), 3)
    losses = train_centrally(learning, None, [1, 2, 3], rounds=5, clients=4, name="federate")
    edge = learning.schedule(5, 16, "edge", "grid")
    assert losses == (0.5,) * 5
    assert [how["steps"] for how in taken] == [4 * 16] * 5
    assert [how["learning_rate"] for how in taken] == [edge.work(number).learning_rate for number in range(1, 6)]
    assert taken[0]["learning_rate"] == pytest.approx(1e-3)
    assert taken[-1]["learning_rate"] == pytest.approx(2e-4)


def test_further_rounds_stay_at_the_rate_at_which_the_earlier_ones_ended() -> None:
    learning = Learning(OBJECTS, "tiny", Training(local_rate=0.5, final_rate=0.1), 3)
    rate = OBJECTS.practice.learning_rate
    first, further = learning.schedule(3, 16, "edge", "grid"), learning.schedule(3, 16, "cloud", "", earlier=3)
    assert [first.work(number).learning_rate / rate for number in (1, 3)] == pytest.approx([0.5, 0.1])
    assert [further.work(number).learning_rate / rate for number in (1, 2, 3)] == pytest.approx([0.1] * 3)
    anew = learning.schedule(3, 16, "cloud", "", earlier=3, restart=0.4)
    assert [anew.work(number).learning_rate / rate for number in (1, 2, 3)] == pytest.approx([0.4, 0.2, 0.1])
    assert anew.work(1).seed == further.work(1).seed


def test_uploads_are_drawn_over_all_pools_and_by_the_seed() -> None:
    pools = {"a": range(10, 20), "b": range(5)}
    chosen = choose_uploads(pools, 9, seed=1)
    assert sum(map(len, chosen.values())) == 9
    assert all(set(frames) <= set(pools[region]) for region, frames in chosen.items())
    assert chosen == choose_uploads(pools, 9, seed=1) != choose_uploads(pools, 9, seed=2)
    assert cast(Any, choose_uploads(pools, 15, seed=1)) == {"a": tuple(range(10, 20)), "b": tuple(range(5))}


def test_planned_uploads_are_drawn_from_each_vehicle_s_own_frames() -> None:
    pools = {"a": {"a/cav0": range(10, 20), "a/cav1": range(20, 24)}, "b": {"b/cav0": range(5)}}
    uploads = {"a/cav0": 3, "a/cav1": 4, "b/cav0": 0}
    chosen = choose_planned_uploads(pools, uploads, seed=1)
    assert (len(chosen["a"]), chosen["a"][3:], chosen["b"]) == (7, (20, 21, 22, 23), ())
    assert set(chosen["a"][:3]) <= set(range(10, 20))
    assert chosen == choose_planned_uploads(pools, uploads, seed=1) != choose_planned_uploads(pools, uploads, seed=2)
