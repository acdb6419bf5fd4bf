import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import wasserstein_distance

from flcav.optimization.quality import (
    data_quality,
    gradient_novelty,
    label_distribution_distance,
    visible_objects,
)


@pytest.mark.parametrize("seed", range(5))
def test_distance_of_two_classes_is_the_earth_movers(seed: int) -> None:
    counts = np.random.default_rng(seed).integers(1, 50, (6, 2))
    whole = counts.sum(axis=0)
    expected = [wasserstein_distance([0, 1], [0, 1], own, whole) for own in counts]
    assert label_distribution_distance(counts) == pytest.approx(expected)


def test_distance_of_many_classes_is_half_the_l1_distance() -> None:
    rng = np.random.default_rng(1)
    counts, reference = rng.integers(1, 50, (4, 7)), rng.uniform(1, 2, 7)
    own = counts / counts.sum(axis=1, keepdims=True)
    expected = cdist(own, (reference / reference.sum())[None], "cityblock")[:, 0] / 2
    assert label_distribution_distance(counts, reference) == pytest.approx(expected)


def test_iid_is_0_disjoint_and_unlabelled_are_1() -> None:
    assert label_distribution_distance([[2, 4], [3, 6], [50, 100]]) == pytest.approx(0)
    assert label_distribution_distance([[0, 3], [0, 0]], [1, 0]) == pytest.approx(1)
    with pytest.raises(ValueError, match="at least 0"):
        label_distribution_distance([[-1, 2]])


def test_objects_per_sample() -> None:
    assert visible_objects([30, 0, 0], [10, 5, 0]) == pytest.approx([3, 0, 0])


def test_novelty_of_equal_orthogonal_and_opposite_gradients() -> None:
    assert gradient_novelty(np.tile([1.0, 2, 3], (5, 1))) == pytest.approx(0)
    assert gradient_novelty(np.eye(4)) == pytest.approx(0.5)
    assert gradient_novelty([[1, 0], [1, 0], [-1, 0]])[2] == pytest.approx(1)
    assert gradient_novelty([[1.0, 2]]) == pytest.approx(0)


def test_equal_vehicles_are_worth_the_same_and_poorer_ones_less() -> None:
    assert data_quality([0.3, 0.3], [4, 4], [0.1, 0.1]) == pytest.approx(1)
    assert data_quality([1.0, 1.0], [0, 0]) == pytest.approx(1)
    worth = data_quality([0.0, 0.5, 0.0, 1.0], [8, 8, 4, 8], [0, 0, 0, 0])
    assert worth[:3] == pytest.approx([1, 0.5, 0.5])
    assert 0 < worth[3] < 0.05  # never nothing: a problem asks for positive quality
    assert data_quality([0.1, 0.1], novelty=[0.5, 0.0]) == pytest.approx([1, 2 / 3])
