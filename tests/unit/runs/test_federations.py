"""Federations of a recipe: planned with what they send, scored, timed, gone on with, ended by their budgets."""

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from federated_recipes import PRIVACY, settings
from federations import cloud_federation, edge_federation, federate_cloud, federate_edge
from line_task import LineTask, Slope
from safetensors.numpy import load_file

from flcav.config import InputError
from flcav.federation.exchange import ClientFailed
from flcav.federation.privacy import account_epsilon
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.fedopt import FedAdam, FedAvgM
from flcav.federation.trainable import LocalUpdate, Weights, learned_names
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import Task
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import from_arrays, to_arrays
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import find_strategies
from flcav.runs.driving import DrivenStage
from flcav.runs.recipe import Federation, Training
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.results.training import StatisticsScore
from flcav.runs.stages.rounds import RegionStart, StageFederation, federate_stage
from flcav.runs.training.checkpoints import round_path
from flcav.runs.training.learning import (
    Learning,
    Strategies,
    keep_statistics,
    load_stage_network,
    make_clients,
    score_statistics,
)
from flcav.runs.training.timing import TIMES, TrainTimes, read_times, summarise_times, time_clients
from flcav.runs.training.updates import UpdateForm, model_mb, update_forms
from flcav.statistics.streams import derive_seed

BUSY_S = 0.05  # CPU time of a training


def test_the_cloud_s_replay_is_one_more_in_its_averages_and_sends_nothing(tmp_path: Path) -> None:
    """By hand: the mean of the edge servers' networks and of the cloud's own training, by its share."""
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=1), 3)
    network, samples = learning.build_network(), {"a": [np.float32(1)] * 3, "b": [np.float32(2)] * 2}
    start = to_arrays(network)
    clients = {name: make_clients(learning, Slope(), {f"{name}/cav0": own}) for name, own in samples.items()}
    regions = {name: RegionStart(own, start, 0) for name, own in clients.items()}
    replay = TaskClient(learning.task, Slope(), [np.float32(-1)] * 4, batch=2)
    ends = {}
    for folder, cloud in (("without", None), ("with", replay)):
        book = Ledger(LinkMegabytes(1.0, 1.0))
        where: Any = (Strategies(FEDAVG, FEDAVG), book, tmp_path / folder, ignore_progress)
        federation = cloud_federation(
            learning, network, regions, dict.fromkeys(regions, 1), *where, replay=cloud, replay_share=0.3
        )
        federate_cloud(federation, 1, Rules())
        ends[folder] = to_arrays(load_stage_network(learning.task, tmp_path / folder))
        assert {entry.client for entry in book.entries} == {"a", "b", "a/cav0", "b/cav0"}
    work = learning.schedule(1, 2, "cloud", "").work(1)
    own = replay.train(start, steps=2, learning_rate=work.learning_rate, seed=derive_seed(work.seed, "cloud-replay"))
    for name, array in ends["without"].items():
        wanted = (5 * array.astype(np.float64) + 2 * own.weights[name].astype(np.float64)) / 7  # .3 of 7.1 samples
        np.testing.assert_allclose(ends["with"][name], wanted, rtol=1e-5)
    with pytest.raises(InputError, match=r"federation.replay: the cloud's own training goes with whole networks"):
        check_federations(*settings({}, replay=0.5, strategy="fedmd"))


def test_statistics_are_those_of_a_network_that_has_some() -> None:
    recipe, arms = settings({}, score_statistics=True)
    check_federations(recipe, arms)
    for task, name in ((OBJECTS, "tiny"), (WEATHER, "normalised")):
        network: Any = Learning(cast(Task, task), name, Training(), 3).build_network()
        assert learned_names(to_arrays(network)) == [name for name, _ in network.named_parameters()]
    plain = recipe.model_copy(update={"tasks": {"weather": recipe.tasks["objects"]}})
    with pytest.raises(InputError, match=r"federation.score_statistics: the network of weather has no batch norm"):
        check_federations(plain, arms)


