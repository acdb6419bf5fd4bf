"""Training: the same for a seed, wherever it stopped; and it learns."""

import numpy as np
import pytest
import torch

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.client import TaskClient
from flcav.perception.objects import detect_all
from flcav.perception.objects.evaluate import score_detections
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth
from flcav.perception.task import build_network, find_configuration
from flcav.perception.training import Checkpointing, Validation, batches, train, train_steps
from flcav.perception.training.loop import one_cycle
from flcav.perception.weights import to_arrays

from .toy import spin, toy_sample

RAYS = spin(beams=16, azimuths=300, field_of_view_deg=180)


@pytest.fixture(scope="module")
def samples():
    return [toy_sample(seed, RAYS) for seed in range(5)]


def tiny(seed=1):
    return build_network(OBJECTS, find_configuration(OBJECTS, "tiny"), seed)


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(to_arrays(one).values(), to_arrays(other).values(), strict=True))


def test_one_seed_one_result(samples):
    networks = [tiny(), tiny(), tiny()]
    for network, seed in zip(networks, (3, 3, 4), strict=True):
        train_steps(OBJECTS, network, samples, steps=2, learning_rate=1e-3, seed=seed)
    assert same(networks[0], networks[1])
    assert not same(networks[0], networks[2])


class Killed(Exception):
    """Stands for SIGKILL: nothing is caught, nothing is written after it."""


def test_a_killed_run_goes_on_to_the_same_weights(samples, tmp_path):
    settings = {"steps": 5, "seed": 3, "learning_rate": 1e-3}
    whole, cut = tiny(), tiny()
    losses = train(OBJECTS, whole, samples, **settings).losses
    checkpointing = Checkpointing(tmp_path / "checkpoint.pt", every=2)

    def kill(done, total, note):
        if done == 3:
            raise Killed

    with pytest.raises(Killed):
        train(OBJECTS, cut, samples, checkpointing=checkpointing, progress=kill, **settings)
    resumed = tiny()
    seen = []
    again = train(
        OBJECTS, resumed, samples, checkpointing=checkpointing, progress=lambda done, *_: seen.append(done), **settings
    )
    assert seen == [3, 4, 5]
    assert np.array_equal(losses, again.losses)
    assert same(whole, resumed)


def test_a_checkpoint_of_another_run_is_refused(samples, tmp_path):
    checkpointing = Checkpointing(tmp_path / "checkpoint.pt", every=1)
    train(OBJECTS, tiny(), samples, steps=1, seed=0, checkpointing=checkpointing)
    with pytest.raises(InputError, match="other settings"):
        train(OBJECTS, tiny(), samples, steps=1, seed=1, checkpointing=checkpointing)


def test_a_damaged_checkpoint_is_told_and_the_training_begins_anew(samples, tmp_path):
    def report(done, total, note):
        told.append((done, note))

    told = []
    checkpointing, whole = Checkpointing(tmp_path / "checkpoint.pt", every=1), tiny()
    train(OBJECTS, whole, samples, steps=2, seed=0, checkpointing=checkpointing)
    data, state = checkpointing.path.read_bytes(), torch.load(checkpointing.path, weights_only=True)
    torch.save(state | {"optimizer": {"state": {}, "param_groups": []}}, checkpointing.path)
    for damaged in (checkpointing.path.read_bytes(), b"garbage", b"", data[: len(data) // 2]):
        checkpointing.path.write_bytes(damaged)
        again = tiny()
        told.clear()
        train(OBJECTS, again, samples, steps=2, seed=0, checkpointing=checkpointing, progress=report)
        assert told[0] == (0, f"{checkpointing.path} is damaged, training begins anew")
        assert [done for done, _ in told] == [0, 1, 2]
        assert same(whole, again)


def test_no_samples_and_unknown_schedules_are_refused(samples):
    with pytest.raises(InputError, match="0 samples"):
        train(OBJECTS, tiny(), [], steps=1, seed=0)
    with pytest.raises(InputError, match="one_cycle"):
        train(OBJECTS, tiny(), samples, steps=1, seed=0, schedule="spiral")
    with pytest.raises(InputError, match="0 samples"):
        TaskClient(OBJECTS, tiny().config, [])


def test_validation_ends_a_training_and_leaves_its_best_weights(samples):
    scores, kept = iter((0.1, 0.5, 0.5, 0.4, 0.9)), []

    def score(network):
        kept.append(to_arrays(network))
        return next(scores)

    network = tiny()
    history = train(OBJECTS, network, samples, steps=9, seed=0, validation=Validation(score, every=1, patience=2))
    assert history.scores.tolist() == [0.1, 0.5, 0.5, 0.4]
    assert len(history.losses) == 4
    assert all(np.array_equal(array, kept[1][name]) for name, array in to_arrays(network).items())


@pytest.mark.parametrize(
    ("scores", "over"), [([], False), ([0.3, 0.2], False), ([0.3, 0.2, 0.3], True), ([0.3, 0.2, 0.31], False)]
)
def test_patience_is_validations_without_a_new_best(scores, over):
    assert Validation(lambda network: 0.0, every=1, patience=2).is_over(scores) is over


def test_batches_are_shuffled_passes():
    order = batches(5, 2, 10, seed=0)
    assert order.shape == (10, 2)
    for part in order.reshape(4, 5):
        assert sorted(part) == [0, 1, 2, 3, 4]
    assert batches(1, 4, 3, seed=0).tolist() == [[0], [0], [0]]


def test_one_cycle_rises_then_falls():
    rates = [one_cycle(i / 100) for i in range(101)]
    assert rates[0] == pytest.approx(1 / 25)
    assert max(rates) == rates[30] == pytest.approx(1)
    assert rates[100] == pytest.approx(1e-4)


def test_scenes_without_objects_train(samples):
    empty = type(samples[0])(samples[0].points, Boxes.empty())
    loss = OBJECTS.loss(tiny(), [empty, samples[1]])
    loss.backward()
    assert torch.isfinite(loss)


def test_a_client_returns_its_update_and_keeps_nothing(samples):
    client = TaskClient(OBJECTS, tiny().config, samples)
    weights = to_arrays(tiny())
    first = client.train(weights, steps=2, learning_rate=1e-3, seed=5)
    again = client.train(weights, steps=2, learning_rate=1e-3, seed=5)
    assert list(first.weights) == list(weights)
    assert all(np.array_equal(first.weights[name], again.weights[name]) for name in weights)
    assert any(not np.array_equal(first.weights[name], weights[name]) for name in weights)
    assert first.samples == 4
    assert first.loss == again.loss > 0


@pytest.mark.slow
def test_it_learns_the_toy():
    rays = spin(beams=32, azimuths=900, field_of_view_deg=90)
    network = tiny(seed=0)
    losses = train(OBJECTS, network, [toy_sample(seed, rays) for seed in range(60)], steps=200, seed=0).losses
    test = [toy_sample(10**6 + seed, rays) for seed in range(24)]
    truths = [FrameTruth(f"s{i // 3}", sample.boxes, sample.ignore, Boxes.empty()) for i, sample in enumerate(test)]
    found = detect_all(network, [sample.points for sample in test], score_threshold=0.05)
    assert losses[-20:].mean() < 0.5 * losses[:20].mean()
    (at_half, *_) = score_detections(found, truths, ("Car",))
    assert at_half.ap is not None
    assert at_half.ap > 0.6
