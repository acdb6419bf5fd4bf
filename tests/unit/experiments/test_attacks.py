"""Lies and inferences against formulas written out, autograd and SciPy, on pictures made of clusters."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu
from torch.nn import functional

from flcav.federation.loop import Schedule
from flcav.federation.rules import Rules, SecureAggregation
from flcav.reproductions.federation.drives import (
    CLASSES,
    Drives,
    Pictures,
    Vehicle,
    differentiate,
    draw_head,
    find_right,
)
from flcav.reproductions.federation.faults import run as faults
from flcav.reproductions.federation.faults.run import (
    LIES,
    STRATEGIES,
    Liar,
    choose_liars,
    fault_tables,
    run_federation,
    summarise,
)
from flcav.reproductions.federation.leakage.run import (
    attack,
    invert,
    make_level,
    membership_advantage,
    membership_auc,
    name_nearest,
    read_round,
    split_members,
)
from flcav.reproductions.federation.mixing import run as withstood
from flcav.reproductions.federation.mixing.run import (
    ATTACKS,
    CLIENTS,
    INNER,
    LABEL,
    LITTLE,
    NOISE,
    RULES,
    SIGN,
    draw_fleet,
    draw_network,
    lie,
    list_worst,
    make_rules,
    repeat_withstood,
    run_rounds,
    train_clients,
    withstood_tables,
)
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_clients_at_once_take_the_steps_of_autograd():
    fleet, start = draw_fleet("unlike", 2), draw_network(2)
    found = train_clients(start, fleet.features, fleet.labels, 0.2, np.random.default_rng(5))
    own = {name: torch.from_numpy(array.copy()).requires_grad_() for name, array in start.items()}
    draws = np.random.default_rng(5)
    for _ in range(withstood.STEPS):
        places = draws.integers(withstood.SAMPLES, size=(CLIENTS, withstood.BATCH))[3]  # of the fourth client
        hidden = functional.linear(
            torch.from_numpy(fleet.features[3, places]), own["layers.9.weight"], own["layers.9.bias"]
        )
        logits = functional.linear(hidden.relu(), own["layers.11.weight"], own["layers.11.bias"])
        slopes = torch.autograd.grad(
            functional.cross_entropy(logits, torch.from_numpy(fleet.labels[3, places])), list(own.values())
        )
        own = {name: (array - 0.2 * s).detach().requires_grad_() for (name, array), s in zip(own.items(), slopes)}
    for name, array in own.items():
        np.testing.assert_allclose(found[name][3], array.detach().numpy(), atol=1e-5)


def test_colluding_attacks_are_those_of_their_papers():
    rng = np.random.default_rng(3)
    start, sent = rng.normal(size=5), rng.normal(size=(7, 5))
    mean, deviation = np.mean(sent[2:], axis=0), np.sqrt(np.mean((sent[2:] - np.mean(sent[2:], axis=0)) ** 2, axis=0))
    expected = {LITTLE: mean - 1.5 * deviation, INNER: start - (mean - start), LABEL: None, SIGN: None, NOISE: None}
    for kind, told in expected.items():
        found = lie(kind, 2, start, sent, np.random.default_rng(4))
        np.testing.assert_array_equal(found[2:], sent[2:])
        if told is not None:
            np.testing.assert_allclose(found[:2], [told, told])
    np.testing.assert_allclose(lie(SIGN, 2, start, sent, rng)[0] - start, -4 * (sent[0] - start))
    np.testing.assert_array_equal(lie(LABEL, 2, start, sent, rng), sent)
    noise = np.concatenate([lie(NOISE, 2, start, sent, rng)[:2] - start for _ in range(400)])
    assert np.sqrt((noise**2).sum(axis=1).mean()) == pytest.approx(10 * np.linalg.norm(mean - start), rel=0.05)


def test_rules_of_the_study_know_the_attackers_and_mixing_withstands_what_krum_does_not(monkeypatch):
    monkeypatch.setattr(withstood, "ROUNDS", 8)
    rules, fleet = make_rules(6), draw_fleet("very unlike", 1)
    assert (rules["mixing, Krum"].byzantine, rules["mixing, Krum"].mixing) == (6, 6)  # type: ignore[attr-defined]
    assert rules["multi-Krum"].kept == 14  # type: ignore[attr-defined]
    reached = {
        rule: find_right(run_rounds(fleet, rules[rule], SIGN, 6, 1), fleet.test).mean()
        for rule in ("mean", "Krum", "mixing, Krum")
    }
    assert reached["mean"] < 0.25
    assert reached["mixing, Krum"] > reached["Krum"] + 0.1
    assert {np.bincount(own, minlength=CLASSES).max() > 30 for own in fleet.labels} == {True, False}


def test_the_study_of_what_rules_withstand_at_toy_scale(monkeypatch, tmp_path):
    monkeypatch.setattr(withstood, "ROUNDS", 2)
    monkeypatch.setattr(withstood, "UNLIKENESS", {"alike": 1e6})
    monkeypatch.setattr(withstood, "ATTACKERS", (6,))
    results, pictures = repeat_withstood(tmp_path, 2)
    assert len(results.rows) == 1 + len(ATTACKS)
    assert pictures["withstood.png"].startswith(b"\x89PNG")
    (first, *_), worst = results.rows, list_worst(results)["alike"]
    assert first.lost["mean"].mean == 0
    for rule in RULES:
        hardest = min(each.accuracy[rule].mean for each in results.attacked)
        assert worst[rule] == [hardest]
        lost = first.accuracy["mean"].mean - hardest
        assert results.worst("alike", 6, rule).lost[rule].mean == pytest.approx(lost)
    monkeypatch.setattr("flcav.reproductions.federation.mixing.run.UNLIKENESS", ["alike"])
    monkeypatch.setattr("flcav.reproductions.federation.mixing.run.ATTACKERS", (6,))
    tables = withstood_tables(results)
    assert tables["worst"].splitlines()[-1].startswith("| alike | 30 % |")
    assert len(tables["thirty"].splitlines()) == 2 + 6
