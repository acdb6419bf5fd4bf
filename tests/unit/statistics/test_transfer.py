"""Final mean and transfer by hand, by the sums of the paper, and of scores of the wrong shape."""

import numpy as np
import pytest

from flcav.statistics.transfer import compute_backward_transfer, compute_final_mean, compute_forward_transfer

SCORES = [
    [0.2, 0.1, 0.3],  # before the first task
    [0.8, 0.3, 0.3],
    [0.7, 0.9, 0.2],
    [0.4, 0.8, 0.7],  # after the last
]


def test_by_hand() -> None:
    assert compute_final_mean(SCORES) == pytest.approx((0.4 + 0.8 + 0.7) / 3)
    assert compute_backward_transfer(SCORES) == pytest.approx(((0.4 - 0.8) + (0.8 - 0.9)) / 2)  # two are forgotten
    assert compute_forward_transfer(SCORES) == pytest.approx(((0.3 - 0.1) + (0.2 - 0.3)) / 2)


@pytest.mark.parametrize("tasks", [2, 3, 6])
def test_they_are_the_sums_of_the_paper(tasks: int) -> None:
    """Equations 2 to 4, with R from 1 and b of the network that learning begins with."""
    scores = np.random.default_rng(tasks).random((tasks + 1, tasks))
    r = lambda i, j: scores[i, j - 1]  # noqa: E731 - after task i, on task j
    acc = sum(r(tasks, i) for i in range(1, tasks + 1)) / tasks
    bwt = sum(r(tasks, i) - r(i, i) for i in range(1, tasks)) / (tasks - 1)
    fwt = sum(r(i - 1, i) - r(0, i) for i in range(2, tasks + 1)) / (tasks - 1)
    found = (compute_final_mean(scores), compute_backward_transfer(scores), compute_forward_transfer(scores))
    assert found == pytest.approx((acc, bwt, fwt))


def test_who_does_nothing_transfers_nothing() -> None:
    scores = [SCORES[0]] * 4
    assert (compute_backward_transfer(scores), compute_forward_transfer(scores)) == (0, 0)


@pytest.mark.parametrize("shape", [(3, 3), (2, 1), (4,), (5, 3)])
def test_scores_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    for compute in (compute_final_mean, compute_backward_transfer, compute_forward_transfer):
        with pytest.raises(ValueError, match=r"expected \(T \+ 1, T\)"):
            compute(np.zeros(shape))
