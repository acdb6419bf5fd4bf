"""Ensemble distillation in the cloud: its loss by independent sums, its rounds, and where it is refused."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from federated_recipes import settings
from federations import cloud_federation, federate_cloud
from line_task import LineTask, Slope

from flcav.config import InputError
from flcav.federation.rules import Rules
from flcav.federation.strategies import FEDAVG
from flcav.federation.strategies.fedavg import FedAvg, average
from flcav.federation.trainable import LocalUpdate, Update, Weights
from flcav.federation.wire import LocalWork
from flcav.geometry import Boxes
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient
from flcav.perception.objects.config import CONFIGURATIONS
from flcav.perception.objects.distillation import SEEN, TaughtObjects, ensemble_loss
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import Task, build_network
from flcav.perception.weights import to_arrays
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.recipe import CloudDistillation, RunRecipe, Training
from flcav.runs.stages.cloud import EnsembleDistillation, RoundWork
from flcav.runs.stages.rounds import RegionStart
from flcav.runs.training.learning import Learning, Strategies, load_stage_network, make_clients
from flcav.statistics.streams import derive_seed

CONFIG = CONFIGURATIONS["pillars"]
TAUGHT: dict[str, Any] = {"cloud_distillation": {"steps": 2}}


def draw(seed: int, bias: float = 0.0) -> torch.Tensor:
    return torch.randn(2, 6, 2, generator=torch.Generator().manual_seed(seed)) + bias


def test_its_loss_is_the_divergence_from_the_mean_logits_by_what_the_ensemble_sees() -> None:
    score, teachers = draw(1), [draw(2, -2), draw(3, -2)]
    total, seen = 0.0, 0
    for own, first, second in zip(*(each.flatten().tolist() for each in (score, *teachers)), strict=True):
        p, q = (1 / (1 + math.exp(-logit)) for logit in ((first + second) / 2, own))
        total += p * math.log(p / q) + (1 - p) * math.log((1 - p) / (1 - q))
        seen += p >= SEEN
    assert 0 < seen < 24
    assert float(ensemble_loss(score, teachers)) == pytest.approx(total / seen, rel=1e-4)
    same = ((teachers[0] + teachers[1]) / 2).requires_grad_()
    ensemble_loss(same, teachers).backward()
    assert same.grad is not None
    assert float(same.grad.abs().max()) < 1e-6


def test_the_networks_of_all_updates_teach_their_mean_on_the_cloud_s_samples() -> None:
    places = np.random.default_rng(1).uniform((8, -12), (40, 12), (2, 2))
    points = np.concatenate([np.random.default_rng(2).normal((x, y, -1, 0), 0.5, (200, 4)) for x, y in places])
    boxes = Boxes.from_array(np.array([(x, y, -1, 4.2, 1.8, 1.5, 0.0) for x, y in places]), "Car")
    client = TaskClient(OBJECTS, CONFIG, [Sample(points.astype(np.float32), boxes)], batch=1)
    networks = [build_network(OBJECTS, CONFIG, seed) for seed in (1, 2)]
    for more, network in enumerate(networks, start=1):
        network.head.bias.data += more  # untrained ones all see nothing
    updates = [LocalUpdate(to_arrays(each), samples, 0.0) for each, samples in zip(networks, (3, 1), strict=True)]
    mean = average([each.weights for each in updates], [3, 1])
    rates = {"steps": 2, "learning_rate": 1e-3, "seed": derive_seed(7, "cloud-distillation")}
    found = {}
    for weight in (0.0, 2.0):
        how = EnsembleDistillation(client, CloudDistillation(steps=2, weight=weight), lambda: LocalWork(3, 9, 1e-3, 7))
        found[weight] = how.combine(mean, updates)
        pupil = TaskClient(TaughtObjects(networks, weight), CONFIG, client.samples, batch=1)
        for name, array in pupil.train(mean, **cast(Any, rates)).weights.items():
            np.testing.assert_array_equal(found[weight][name], array)
    own, *teachers = (each.eval() for each in (build_network(OBJECTS, CONFIG, 3), *networks))
    scores = [predict(each, [client.samples[0].points]).score for each in (own, *teachers)]
    both, first = (ensemble_loss(scores[0], seen).item() for seen in (scores[1:], scores[1:2]))
    assert both != pytest.approx(first, rel=0.01)
    taught, plain = (task.loss(own, client.samples).item() for task in (TaughtObjects(teachers, 1e6), OBJECTS))
    assert (taught - plain) / 1e6 == pytest.approx(both, rel=1e-3)
    labels_alone = client.train(mean, **cast(Any, rates)).weights
    assert all(np.array_equal(found[0.0][name], array) for name, array in labels_alone.items())
    assert not np.array_equal(found[2.0]["head.weight"], labels_alone["head.weight"])


@dataclass(frozen=True)
class AddsRound(FedAvg):
    """The mean of the updates, plus the number of the round."""

    work: RoundWork

    def combine(self, start: Weights, updates: Any) -> Weights:
        mean = super().combine(start, cast(list[Update], updates))
        return {name: np.asarray(array + self.work().round, array.dtype) for name, array in mean.items()}


def test_every_cloud_round_is_taught_by_its_own_work_also_after_a_kill(tmp_path: Path) -> None:
    """The first average is higher by 1; a resumed stage goes on with round 2, and ends with the same weights."""
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=1, average_rounds=1), 3)
    network = learning.build_network()
    clients = make_clients(learning, Slope(), {"a/cav0": [np.float32(0)] * 3})

    def end(folder: str, rounds: int, distil: Any, report: Any = ignore_progress) -> Weights:
        where: Any = (Strategies(FEDAVG, FEDAVG), Ledger(LinkMegabytes(1.0, 1.0)), tmp_path / folder, report)
        regions = {"a": RegionStart(clients, to_arrays(network), 0)}
        federate_cloud(cloud_federation(learning, network, regions, {"a": 1}, *where, distil=distil), rounds, Rules())
        return to_arrays(load_stage_network(learning.task, tmp_path / folder))

    def die(done: int, *_: Any) -> None:
        if done == 1:
            raise KeyboardInterrupt

    plain, once = end("plain", 1, None), end("once", 1, AddsRound)
    for name, array in plain.items():
        np.testing.assert_allclose(once[name], array + 1, rtol=1e-6)
    with pytest.raises(KeyboardInterrupt):
        end("killed", 2, AddsRound, die)
    resumed, whole = end("killed", 2, AddsRound), end("whole", 2, AddsRound)
    for name, array in whole.items():
        np.testing.assert_array_equal(resumed[name], array)
        assert not np.allclose(array, once[name] + 1)  # the second round adds 2


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"personal": ["head.*"]}, "whole networks teach; leave out 'personal', 'upload.layers' and fedmd"),
        ({"upload": {"layers": ["head.*"]}}, "whole networks teach"),
        ({"cloud_strategy": "fedadam"}, "it teaches the mean of fedavg, not of the strategy FedAdam"),
    ],
)
def test_what_cannot_be_taught_is_refused(more: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError, match=f"federation.cloud_distillation: {why}"):
        check_federations(*settings({}, **TAUGHT, **more))


def test_other_tasks_and_plans_without_samples_are_refused() -> None:
    check_federations(*settings({}, **TAUGHT))
    plan = {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}
    recipe: dict[str, Any] = {
        "tasks": {"weather": {"plan": plan}},
        "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
        "budgets_mb": {"wireless": 90, "wireline": 90},
        "arms": {"taught": {"federation": TAUGHT}},
    }
    weather = RunRecipe.model_validate(recipe)
    with pytest.raises(InputError, match="detectors teach by scores, and 'weather' has none"):
        check_federations(weather, resolve_settings(weather).values())
    recipe["tasks"] = {"objects": {"plan": {**plan, "samples": 0}, "weights": "packaged"}}
    for how in ({"steps": 2}, {}):
        recipe["arms"] = {"taught": {"federation": {"cloud_distillation": how}}}
        with pytest.raises(ValueError, match="cloud_distillation: the cloud trains on samples of stage I"):
            RunRecipe.model_validate(recipe)
    recipe["federation"] = {"cloud_distillation": {"steps": 0}}
    with pytest.raises(ValueError, match="steps"):
        RunRecipe.model_validate(recipe)
