"""Secrets that noise is drawn by, in the folder of a federation: kept over a kill, and gone with its end."""

import shutil
import stat
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from federations import cloud_federation, edge_federation, federate_cloud, federate_edge
from line_task import LineTask, Slope
from safetensors.numpy import load_file

from flcav.config import InputError
from flcav.federation.privacy import SEEDED
from flcav.federation.rules import Rules
from flcav.federation.state import SERVER
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.runs.recipe import Training
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.stages.rounds import RegionStart
from flcav.runs.training.checkpoints import (
    PART,
    SECRETS,
    SECRETS_HASH,
    read_secrets,
    remove_secrets,
    write_secrets,
)
from flcav.runs.training.learning import Learning, Strategies, make_clients

ROUNDS, VEHICLES = 6, 3
Federate = Callable[..., None]


class Killed(BaseException):
    """Stands for SIGKILL: nothing is caught, nothing is written after it."""


class Mortal:
    """A vehicle in whose training the federation is killed, after so many trainings of all."""

    trainings = 0

    def __init__(self, client: Any, dies_at: int) -> None:
        self._client, self._dies_at = client, dies_at

    def train(self, weights: Weights, **how: Any) -> LocalUpdate:
        Mortal.trainings += 1
        if Mortal.trainings == self._dies_at:
            raise Killed
        return self._client.train(weights, **how)


def vehicles(learning: Learning, region: str, dies_at: int) -> Any:
    Mortal.trainings = 0
    samples = {f"{region}/cav{i}": [np.float32(i), np.float32(1)] for i in range(VEHICLES)}
    return {name: Mortal(each, dies_at) for name, each in make_clients(learning, Slope(), samples).items()}


def edge(folder: Path, rules: Rules, dies_at: int = 0, report: Any = ignore_progress, wireless_mb: float = 1.0) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1), 3)
    schedule, book = learning.schedule(ROUNDS, 1, "edge", "a"), Ledger(LinkMegabytes(wireless_mb, 1.0))
    how = (learning.build_network(), vehicles(learning, "a", dies_at), schedule, FEDAVG, 0, book, folder, report)
    federate_edge(edge_federation(learning, *how), rules)


def cloud(folder: Path, rules: Rules, dies_at: int = 0, wireless_mb: float = 1.0) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1), 3)
    network = learning.build_network()
    regions = {name: RegionStart(vehicles(learning, name, dies_at), to_arrays(network), earlier=0) for name in "ab"}
    how = (
        dict.fromkeys(regions, 2),
        Strategies(FEDAVG, FEDAVG),
        Ledger(LinkMegabytes(wireless_mb, 1.0)),
        folder,
        ignore_progress,
    )
    federate_cloud(cloud_federation(learning, network, regions, *how), 2, rules)


def rules(where: str, **how: Any) -> Rules:
    return Rules.model_validate({"privacy": {"where": where, "clip": 1.0, "noise": 1.0, **how}})


def keep_note(notes: list[str], done: int, total: int, note: str = "") -> None:
    notes.append(note)


def kill(federate: Federate, folder: Path, how: Rules, dies_at: int) -> None:
    with pytest.raises(Killed):
        federate(folder, how, dies_at)


@pytest.mark.parametrize("dies_at", [2, 8, 14])
@pytest.mark.parametrize("where", ["central", "local"])
@pytest.mark.parametrize("federate", [edge, cloud])
def test_a_killed_federation_goes_on_with_its_secrets(
    federate: Federate, where: str, dies_at: int, tmp_path: Path
) -> None:
    how, killed = rules(where), tmp_path / "killed"
    kill(federate, killed, how, dies_at)
    assert stat.S_IMODE((killed / SECRETS).stat().st_mode) == 0o600
    secrets = {name: array.tobytes() for name, array in load_file(killed / SECRETS).items()}
    states = ["edge"] if federate is edge else ["edge/a", "edge/b"]
    parties = [SERVER] if where == "central" else [f"cav{i}" for i in range(VEHICLES)]
    assert len(secrets) == len(set(secrets.values())) == len(states) * len(parties)
    assert {name.partition("|")[0] for name in secrets} == {*states}
    shutil.copytree(killed, tmp_path / "forgetful")
    (tmp_path / "forgetful" / SECRETS).unlink()
    with pytest.raises(InputError, match=rf"{SECRETS} is missing or not .*; remove the folder to begin anew"):
        federate(tmp_path / "forgetful", how, 0)
    ends = []
    for name in ("one", "another"):
        shutil.copytree(killed, tmp_path / name)
        federate(tmp_path / name, how, 0)
        ends.append((tmp_path / name / WEIGHTS).read_bytes())
        left = b"".join(path.read_bytes() for path in (tmp_path / name).rglob("*") if path.is_file())
        assert not any(secret in left or secret.hex().encode() in left for secret in secrets.values())
        assert not {SECRETS, SECRETS_HASH} & {path.name for path in (tmp_path / name).iterdir()}
    assert ends[0] == ends[1]
    federate(tmp_path / "one", how, 0)  # killed after its end, which removes the secrets
    assert (tmp_path / "one" / WEIGHTS).read_bytes() == ends[0]
    if (killed / "round1.safetensors").exists():  # is not done again
        assert (killed / "round1.safetensors").read_bytes() == (tmp_path / "one/round1.safetensors").read_bytes()


