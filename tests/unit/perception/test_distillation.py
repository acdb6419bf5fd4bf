"""Class probabilities on shared samples: said by networks, learned from, sent instead of weights, kept over a kill."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from flcav.federation.edge_server import EdgeServer
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.rules import Rules
from flcav.federation.state import FederationState
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import Trainable, Weights
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import PROBABILITIES, OutputClient, SharedSamples, TaskClient
from flcav.perception.signs.loss import assign_levels
from flcav.perception.signs.model import SignsConfig
from flcav.perception.signs.predict import predict_levels
from flcav.perception.signs.samples import Sample as SignSample
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import build_network
from flcav.perception.weather.model import LeNetConfig
from flcav.perception.weather.samples import Sample
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import to_arrays
from flcav.statistics.streams import derive_seed

SKIES = LeNetConfig(classes=("clear", "fog", "night"))
COLOURS = np.array([(60, 120, 240), (200, 200, 200), (8, 8, 20)])
SIGNS_CONFIG = SignsConfig(width=0.25, depth=0.33, classes=("stop", "yield", "no_entry"), window_px=(96, 64))
SCHEDULE = Schedule(rounds=3, steps=2, learning_rate=4e-3, final_learning_rate=1e-3, seed=3)


def pictures(number: int, seed: int, labels: tuple[int, ...] = (0, 1, 2)) -> list[Sample]:
    rng, found = np.random.default_rng(seed), []
    for i in range(number):
        label = labels[i % len(labels)]
        noisy = COLOURS[label] + rng.integers(-60, 60, (32, 32, 3))
        found.append(Sample(noisy.clip(0, 255).astype(np.uint8), label))
    return found


SHARED = SharedSamples(WEATHER, SKIES, pictures(9, 0), batch=4)
START = to_arrays(build_network(WEATHER, SKIES, 5))
VEHICLES = {
    f"grid/cav{i}": OutputClient(TaskClient(WEATHER, SKIES, pictures(6, i + 1, labels), batch=4), SHARED, START)
    for i, labels in enumerate(((0, 1), (1, 2), (0, 2)))
}


def run(rounds: int = 3, weights: Weights = START, **how: Any) -> tuple[Weights, Ledger]:
    account = Account(Ledger(LinkMegabytes(1.0, 0.0)), "edge", "weather", "wireless")
    state = how.pop("state", None) or FederationState()
    schedule = replace(SCHEDULE, rounds=rounds)
    strategy = FedMD(steps=3)
    clients = how.pop("clients", VEHICLES)
    found = federate(clients, weights, schedule, account, strategy=strategy, state=state, distiller=SHARED, **how)
    return found.weights, account.ledger


def test_the_loss_is_the_cross_entropy_with_a_soft_target():
    network = build_network(WEATHER, SKIES, 5)
    targets = [np.array([row], np.float32) for row in ((0.7, 0.2, 0.1), (0.0, 1.0, 0.0))]
    said = [rows[0] for rows in WEATHER.class_probabilities(network, SHARED.samples[:2])]
    assert np.allclose(np.sum(said, axis=1), 1)
    want = -np.mean([np.sum(target[0] * np.log(row)) for target, row in zip(targets, said, strict=True)])
    with torch.no_grad():
        found = float(WEATHER.imitation_loss(network, SHARED.samples[:2], targets))
    assert found == pytest.approx(want, rel=1e-5)


def test_a_network_learns_what_others_say_and_nothing_from_what_it_says_itself():
    wanted = np.eye(3, dtype=np.float32)[[sample.label for sample in SHARED.samples]] * 0.8 + 0.2 / 3
    how: Any = {"steps": 40, "learning_rate": 4e-3, "seed": 1}
    taught = SHARED.outputs(SHARED.imitate(START, {PROBABILITIES: wanted}, **how))[PROBABILITIES]
    assert np.abs(taught - wanted).mean() < 0.1 < np.abs(SHARED.outputs(START)[PROBABILITIES] - wanted).mean()
    assert SHARED.imitate(START, SHARED.outputs(START), **how) is START


def test_rounds_are_what_a_loop_by_hand_gives_and_no_weights_are_sent():
    weights, ledger = run()
    server, mean = START, SHARED.outputs(START)
    own: dict[str, Weights] = {name: {} for name in VEHICLES}
    for number in (1, 2, 3):
        work, sent = SCHEDULE.work(number), []
        for name, vehicle in VEHICLES.items():
            how: Any = {"steps": 2, "learning_rate": work.learning_rate, "seed": derive_seed(work.seed, name)}
            update = vehicle.train(mean, **how, own=own[name], imitation_steps=3)
            own[name] = update.own
            sent.append(update.weights[PROBABILITIES])
        mean = {PROBABILITIES: np.asarray(np.mean(sent, axis=0, dtype=np.float64), np.float32)}
        rate, seed = work.learning_rate, derive_seed(work.seed, "server")
        server = SHARED.imitate(server, mean, steps=3, learning_rate=rate, seed=seed)
    for name, array in server.items():
        np.testing.assert_allclose(weights[name], array, rtol=1e-4, atol=1e-6)
    sizes = [entry.bytes for entry in ledger.entries]
    assert len(sizes) == 2 * 3 * 3
    assert max(sizes) < 9 * 3 * 4 + 600 < sum(array.nbytes for array in START.values()) / 100


def test_clients_of_another_process_a_restart_and_masks_end_with_the_same_network():
    kept: list[Any] = []
    state = FederationState()

    def keep(number: int, weights: Weights, loss: float | None) -> None:
        kept.append((weights, {name: array.copy() for name, array in state.to_arrays().items()}, [*state.records]))

    whole, book = run(state=state, on_round=keep)
    elsewhere, other = run(clients=pickle.loads(pickle.dumps(VEHICLES)))  # as client processes have them
    middle, arrays, records = kept[0]
    resumed = FederationState()
    resumed.restore(arrays, records)
    again, _ = run(weights=middle, state=resumed, done=1)
    masked, _ = run(rules=Rules.model_validate({"secure": {}}))
    for name, array in whole.items():
        np.testing.assert_array_equal(elsewhere[name], array)
        np.testing.assert_array_equal(again[name], array)
        np.testing.assert_allclose(masked[name], array, rtol=1e-3, atol=1e-4)
    assert other.entries == book.entries
    assert {kind for kinds in state.clients.values() for kind in kinds} == {"own"}


def test_edge_servers_send_networks_to_the_cloud():
    book, states = Ledger(LinkMegabytes(1.0, 1.0)), {region: FederationState() for region in ("grid", "ring")}
    wireless, wireline = (Account(book, "cloud", "weather", link) for link in ("wireless", "wireline"))
    servers: dict[str, Trainable] = {
        region: EdgeServer(
            VEHICLES, 1, wireless, START, strategy=FedMD(steps=2), state=state, distiller=SHARED, cloud_rounds_done=0
        )
        for region, state in states.items()
    }
    weights = federate(servers, START, replace(SCHEDULE, rounds=2), wireline).weights
    assert all(np.isfinite(array).all() for array in weights.values())
    assert not np.array_equal(weights["layers.0.weight"], START["layers.0.weight"])
    smallest = {link: min(e.bytes for e in book.entries if e.link == link) for link in ("wireless", "wireline")}
    assert smallest["wireless"] < 1000 < 200_000 < smallest["wireline"]


def sign_sample(seed: int, count: int) -> SignSample:
    rng = np.random.default_rng(seed)
    corner = rng.uniform(5, 40, (count, 2))
    boxes = np.concatenate((corner, corner + rng.uniform(8, 20, (count, 2))), axis=1)
    picture = rng.integers(0, 255, (64, 96, 3)).astype(np.uint8)
    return SignSample(picture, boxes, rng.integers(0, 3, count), np.zeros((0, 4)))


def test_a_sign_has_the_mean_probability_of_its_anchors_and_its_label_is_a_special_case():
    network, samples = (
        build_network(SIGNS, SIGNS_CONFIG, 5).eval(),
        [sign_sample(1, 2), sign_sample(2, 0), sign_sample(3, 3)],
    )
    said = SIGNS.class_probabilities(network, samples)
    assert [rows.shape for rows in said] == [(2, 3), (0, 3), (3, 3)]
    with torch.no_grad():
        raw = predict_levels(network, [samples[0].picture])
    first = [
        raw[level][0, a, r, c, 5:].sigmoid().numpy()
        for level, t in enumerate(assign_levels([samples[0]], SIGNS_CONFIG))
        for a, r, c, box in zip(t.anchor, t.row, t.column, t.box.numpy(), strict=True)
        if np.allclose(box, samples[0].boxes[0])
    ]
    np.testing.assert_allclose(said[0][0], np.mean(first, axis=0), rtol=1e-5)
    labels = [np.eye(3, dtype=np.float32)[sample.label] for sample in samples]
    with torch.no_grad():
        hard, soft = SIGNS.loss(network, samples), SIGNS.imitation_loss(network, samples, labels)
        turned = SIGNS.imitation_loss(network, samples, [1 - rows for rows in labels])
    assert float(soft) == pytest.approx(float(hard), rel=1e-6)
    assert abs(float(turned) - float(hard)) > 1e-3


def test_signs_on_shared_frames_are_learned_from_their_probabilities():
    samples = [sign_sample(seed, 2) for seed in range(2)]
    shared = SharedSamples(SIGNS, SIGNS_CONFIG, samples, batch=2)
    start = to_arrays(build_network(SIGNS, SIGNS_CONFIG, 5))
    wanted = np.tile(np.array([[0.9, 0.05, 0.05]], np.float32), (4, 1))
    taught = shared.imitate(start, {PROBABILITIES: wanted}, steps=4, learning_rate=2e-3, seed=1)
    before, after = (shared.outputs(weights)[PROBABILITIES] for weights in (start, taught))
    assert np.abs(after - wanted).mean() < np.abs(before - wanted).mean()
