"""The networks: sizes, weights files, inference."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from flcav.config import InputError
from flcav.perception.objects import detect, detect_all, second, second_paper, second_tiny
from flcav.perception.objects.model import head_shape
from flcav.perception.objects.predict import predict
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import from_arrays, load_network, save_network, to_arrays

from .toy import spin, toy_sample


@pytest.fixture(scope="module")
def tiny():
    torch.manual_seed(0)
    network = second_tiny()
    with torch.no_grad():  # lively scores from random weights
        network.head.weight.normal_(0, 0.05)
        network.head.bias.zero_()
    return network.eval()


@pytest.fixture(scope="module")
def cloud():
    return toy_sample(0, spin(beams=16, azimuths=300)).points


def parameters(network):
    return sum(parameter.numel() for parameter in network.parameters())


def test_published_sizes():
    assert parameters(second_paper()) == pytest.approx(5.3e6, rel=0.01)
    assert parameters(second_tiny()) == pytest.approx(0.33e6, rel=0.01)
    assert head_shape(second_paper().config) == (200, 176)
    assert head_shape(second_tiny().config) == (60, 60)


def test_one_output_per_anchor(tiny, cloud):
    output = predict(tiny, [cloud, cloud[::2]])
    assert [tensor.shape for tensor in output[:3]] == [(2, 7200, 1), (2, 7200, 7), (2, 7200, 2)]
    assert output.log_variance is None


def test_a_cloud_in_a_batch_is_seen_as_alone(tiny, cloud):
    together = detect_all(tiny, [cloud, cloud[::2], cloud[::3]], score_threshold=0.5)
    alone = detect(tiny, cloud[::2], score_threshold=0.5)
    assert len(alone) > 0
    assert np.allclose(together[1].array(), alone.array(), atol=1e-4)
    assert alone.score is not None
    assert (alone.score >= 0.5).all()


def test_the_order_of_points_does_not_matter(tiny, cloud):
    shuffled = cloud[np.random.default_rng(0).permutation(len(cloud))]
    one, other = detect(tiny, cloud, score_threshold=0.5), detect(tiny, shuffled, score_threshold=0.5)
    assert np.allclose(one.array(), other.array(), atol=1e-3)


def test_nothing_in_range_is_no_error(tiny):
    behind = np.array([[-20, 0, 0, 0.5]], dtype=np.float32)
    assert detect_all(tiny, [behind, np.zeros((0, 4), np.float32)], score_threshold=0.999) is not None


def test_weights_return_as_they_were_saved(tiny, cloud, tmp_path):
    path = tmp_path / "weights.safetensors"
    save_network(OBJECTS, tiny, path)
    back = load_network(OBJECTS, path)
    assert back.config == tiny.config
    assert np.array_equal(detect(back, cloud).array(), detect(tiny, cloud).array())


def test_files_that_are_no_weights_are_refused(tmp_path):
    foreign, broken = tmp_path / "foreign.safetensors", tmp_path / "broken.safetensors"
    save_file({"w": torch.zeros(3)}, foreign)
    broken.write_bytes(b"not weights at all")
    for path, sentence in ((foreign, "another network"), (broken, "damaged"), (tmp_path / "none", "no such file")):
        with pytest.raises(InputError, match=sentence):
            load_network(OBJECTS, path)


def test_arrays_carry_the_whole_state(tiny):
    fresh = second(tiny.config)
    from_arrays(fresh, to_arrays(tiny))
    assert all(torch.equal(a, b) for a, b in zip(fresh.state_dict().values(), tiny.state_dict().values(), strict=True))
    arrays = to_arrays(tiny)
    arrays.pop("head.bias")
    with pytest.raises(InputError, match=r"head\.bias"):
        from_arrays(fresh, arrays)
    with pytest.raises(InputError, match="shape"):
        from_arrays(fresh, to_arrays(tiny) | {"head.bias": np.zeros(3, np.float32)})


def test_unknown_classes_are_refused():
    with pytest.raises(InputError, match="Tram"):
        second_tiny(classes=("Tram",))