@pytest.mark.parametrize("seeded", [False, True])
@pytest.mark.parametrize("where", ["central", "local"])
def test_a_round_that_is_sent_again_has_the_noise_that_it_had(where: str, seeded: bool, tmp_path: Path) -> None:
    how, whole = rules(where, seeded=seeded), tmp_path / "whole"
    if not seeded:  # both have the secrets of one that was killed in its first round
        kill(edge, whole, how, 2)
        shutil.copytree(whole, tmp_path / "stopped")
    edge(whole, how)
    for dies_at in (3, 5, 7):  # killed thrice more on its way
        kill(edge, tmp_path / "stopped", how, dies_at)
    edge(tmp_path / "stopped", how)
    for name in (WEIGHTS, *(f"round{number}.safetensors" for number in range(1, ROUNDS + 1))):
        assert (tmp_path / "stopped" / name).read_bytes() == (whole / name).read_bytes()


def test_two_runs_of_one_seed_differ_unless_they_are_seeded(tmp_path: Path) -> None:
    notes: dict[bool, list[str]] = {False: [], True: []}
    for seeded, told in notes.items():
        for name in ("one", "another"):
            folder = tmp_path / f"{name}{seeded}"
            edge(folder, rules("central", seeded=seeded), report=partial(keep_note, told))
            assert not (folder / SECRETS).exists()
        ends = [(tmp_path / f"{name}{seeded}" / WEIGHTS).read_bytes() for name in ("one", "another")]
        assert (ends[0] == ends[1]) == seeded
    assert all(f"at delta 1e-05 ({SEEDED})" in note for note in notes[True])
    assert all(note.endswith("at delta 1e-05") for note in notes[False])


def test_damaged_secrets_are_one_sentence(tmp_path: Path) -> None:
    kill(edge, tmp_path, rules("local"), 5)
    data, known = (tmp_path / SECRETS).read_bytes(), (tmp_path / SECRETS_HASH).read_bytes()
    for damaged in (b"", data[: len(data) // 2], data[:-1] + bytes([data[-1] ^ 1])):
        (tmp_path / SECRETS).write_bytes(damaged)
        told = rf"{SECRETS} is damaged, or {SECRETS_HASH} beside it: .*; remove the folder to begin anew"
        with pytest.raises(InputError, match=told):
            edge(tmp_path, rules("local"))
    (tmp_path / SECRETS).write_bytes(data)
    for damaged in (b"", b"\xff\xfe", known[:-1], known + b"\n"):
        (tmp_path / SECRETS_HASH).write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{SECRETS_HASH} is damaged: .*; remove the folder to begin anew"):
            edge(tmp_path, rules("local"))
    (tmp_path / SECRETS_HASH).unlink()
    (tmp_path / SECRETS).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=rf"{SECRETS} is damaged: .*; remove the folder to begin anew"):
        edge(tmp_path, rules("local"))


def test_secrets_are_written_once(tmp_path: Path) -> None:
    def written() -> list[tuple[int, int]]:
        found = [(tmp_path / name).stat() for name in (SECRETS, SECRETS_HASH)]
        return [(each.st_ino, each.st_mtime_ns) for each in found]

    kill(edge, tmp_path, rules("local"), 2)
    before = written()
    kill(edge, tmp_path, rules("local"), 5)
    assert written() == before


def test_secrets_that_were_drawn_right_before_a_kill_are_kept(tmp_path: Path) -> None:
    kill(edge, tmp_path / "whole", rules("local"), 1)
    shutil.copytree(tmp_path / "whole", tmp_path / "halved")
    (tmp_path / "halved" / SECRETS_HASH).unlink()  # killed between both files
    for name in ("whole", "halved"):
        edge(tmp_path / name, rules("local"))
    assert (tmp_path / "whole" / WEIGHTS).read_bytes() == (tmp_path / "halved" / WEIGHTS).read_bytes()


@pytest.mark.parametrize("updates", [0, 4])
@pytest.mark.parametrize("federate", [edge, cloud])
def test_a_refused_federation_leaves_no_secrets(federate: Federate, updates: int, tmp_path: Path) -> None:
    federate(tmp_path / "measured", rules("local"))
    book = Ledger.load(tmp_path / "measured" / LEDGER)
    sent = [each.bytes for each in book.entries if (each.link, each.direction) == ("wireless", "up")]
    how = {"wireless_mb": (updates + 0.5) * sent[0] / 1e6}
    with pytest.raises(BudgetExceeded):
        federate(tmp_path / "refused", rules("local"), **how)
    left = {path.name for path in (tmp_path / "refused").iterdir() if "secrets" in path.name}
    assert left == ({SECRETS_HASH} if updates else set())
    told = rf"{SECRETS} is missing or not complete: .* have other noise" if updates else "budget exceeded"
    with pytest.raises(InputError, match=told):  # no update is sent a second time with other noise
        federate(tmp_path / "refused", rules("local"), **how)


def test_two_that_begin_at_once_do_not_both_go_on(tmp_path: Path) -> None:
    one, other = ({"edge|server": np.full(32, byte, np.uint8)} for byte in (1, 2))
    assert not read_secrets(tmp_path, one, False)
    assert not read_secrets(tmp_path, other, False)  # both have looked before either wrote
    write_secrets(tmp_path, one)
    (tmp_path / SECRETS_HASH).unlink()  # the first has not come so far
    with pytest.raises(InputError, match="of another process"):
        write_secrets(tmp_path, other)
    write_secrets(tmp_path, one)
    assert [*map(bytes, read_secrets(tmp_path, one, False).values())] == [bytes([1]) * 32]
    assert {path.name for path in tmp_path.iterdir()} == {SECRETS, SECRETS_HASH}


def test_what_killed_processes_left_of_secrets_is_removed(tmp_path: Path) -> None:
    write_secrets(tmp_path, {"edge|server": np.zeros(32, np.uint8)})
    (tmp_path / f"{PART}left").touch()
    remove_secrets(tmp_path)
    assert not [*tmp_path.iterdir()]