def test_a_network_is_scored_with_each_region_s_own_statistics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = Learning(WEATHER, "normalised", Training(), 3).build_network()
    averaged = to_arrays(network)
    ring = {name: array + (5 if "running" in name else 1) for name, array in averaged.items()}
    keep_statistics(ring, tmp_path, "ring")
    seen: list[Any] = []

    def score(task: Any, network: Any, data: Any, frames: Any) -> float:
        seen.append(to_arrays(network))
        return float(len(seen))

    monkeypatch.setattr("flcav.runs.training.learning.score_network", score)
    frames: Any = SimpleNamespace(data=None, vehicles=[1, 2, 3])
    found = score_statistics(cast(Task, WEATHER), network, tmp_path, {"grid": frames, "ring": frames})
    assert found == (StatisticsScore("ring", 3, averaged=1.0, own=2.0),)  # none of grid were kept
    for name, array in averaged.items():
        assert np.array_equal(seen[0][name], array)
        assert np.array_equal(seen[1][name], ring[name] if "running" in name else array)


def test_strategies_are_by_name_and_settings() -> None:
    how = Federation.model_validate({"strategy": {"fedavgm": {"momentum": 0.5}}})
    assert find_strategies(how) == (FedAvgM(momentum=0.5), FedAvgM(momentum=0.5))
    assert find_strategies(Federation(strategy="scaffold"))[1] == FEDAVG
    assert find_strategies(Federation(strategy="scaffold", cloud_strategy="fedadam"))[1] == FedAdam()
    check_federations(*settings({"masked": {"secure": {}}, "few": {"upload": {"compression": "top-k"}}}))


def test_the_largest_update_of_the_arms_is_planned_with() -> None:
    fp16 = {"upload": {"compression": "fp16"}}
    assert update_forms(settings({"adam": {"strategy": "fedadam"}})[1]) == [UpdateForm()]
    forms = update_forms(settings({"twice": {"strategy": "scaffold"}}, **fp16)[1])
    assert forms == [UpdateForm(**cast(Any, fp16)), UpdateForm(**cast(Any, fp16), exchanging=True)]
    outputs = {"strategy": {"fedmd": {"frames": 8}}}
    assert update_forms(settings({"outputs": outputs})[1]) == [UpdateForm(), UpdateForm(frames=8)]
    whole = model_mb(OBJECTS, "tiny")
    half, more = (model_mb(OBJECTS, "tiny", [form]) for form in forms)
    assert half == pytest.approx(whole / 2, rel=0.05)
    assert more == pytest.approx(1.5 * whole, rel=0.05)
    assert model_mb(OBJECTS, "tiny", forms) == more


