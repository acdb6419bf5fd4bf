from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flcav.experiments import federating
from flcav.experiments.federating import _checkpoint, _resumed, _share_of
from flcav.experiments.protocol import Protocol
from flcav.pipeline.steps import Work
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import EdgeServer, Schedule, federate
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.ledger import Budget, Ledger, LedgerEntry

START = {"w": np.zeros(3, dtype=np.float32), "count": np.array(0, dtype=np.int64)}
STAGE_ONE = LedgerEntry("pretrain", "t", "wireless", "up", 0, "suburb/cav0", 4_000_000)
ROAD = LedgerEntry("edge", "t", "wireless", "down", 0, "grid/cav0", 900)
SCHEDULE = Schedule(rounds=3, steps=4, learning_rate=0.1, final_learning_rate=0.05, seed=5)


class Walk:
    """A client whose weights walk at random: any other round, seed, start or rate ends elsewhere."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        stride = np.random.default_rng(seed).normal(size=3) * learning_rate * steps
        moved = (0.9 * weights["w"] + stride).astype(np.float32)
        return LocalUpdate({"w": moved, "count": weights["count"] + np.int64(steps)}, 3, 0.5)


def edge(work: Work) -> tuple[Weights, Ledger]:
    """Federate as `edge_fl` does: the road's views are booked before the rounds."""
    book = Ledger(Budget(1.0, 0.0))
    book.enter(ROAD)
    start, done = _resumed(work, START, book)
    keep = _checkpoint(work, book, SCHEDULE.rounds)
    clients = {f"grid/cav{i}": Walk() for i in range(2)}
    federate(clients, start, SCHEDULE, Account(book, "edge", "t", "wireless"), done=done, on_round=keep)
    return federating.load_file(federating.round_path(work.folder, SCHEDULE.rounds)), book


def cloud(work: Work) -> tuple[Weights, Ledger]:
    """Federate as `cloud_fl` does: on top of what was spent before, edge servers nested below the cloud."""
    book = Ledger(Budget(10.0, 1.0), [STAGE_ONE, ROAD])
    start, done = _resumed(work, START, book)
    servers: dict[str, Trainable] = {}
    for town, own in (("grid", 1.0), ("ring", -1.0)):
        vehicles = {f"{town}/cav{i}": Walk() for i in range(2)}
        model = {"w": np.full(3, own, dtype=np.float32), "count": START["count"]}
        servers[town] = EdgeServer(vehicles, 2, Account(book, "cloud", "t", "wireless"), model, cloud_rounds_done=done)
    keep = _checkpoint(work, book, SCHEDULE.rounds)
    federate(servers, start, SCHEDULE, Account(book, "cloud", "t", "wireline"), done=done, on_round=keep)
    return federating.load_file(federating.round_path(work.folder, SCHEDULE.rounds)), book


def at(folder: Path) -> Work:
    folder.mkdir()
    return Work(folder, {}, lambda done, total, note="": None)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("stage", [edge, cloud])
def test_a_federation_killed_at_any_write_ends_the_same(
    stage: Callable[[Work], tuple[Weights, Ledger]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    weights, book = stage(at(tmp_path / "whole"))
    writes = 0
    last = 0

    def dying(write: Callable[..., None]) -> Callable[..., None]:
        def counted(*arguments: object) -> None:
            nonlocal writes
            writes += 1
            if writes == last:
                raise Killed
            write(*arguments)

        return counted

    with monkeypatch.context() as patched:
        patched.setattr(federating, "write_bytes", dying(federating.write_bytes))
        patched.setattr(federating, "write_json", dying(federating.write_json))
        patched.setattr(Ledger, "save", dying(Ledger.save))
        stage(at(tmp_path / "counted"))
        total = writes
        for last in range(1, total + 1):
            work, writes = at(tmp_path / str(last)), 0
            with pytest.raises(Killed):
                stage(work)
            found, resumed = stage(work)
            assert all(np.array_equal(found[name], weights[name]) for name in weights), last
            assert resumed.entries == book.entries, last
    assert total >= 3 * SCHEDULE.rounds


def test_regions_share_what_stage_one_left_by_their_vehicles():
    setting = Protocol(wireless_mb=11.0, grid_vehicles=4, ring_vehicles=3)
    stage_one = Ledger(Budget(11.0, 5.0), [STAGE_ONE])
    shares = [_share_of(stage_one, setting, town) for town in ("grid", "ring")]
    assert [share.left_mb("wireless") for share in shares] == [4.0, 3.0]
    assert [share.left_mb("wireline") for share in shares] == [0.0, 0.0]  # stage II has no business there
    assert all(share.entries == () for share in shares)
