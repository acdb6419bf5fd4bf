"""Shares of the vehicles in the uploads of stage I."""

from itertools import product

import pytest

from flcav.optimization.allocation.uploads import UploadDemand, share_by_held, share_by_links
from flcav.optimization.solvers.instance import Infeasible


def test_shares_by_frames_are_those_of_largest_remainders() -> None:
    held = {"a": 5, "b": 3, "c": 2}
    assert share_by_held(UploadDemand(7, 0.5, held)) == {"a": 4, "b": 2, "c": 1}  # 3.5, 2.1, 1.4
    assert share_by_held(UploadDemand(5, 0.5, held)) == {
        "a": 3,
        "b": 1,
        "c": 1,
    }  # 2.5, 1.5, 1.0: the first of equal ones
    assert share_by_held(UploadDemand(10, 0.5, held)) == held


def test_shares_by_links_end_the_upload_earliest() -> None:
    mbps, held = {"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 20, "b": 20, "c": 20}
    assert share_by_links({"t": UploadDemand(12, 0.5, held)}, mbps) == {"t": {"a": 2, "b": 4, "c": 6}}
    assert share_by_links({"t": UploadDemand(12, 0.5, {**held, "c": 3})}, mbps) == {"t": {"a": 3, "b": 6, "c": 3}}
    assert share_by_links({"t": UploadDemand(4, 0.5, held)}, {**mbps, "c": 0.0})["t"]["c"] == 0  # never in coverage
    with pytest.raises(Infeasible, match="hold 6 samples"):
        share_by_links({"t": UploadDemand(7, 0.5, {"a": 3, "b": 3})}, mbps)


def test_a_vehicle_s_link_carries_the_samples_of_all_tasks() -> None:
    mbps = {"a": 1.0, "b": 2.5}
    found = share_by_links(
        {"t": UploadDemand(5, 0.5, {"a": 9, "b": 9}), "u": UploadDemand(4, 1.25, {"a": 9, "b": 2})}, mbps
    )

    def end(t: int, u: int) -> float:
        """Return when the last sample arrives if `a` uploads so many of each task."""
        return 8 * max((0.5 * t + 1.25 * u) / 1.0, (0.5 * (5 - t) + 1.25 * (4 - u)) / 2.5)

    least = min(end(t, u) for t, u in product(range(6), range(2, 5)))
    assert end(found["t"]["a"], found["u"]["a"]) == pytest.approx(least, rel=1e-4)
    assert {task: sum(own.values()) for task, own in found.items()} == {"t": 5, "u": 4}