class Busy:
    """A client that computes for some CPU time, and waits as long."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        end = time.process_time() + BUSY_S
        while time.process_time() < end:
            pass
        time.sleep(BUSY_S)
        return LocalUpdate(weights, 1, 0.0)


def test_the_cpu_time_of_every_training_is_kept_and_changes_nothing(tmp_path: Path) -> None:
    (timed,) = time_clients({"a/cav0": Busy()}, tmp_path / "busy").values()
    for seed in range(3):
        timed.train({}, steps=1, learning_rate=0.1, seed=seed)
    assert read_times(tmp_path / "busy") == {"a/cav0": pytest.approx([BUSY_S] * 3, rel=0.3)}
    (tmp_path / "busy" / TIMES).open("a").write("a/cav0,0.0")  # a kill
    assert len(read_times(tmp_path / "busy")["a/cav0"]) == 3
    (resumed,) = time_clients({"a/cav0": Busy()}, tmp_path / "busy").values()
    resumed.train({}, steps=1, learning_rate=0.1, seed=3)
    assert {name: len(times) for name, times in read_times(tmp_path / "busy").items()} == {"a/cav0": 4}
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2), 3)
    network = learning.build_network()
    clients = make_clients(learning, Slope(), {f"a/cav{i}": [np.float32(i), np.float32(1)] for i in range(2)})
    ends = []
    for folder in (tmp_path / "timed", tmp_path / "plain"):
        how = (FEDAVG, 0, Ledger(LinkMegabytes(1.0, 1.0)), folder, ignore_progress)
        federation = edge_federation(learning, network, clients, learning.schedule(3, 2, "edge", "a"), *how)
        federate_edge(federation, Rules(), timed=folder.name == "timed")
        ends.append({path.name: path.read_bytes() for path in folder.iterdir() if path.name != TIMES})
    assert ends[0] == ends[1]
    assert {name: len(times) for name, times in read_times(tmp_path / "timed").items()} == {"a/cav0": 3, "a/cav1": 3}
    assert read_times(tmp_path / "plain") == {}
    secret = Rules.model_validate({"privacy": PRIVACY, "selection": {"rule": "uniform", "clients": 1}})
    how = (FEDAVG, 0, Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / "secret", ignore_progress)
    schedule = learning.schedule(1, 2, "edge", "a")
    federate_edge(edge_federation(learning, network, clients, schedule, *how), secret, timed=True)
    assert not (tmp_path / "secret" / TIMES).exists()  # its lines would name who was drawn


def test_unbiased_federations_are_timed_too(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1), 3)
    clients = make_clients(learning, Slope(), {f"a/cav{i}": [np.float32(i + 1)] for i in range(3)})
    how = (FEDAVG, 0, Ledger(LinkMegabytes(1.0, 1.0)), tmp_path, ignore_progress)
    schedule = learning.schedule(2, 1, "edge", "a")
    rules = Rules.model_validate({"selection": {"rule": "uniform", "clients": 2, "unbiased": True}})
    federate_edge(edge_federation(learning, learning.build_network(), clients, schedule, *how), rules, timed=True)
    assert sum(map(len, read_times(tmp_path).values())) == 2 * 2


def test_measured_speeds_are_those_of_a_recipe() -> None:
    measured = {
        "objects": {"a/cav0": [2.0, 2.0, 9.0], "a/cav1": [4.0, 4.0, 4.0], "b/cav0": [4.0, 5.0]},
        "weather": {"a/cav1": [1.0], "a/cav0": [1.0]},
        "signs": {},
    }
    assert summarise_times(measured) == TrainTimes(
        train_s={"objects": 4.0, "weather": 1.0},
        vehicle_train_s={
            "objects": {"a/cav0": 2.0, "a/cav1": 4.0, "b/cav0": 4.5},
            "weather": {"a/cav0": 1.0, "a/cav1": 1.0},
        },
        speed={"a": {"cav0": 5 / 3, "cav1": 1.0}, "b": {"cav0": 4 / 4.5}},
    )


def two_regions(folder: Path) -> StageFederation:
    """Return a federation of two regions with two vehicles each, whose samples are near 1 and near 4."""
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=1), 3)
    network = learning.build_network()
    starts = {}
    for region, x in (("a", 1.0), ("b", 4.0)):
        clients = make_clients(learning, Slope(), {f"{region}/cav{i}": [np.float32(x + i)] for i in range(2)})
        starts[region] = RegionStart(clients, to_arrays(network), earlier=0)
    where = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), folder, ignore_progress)
    return cloud_federation(learning, network, starts, dict.fromkeys(starts, 1), *where)


def test_a_region_s_own_model_is_beside_that_of_all(tmp_path: Path) -> None:
    federation = two_regions(tmp_path)
    federate_cloud(federation, 2, Rules(personal=("bias",)))
    found = {name: to_arrays(load_stage_network(federation.learning.task, tmp_path, name)) for name in (None, "a", "b")}
    assert np.array_equal(found["a"]["weight"], found["b"]["weight"])
    assert np.array_equal(found["a"]["weight"], found[None]["weight"])
    assert found["a"]["bias"] != found["b"]["bias"]
    assert found[None]["bias"] == pytest.approx((found["a"]["bias"] + found["b"]["bias"]) / 2)
    with pytest.raises(InputError, match="personal: 'head' matches none of 2 arrays"):
        federate_cloud(federation, 2, Rules(personal=("head",)))


def test_regional_models_are_beside_that_of_all(tmp_path: Path) -> None:
    federation = two_regions(tmp_path)
    rules = Rules.model_validate({"personal": {"pull": 0.5}})
    federate_cloud(federation, 2, rules)
    found = {name: to_arrays(load_stage_network(federation.learning.task, tmp_path, name)) for name in (None, "a", "b")}
    for name in ("weight", "bias"):
        assert found["a"][name] != found["b"][name]
        assert found[None][name] == pytest.approx((found["a"][name] + found["b"][name]) / 2)


class Powerless:
    """A client that fails in every training."""

    def train(self, weights: Weights, **how: Any) -> LocalUpdate:
        raise OSError("no power")


def test_the_note_of_a_round_names_who_failed_in_it(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1), 3)
    network, notes = learning.build_network(), []
    clients: Any = make_clients(learning, Slope(), {f"a/cav{i}": [np.float32(i + 1)] for i in range(4)})
    clients |= dict.fromkeys(("a/cav0", "a/cav2"), Powerless())

    def report(done: int, total: int, note: str = "") -> None:
        notes.append(note.partition(", ")[2])

    for rounds in (2, 3):  # the third goes on from the checkpoint of the second
        how = (FEDAVG, 0, Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / "edge", report)
        schedule = learning.schedule(rounds, 1, "edge", "a")
        federate_edge(edge_federation(learning, network, clients, schedule, *how), Rules())
    names = [f"{name} (OSError('no power'))" for name in ("a/cav0", "a/cav2")]
    assert notes == ["failed or lost: " + ", ".join(names)] * 3
    notes.clear()
    start = {"a": RegionStart(clients, to_arrays(network), earlier=0)}
    where = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / "cloud", report)
    federate_cloud(cloud_federation(learning, network, start, dict.fromkeys(start, 2), *where), 2, Rules())
    assert notes == ["failed or lost: " + ", ".join(f"{name} in 2" for name in names)] * 2


def test_both_stages_in_two_processes_end_with_the_bytes_of_one_also_where_labels_change(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=1), 3)
    network, schedule = learning.build_network(), learning.schedule(3, 2, "edge", "a")

    def end(processes: int, renewed: bool = True) -> tuple[bytes, ...]:
        samples = {name: [np.float32(1), np.float32(i)] for i, name in enumerate(("a/cav0", "a/cav1", "b/cav0"))}
        clients = make_clients(learning, Slope(), samples)

        def renew(round_: int, weights: Weights) -> None:
            for own in samples.values():
                own[0] = np.float32(round_) + weights["bias"][0]

        regions = {name: {each: clients[each] for each in clients if each.startswith(name)} for name in ("a", "b")}
        folders = [tmp_path / f"{stage}-{processes}-{renewed}" for stage in ("edge", "cloud")]
        how = (Ledger(LinkMegabytes(1.0, 1.0)), folders[0], ignore_progress)
        edge = edge_federation(learning, network, regions["a"], schedule, FEDAVG, 0, *how)
        federate_edge(replace(edge, relabel=renew if renewed else None), Rules(), processes=processes)
        starts = {name: RegionStart(own, to_arrays(network), earlier=3) for name, own in regions.items()}
        where = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), folders[1], ignore_progress)
        federate_cloud(
            cloud_federation(learning, network, starts, dict.fromkeys(starts, 2), *where),
            2,
            Rules(),
            processes=processes,
        )
        return tuple((folder / WEIGHTS).read_bytes() for folder in folders)

    assert end(2) == end(1)
    assert end(1, renewed=False)[0] != end(1)[0]


def test_cloud_rounds_begin_the_learning_rate_anew_where_that_is_asked_for_and_stage_two_stays_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, (main, anew) = settings({"anew": {"cloud_rate": 0.4, "personal": ["head.*"]}})
    assert anew.federation.cloud_rate == 0.4
    assert anew.edge_federation == main.edge_federation == main.federation

    rates: list[float] = []
    train = TaskClient.train

    def telling(client: Any, weights: Any, *, learning_rate: float, **how: Any) -> Any:
        rates.append(learning_rate / LineTask.practice.learning_rate)
        return train(client, weights, learning_rate=learning_rate, **how)

    monkeypatch.setattr(TaskClient, "train", telling)
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1, final_rate=0.1), 3)
    network = learning.build_network()
    clients = make_clients(learning, Slope(), {"a/cav0": [np.float32(1), np.float32(2)]})
    starts = {"a": RegionStart(clients, to_arrays(network), earlier=2)}
    for rate, expected in ((None, [0.1, 0.1]), (0.4, [0.4, 0.1])):
        how = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / str(rate), ignore_progress)
        federate_cloud(
            cloud_federation(learning, network, starts, dict.fromkeys(starts, 1), *how, rate=rate), 2, Rules()
        )
        assert rates == pytest.approx(expected)
        rates.clear()


def test_a_share_of_the_pretrained_weights_is_in_the_result_of_stage_three(tmp_path: Path) -> None:
    """By hand, from the files of the last two of three rounds; no round and no message changes."""
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2, average_rounds=2), 3)
    network = learning.build_network()
    clients = make_clients(learning, Slope(), {"a/cav0": [np.float32(1), np.float32(2)]})
    starts = {"a": RegionStart(clients, {name: array + 1 for name, array in to_arrays(network).items()}, earlier=2)}
    books = {share: Ledger(LinkMegabytes(1.0, 1.0)) for share in (0.0, 0.75)}
    for share, book in books.items():
        how = (Strategies(FEDAVG, FEDAVG), book, tmp_path / str(share), ignore_progress)
        federation = cloud_federation(learning, network, starts, dict.fromkeys(starts, 1), *how, start_share=share)
        federate_cloud(federation, 3, Rules())
    found = to_arrays(load_stage_network(learning.task, tmp_path / "0.75"))
    rounds = [load_file(round_path(tmp_path / "0.0", number)) for number in (2, 3)]
    for name, begun in to_arrays(network).items():
        wanted = 0.75 * begun + 0.25 * (rounds[0][name] + rounds[1][name]) / 2
        np.testing.assert_allclose(found[name], wanted, rtol=1e-6)
        assert not np.allclose(wanted, begun)
    assert books[0.0].entries == books[0.75].entries
    _, (main, shared) = settings({"shared": {"cloud_start_share": 0.75}})
    assert shared.edge_federation == main.edge_federation


def test_a_privacy_budget_ends_both_stages(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2), 3)
    network = learning.build_network()
    samples = {region: {f"{region}/cav{i}": [np.float32(i), np.float32(1)] for i in range(3)} for region in ("a", "b")}
    clients = {region: make_clients(learning, Slope(), each) for region, each in samples.items()}
    private = PRIVACY | {"seeded": True}  # by chance, secret noise can make a training diverge, which ends it as well
    rules = Rules.model_validate({"privacy": private})
    assert rules.privacy is not None
    sixth = account_epsilon(rules.privacy, rules.selection, [*clients["a"]], 6)
    rules = Rules.model_validate({"privacy": private | {"epsilon": sixth + 1e-6}})
    assert rules.privacy is not None
    noted: list[str] = []

    def report(done: int, total: int, note: str = "") -> None:
        noted.append(note)

    def edge(rounds: int, earlier: int) -> int:
        folder = tmp_path / f"{rounds}-{earlier}"
        schedule = learning.schedule(rounds, 2, "edge", "a")
        book = Ledger(LinkMegabytes(1.0, 1.0))
        how, begun = (FEDAVG, earlier, book, folder, report), []
        federation = edge_federation(
            *(learning, network, clients["a"], schedule, *how),
            relabel=lambda round_, weights: begun.append(round_),
        )
        losses = federate_edge(federation, rules)
        assert (folder / "weights.safetensors").exists()
        assert begun == list(range(1, len(losses) + 1))
        assert federate_edge(federation, rules) == losses  # from its checkpoint
        assert len(begun) == len(losses)
        return len(losses)

    assert (edge(3, 0), edge(9, 0), edge(9, 4)) == (3, 6, 2)
    assert f"epsilon {sixth:.2f} at delta 1e-05" in noted[-1]
    starts = {region: RegionStart(own, to_arrays(network), earlier=2) for region, own in clients.items()}

    def cloud(edge_rounds: int) -> int:
        book, folder = Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / f"cloud{edge_rounds}"
        how = (Strategies(FEDAVG, FEDAVG), book, folder, report)
        return len(
            federate_cloud(
                cloud_federation(learning, network, starts, dict.fromkeys(starts, edge_rounds), *how), 9, rules
            )
        )

    assert (cloud(1), cloud(2), cloud(3)) == (4, 2, 1)
    fifth = account_epsilon(rules.privacy, rules.selection, [*clients["a"]], 5)
    assert f"epsilon {fifth:.2f} at delta 1e-05" in noted[-1]
    assert (cloud(5), edge(9, 6)) == (0, 0)  # it affords no cloud round of five edge rounds, and nothing more


class Explodes:
    """A client whose weights count the rounds, and whose loss is what is given for each; None: no finite update."""

    def __init__(self, losses: list[float | None]) -> None:
        self.losses = losses

    def train(self, weights: Weights, **how: Any) -> LocalUpdate:
        number = round(float(weights["bias"][0]))  # of the rounds before
        loss = self.losses[number]
        moved = {name: np.full_like(array, np.nan if loss is None else number + 1) for name, array in weights.items()}
        return LocalUpdate(moved, 1, loss or 0.0)


@pytest.mark.parametrize(
    ("losses", "rounds", "kept"),
    [
        ([0.8, 0.7, 0.6, 2945961.0, 1.0], 4, 2),  # round 3 began with the weights after round 2, and was sound
        ([0.8, 50.0, 1.0, 1.0, 1.0], 2, 0),  # of the first weights alone a sound loss is known
        ([0.8, 0.7, None, 1.0, 1.0], 2, 1),  # no update of the third round is finite
        ([0.8, 0.7, 0.6, 9.9, 1.0], 5, None),
    ],
)
def test_a_training_that_diverges_stops_and_keeps_the_last_weights_known_to_be_sound(
    losses: list[float | None], rounds: int, kept: int | None, tmp_path: Path
) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1, average_rounds=1, start_share=0.0), 3)
    network, notes = learning.build_network(), []
    from_arrays(network, {name: np.zeros_like(array) for name, array in to_arrays(network).items()})
    clients: Any = {f"a/cav{i}": Explodes(losses) for i in range(2)}

    def report(done: int, total: int, note: str = "") -> None:
        notes.append(note)

    def end() -> tuple[tuple[float | None, ...], int | None]:
        book = Ledger(LinkMegabytes(1.0, 1.0))
        how = (learning.schedule(5, 1, "edge", "a"), FEDAVG, 0, book, tmp_path, report)
        return federate_stage(edge_federation(learning, network, clients, *how), DrivenStage(Rules(), {}))

    assert end() == (tuple(losses[:rounds]), kept)
    reached = float(to_arrays(load_stage_network(learning.task, tmp_path))["bias"][0])
    assert reached == (rounds if kept is None else kept)
    told = [note for note in notes if "diverges and stops" in note]
    assert len(told) == (kept is not None)
    if kept is not None:
        assert told[0].endswith(f"after round {kept}" if kept else "that it began with")
    (tmp_path / LEDGER).unlink()  # as if it was killed before it ended
    assert end() == (tuple(losses[:rounds]), kept)  # no further round is begun
    assert float(to_arrays(load_stage_network(learning.task, tmp_path))["bias"][0]) == reached


def test_a_later_stage_diverges_by_the_loss_that_stage_two_began_with(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1, start_share=0.0), 3)
    network = learning.build_network()
    from_arrays(network, {name: np.zeros_like(array) for name, array in to_arrays(network).items()})
    clients: Any = {"a/cav0": Explodes([50.0, 50.0])}
    ends = {}
    for first in (None, 0.5):
        book, folder = Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / str(first)
        how = (learning.schedule(2, 1, "more_edge", "a"), FEDAVG, 3, book, folder, ignore_progress)
        federation = replace(edge_federation(learning, network, clients, *how), first_loss=first)
        ends[first] = federate_stage(federation, DrivenStage(Rules(), {}))
    assert ends == {None: ((50.0, 50.0), None), 0.5: ((50.0,), 0)}


def test_updates_that_are_not_finite_in_the_first_round_are_an_error(tmp_path: Path) -> None:
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1), 3)
    network = learning.build_network()
    from_arrays(network, {name: np.zeros_like(array) for name, array in to_arrays(network).items()})
    how = (learning.schedule(2, 1, "edge", "a"), FEDAVG, 0, Ledger(LinkMegabytes(1.0, 1.0)), tmp_path, ignore_progress)
    clients: Any = {"a/cav0": Explodes([None])}
    with pytest.raises(ClientFailed, match="values that are not finite"):
        federate_edge(edge_federation(learning, network, clients, *how), Rules())
