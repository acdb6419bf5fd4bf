"""Lies and inferences against formulas written out, autograd and SciPy, on pictures made of clusters."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu
from torch.nn import functional

from flcav.experiments.attacks import faults
from flcav.experiments.attacks.drives import CLASSES, Drives, Pictures, Vehicle, differentiate, draw_head, find_right
from flcav.experiments.attacks.faults import LIES, STRATEGIES, Liar, choose_liars, run_federation, summarise
from flcav.experiments.attacks.inference import invert, membership_advantage, membership_auc, name_nearest
from flcav.experiments.attacks.leakage import attack, make_level, split_members
from flcav.experiments.attacks.tables import fault_tables
from flcav.federation.reading import read_round
from flcav.federation.rounds import Schedule
from flcav.federation.rules import Rules, SecureAggregation
from flcav.statistics.seeds import OWN_SCENES

START = draw_head(1)
CENTRES = np.random.default_rng(0).normal(0, 3, (CLASSES, 120)).clip(0)


def pictures(seed: int, count: int = 48) -> Pictures:
    rng = np.random.default_rng(seed)
    labels = rng.permutation(np.arange(count) % CLASSES)
    features = (CENTRES[labels] + rng.normal(0, 1, (count, 120))).clip(0).astype(np.float32)
    return Pictures(features, labels, tuple(f"scene{i % 6}" for i in range(count)))


@pytest.fixture(scope="module")
def drives() -> Drives:
    return Drives({f"cav{i}": pictures(i) for i in range(10)}, pictures(99))


def test_gradient_is_that_of_autograd():
    seen = pictures(5)
    tensors = {name: torch.from_numpy(array.copy()).requires_grad_() for name, array in START.items()}
    hidden = functional.linear(torch.from_numpy(seen.features), tensors["layers.9.weight"], tensors["layers.9.bias"])
    logits = functional.linear(hidden.relu(), tensors["layers.11.weight"], tensors["layers.11.bias"])
    functional.cross_entropy(logits, torch.from_numpy(seen.labels)).backward()
    for name, slope in differentiate(START, seen.features, seen.labels).items():
        np.testing.assert_allclose(slope, np.asarray(tensors[name].grad), rtol=1e-3, atol=1e-5)


def test_a_liar_sends_a_multiple_of_its_change():
    how = {"steps": 2, "learning_rate": 0.1, "seed": 4}
    honest = Vehicle(pictures(1)).train(START, **how)
    told = Liar(Vehicle(pictures(1)), -4.0).train(START, **how)
    for name, start in START.items():
        np.testing.assert_allclose(told.weights[name] - start, -4 * (honest.weights[name] - start), atol=1e-5)
    assert told.samples == honest.samples == 48


def test_lies_mislead_the_mean_and_not_the_median(drives: Drives, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(faults, "ROUNDS", 4)
    liars = choose_liars(drives, 1)
    assert len(set(liars)) == 3
    assert set(liars) <= set(drives.vehicles)
    right = {
        (lie, name): [find_right(run_federation(drives, START, liars, lie, strategy, 1), drives.test)]
        for lie in LIES
        for name, strategy in STRATEGIES.items()
    }
    results = summarise(drives, [liars], right)
    reached = results.seeds[0].accuracy
    assert reached["none"]["FedAvg"] > 0.9
    assert reached["sign flip, -4"]["FedAvg"] < 0.5
    assert all(reached[lie][name] > 0.9 for lie in LIES for name in STRATEGIES if name != "FedAvg")
    assert results.gained["sign flip, -4"]["median"].mean > 0.4
    assert "| sign flip, -4 |" in fault_tables(results)["accuracy"]


def test_one_picture_is_read_from_an_update_and_not_from_a_masked_one(drives: Drives):
    first = {
        name: Pictures(each.features[:1], each.labels[:1], each.scenes[:1]) for name, each in drives.vehicles.items()
    }
    clients = {name: Vehicle(each, 1) for name, each in first.items()}
    known = np.concatenate([each.features for each in drives.vehicles.values()])
    schedule = Schedule(1, 1, 1.0, 1.0, 3)
    seen, mean = read_round(clients, START, schedule.work, Rules())
    masked, same = read_round(clients, START, schedule.work, Rules(secure=SecureAggregation()))
    for number, name in enumerate(clients):
        np.testing.assert_allclose(invert(START, seen[name]), first[name].features[0], rtol=1e-3, atol=1e-3)
        assert name_nearest(invert(START, seen[name]), known) == 48 * number
        found = invert(START, masked[name])
        cosine = found @ first[name].features[0] / np.linalg.norm(found) / np.linalg.norm(first[name].features[0])
        assert abs(cosine) < 0.9
    assert {name_nearest(invert(START, each), known) for each in masked.values()} != {48 * i for i in range(10)}
    for name, array in mean.items():
        np.testing.assert_allclose(same[name], array, atol=1e-5)
    assert not invert(START, START).any()


def test_membership_is_told_by_ranks_and_by_the_mean_loss():
    rng = np.random.default_rng(2)
    members, others = rng.normal(0, 1, 60).round(1), rng.normal(0.7, 1, 50).round(1)
    ranked = mannwhitneyu(others, members).statistic / (60 * 50)
    assert membership_auc(members, others) == pytest.approx(ranked)
    assert membership_advantage(np.array([0.0, 2.0, 1.0]), np.array([0.5, 3.0])) == pytest.approx(2 / 3 - 1 / 2)


def test_an_attack_leaves_the_secure_federation_s_accuracy(drives: Drives):
    known = np.concatenate([each.features for each in drives.vehicles.values()])
    seen, secure = attack(drives, known, Rules(), 1), attack(drives, known, Rules(secure=SecureAggregation()), 1)
    open_, masked, summed = seen.by_update, secure.by_update, secure.by_sum
    assert open_.recognised_one == 1
    assert masked.recognised_one < 0.5
    assert summed.recognised_one < 0.5
    assert masked.accuracy == pytest.approx(open_.accuracy, abs=0.05)
    members, others = split_members(drives, 1)
    assert not {*members["cav0"].features[:, 0]} & {*others["cav0"].features[:, 0]} - {0.0}
    level = make_level(drives.test, "none", None, [seen, replace(seen, right=seen.right & (np.arange(48) % 6 > 0))])
    assert level.mean["accuracy"].mean == pytest.approx(open_.accuracy)
    spread = level.mean["accuracy"].shared
    assert spread is not None
    assert spread.scenes == 6
    assert level.mean["membership_auc"].shared == OWN_SCENES
    assert make_level(drives.test, "sum", None, [secure], by_sum=True).seeds == (summed,)
