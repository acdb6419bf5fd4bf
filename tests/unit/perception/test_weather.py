"""LeNet-5 against the numbers of its paper, and how the classifier is measured."""

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter

from flcav.perception.task import build_network, find_configuration
from flcav.perception.training import train
from flcav.perception.weather.evaluate import evaluate_classes, predict_probabilities
from flcav.perception.weather.model import SEEN_MAPS, LeNet, LeNetConfig, PartlyConnected, Subsampling
from flcav.perception.weather.samples import Sample, augment_picture, reduce_picture
from flcav.perception.weather.task import WEATHER
from flcav.world.weather import WEATHER_CLASSES


def parameters(*modules: torch.nn.Module) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_the_original_has_the_papers_parameters():
    layers = LeNet(LeNetConfig(original=True)).layers
    c1, s2, c3, s4, c5, f6 = (layers[i] for i in (0, 1, 3, 4, 6, 9))
    assert [parameters(layer) for layer in (s2, c3, s4, c5, f6)] == [12, 1516, 32, 48120, 10164]
    assert parameters(c1) - 2 * 6 * 25 == 156  # of one channel instead of three
    assert parameters(s2, c3, s4, c5, f6) + 156 == 60_000  # "60,000 trainable free parameters"
    assert parameters(LeNet(LeNetConfig())) == pytest.approx(62e3, rel=0.005)


def test_maps_are_connected_as_in_table_one():
    rows = [  # of the paper's table I: X where a map of C3 (column) sees a map of S2 (row)
        "X   XXX  XXXX XX",
        "XX   XXX  XXXX X",
        "XXX   XXX  X XXX",
        " XXX  XXXX  X XX",
        "  XXX  XXXX XX X",
        "   XXX  XXXX XXX",
    ]
    table = np.array([[sign == "X" for sign in row] for row in rows])
    assert [tuple(np.flatnonzero(column)) for column in table.T] == list(SEEN_MAPS)


def test_a_partly_connected_layer_sees_its_maps_alone():
    layer = PartlyConnected()
    start = torch.rand(1, 6, 14, 14)
    for blind in range(6):
        changed = start.clone()
        changed[:, blind] += 1
        moved = (layer(changed) - layer(start)).abs().amax((0, 2, 3)) > 1e-6
        assert moved.tolist() == [blind in maps for maps in SEEN_MAPS]


def test_subsampling_is_a_trained_mean():
    layer = Subsampling(2)
    with torch.no_grad():
        layer.factor[1], layer.bias[1] = 3.0, -1.0
    maps = torch.arange(8.0).reshape(1, 2, 2, 2)
    assert layer(maps).flatten().tolist() == [1.5, 3 * 5.5 - 1]


def test_batch_normalisation_changes_nothing_before_it_has_learned_but_the_statistics():
    plain, normalised = LeNet(LeNetConfig()), LeNet(LeNetConfig(normalised=True))
    assert parameters(normalised) == parameters(plain) + 2 * (6 + 16)
    for mine, theirs in zip(
        (layer for layer in normalised.layers if not isinstance(layer, torch.nn.BatchNorm2d)), plain.layers, strict=True
    ):
        mine.load_state_dict(theirs.state_dict())
    pictures = torch.rand(2, 3, 32, 32)
    with torch.inference_mode():  # mean 0 and variance 1
        assert torch.allclose(normalised.eval()(pictures), plain.eval()(pictures), atol=1e-4)
        maps = normalised.train().layers[:2](pictures)
    assert maps.mean((0, 2, 3)).tolist() == pytest.approx([0] * 6, abs=1e-5)
    assert maps.std((0, 2, 3)).tolist() == pytest.approx([1] * 6, abs=1e-2)


def test_the_published_network_is_not_normalised_and_others_are_described_as_before():
    with pytest.raises(ValueError, match="has no batch normalisation"):
        LeNetConfig(original=True, normalised=True)
    adapter = TypeAdapter(LeNetConfig)
    assert b"normalised" not in adapter.dump_json(LeNetConfig())
    assert adapter.validate_json(adapter.dump_json(LeNetConfig(normalised=True))).normalised


@pytest.mark.parametrize("name", ["tiny", "paper"])
def test_it_learns_colours(name):
    random = np.random.default_rng(0)
    colours = random.integers(0, 256, (8, 3))
    noisy = [colours[i % 8] + random.normal(0, 12, (32, 32, 3)) for i in range(48)]
    samples = [Sample(np.clip(picture, 0, 255).astype(np.uint8), i % 8) for i, picture in enumerate(noisy)]
    network = build_network(WEATHER, find_configuration(WEATHER, name), 0)
    train(WEATHER, network, samples, steps=120, batch=16, seed=0)
    found = predict_probabilities(network, [sample.picture for sample in samples])
    assert found.shape == (48, 8)
    assert found.sum(1) == pytest.approx(1, abs=1e-5)
    assert (found.argmax(1) == np.arange(48) % 8).mean() > 0.95


def test_augmentation_keeps_size_label_and_light():
    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    seen = [augment_picture(Sample(picture, 3, "s"), np.random.default_rng(seed)) for seed in range(40)]
    assert all(one.picture.shape == (32, 32, 3) and (one.label, one.scene) == (3, "s") for one in seen)
    assert all(abs(one.picture.mean() / picture.mean() - 1) < 0.2 for one in seen)
    assert len({one.picture.tobytes() for one in seen}) == 40


def test_a_picture_is_squeezed_to_its_means():
    picture = np.zeros((64, 128, 3), np.uint8)
    picture[:, 64:] = 200
    seen = reduce_picture(picture)
    assert seen.shape == (32, 32, 3)
    assert (seen[:, :14] == 0).all()
    assert (seen[:, 18:] == 200).all()


def test_accuracy_recall_and_confusion_by_hand():
    truth, found = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 0, 1, 1, 1, 0])
    result = evaluate_classes(truth, found, list("aabbcc"), ["x", "y", "z", "w"])
    assert result.accuracy == pytest.approx(4 / 6)
    assert result.confusion == ((2, 1, 0, 0), (0, 2, 0, 0), (1, 0, 0, 0), (0, 0, 0, 0))
    assert result.recall == {"x": pytest.approx(2 / 3), "y": 1, "z": 0, "w": None}
    assert result.low is not None
    assert result.high is not None
    assert result.low <= result.accuracy <= result.high
    assert (result.pictures, result.scenes) == (6, 3)
    alone = evaluate_classes(truth, found, ["a"] * 6, ["x", "y", "z", "w"])
    assert (alone.low, alone.high) == (None, None)
    assert "accuracy 0.667 (no interval: one scene)" in alone.lines()[0]


def test_the_classes_are_those_of_the_world():
    assert LeNetConfig().classes == tuple(WEATHER_CLASSES)
    assert len(WEATHER_CLASSES) == 8
    for classes, odd in ((("clear", "rainy_night"), "rainy_night"), (("clear", "fog", "clear"), "clear")):
        with pytest.raises(ValueError, match=f"'{odd}' is none of the classes, or there twice; they are clear, cloudy"):
            LeNetConfig(classes=classes)
