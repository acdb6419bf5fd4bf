"""Partitions of a region's samples among its vehicles: whole, of the kind asked for, and the same again."""

import pickle
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from flcav.config import InputError, parse_config
from flcav.report.charts.partition import draw_dealt
from flcav.runs.arm_checks import check_federations
from flcav.runs.extras.partition.dealing import (
    deal_by_amount,
    deal_by_class,
    deal_by_dirichlet,
    deal_by_place,
    give_each_one,
)
from flcav.runs.extras.partition.rows import Partitioned, VehicleHolding
from flcav.runs.extras.partition.samples import count_labels, deal_samples, locate_samples, name_classes
from flcav.runs.extras.partition.settings import Partition
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.graph import Graph
from flcav.statistics.streams import stream

LABELS = np.repeat(["clear", "cloudy", "fog", "rain"], 60)


def _rng(seed: int = 1) -> np.random.Generator:
    return stream(seed, "partition")


def _classes_held(owner: np.ndarray, vehicles: int) -> list[int]:
    return [len(set(LABELS[owner == vehicle])) for vehicle in range(vehicles)]


def test_by_class_each_vehicle_has_few_classes_and_as_many_samples() -> None:
    owner = deal_by_class(LABELS, 8, 1, _rng())
    assert np.bincount(owner).tolist() == [30] * 8
    assert _classes_held(owner, 8) == [1] * 8
    assert max(_classes_held(deal_by_class(LABELS, 8, 2, _rng()), 8)) == 2
    assert set(_classes_held(deal_by_class(LABELS, 8, 30, _rng()), 8)) == {4}


def test_by_place_areas_do_not_overlap_and_have_equal_numbers() -> None:
    positions = _rng().uniform((0, 0), (300, 100), (90, 2))
    owner = deal_by_place(positions, 3)
    assert np.bincount(owner).tolist() == [30, 30, 30]
    columns = [positions[owner == vehicle, 0] for vehicle in range(3)]  # 300 m are halved along x both times
    assert columns[0].max() < columns[1].min() < columns[1].max() < columns[2].min()


def test_by_amount_shares_follow_the_concentration_and_classes_do_not() -> None:
    few, even = (deal_by_amount(4000, 8, alpha, _rng()) for alpha in (0.1, 1000.0))
    counts = [np.bincount(owner, minlength=8) for owner in (few, even)]
    assert counts[0].max() > 2000  # a few vehicles have most
    assert counts[1].min() > 430  # 500 each, of standard deviation 15
    labels = np.arange(4000) % 4
    largest = labels[few == counts[0].argmax()]
    assert np.bincount(largest) / len(largest) == pytest.approx([0.25] * 4, abs=0.05)


def test_dirichlet_shares_are_those_of_each_class() -> None:
    labels = np.repeat([0, 1], 20_000)
    drawn = _rng()
    expected = []
    for _ in range(2):  # the draws written out
        drawn.permutation(20_000)
        expected.append(drawn.dirichlet([0.5] * 5))
    owner = deal_by_dirichlet(labels, 5, 0.5, _rng())
    for label in (0, 1):
        shares = np.bincount(owner[labels == label], minlength=5) / 20_000
        assert shares == pytest.approx(expected[label], abs=1e-4)


def test_everybody_has_a_sample_where_there_are_enough() -> None:
    owner = give_each_one(np.zeros(6, np.int64), 4)
    assert np.bincount(owner, minlength=4).tolist() == [3, 1, 1, 1]
    assert np.bincount(give_each_one(np.zeros(2, np.int64), 4), minlength=4).sum() == 2


def _pictures(count: int, label: int) -> list[Any]:
    return [SimpleNamespace(label=label) for _ in range(count)]


@pytest.mark.parametrize("by", ["class", "place", "amount", "dirichlet"])
def test_each_sample_is_one_vehicles_and_the_draw_can_be_repeated(by: Any) -> None:
    samples = {"grid/cav0": _pictures(12, 0), "grid/cav1": _pictures(9, 1), "grid/cav2": _pictures(9, 0)}
    counts = count_labels(samples, ("clear", "fog"))
    positions = _rng().uniform(size=(30, 2))
    dealt, record = deal_samples(Partition(by=by), samples, counts, positions, _rng())
    again, _ = deal_samples(Partition(by=by), samples, counts, positions, _rng())
    assert sorted(id(each) for own in dealt.values() for each in own) == sorted(
        id(each) for own in samples.values() for each in own
    )
    for name, own in dealt.items():
        assert list(map(id, own)) == list(map(id, again[name]))
        held = record.vehicles[name]
        assert held.labels == {"clear": sum(s.label == 0 for s in own), "fog": sum(s.label == 1 for s in own)}
        share = held.labels["clear"] / held.samples
        assert held.distance == pytest.approx(abs(share - 21 / 30))  # of two classes, written out
    assert record.describe().startswith(f"dealt by {by}: cav0 {record.vehicles['grid/cav0'].samples} sample")


def test_a_vehicle_is_given_its_own_samples_alone_also_where_it_is_sent_to_another_process() -> None:
    samples = {f"grid/cav{i}": [np.full(50_000, i, np.uint8) for _ in range(10)] for i in range(4)}
    dealt, record = deal_samples(Partition(by="amount", alpha=1000.0), samples, [{}] * 40, None, _rng())
    for name, own in dealt.items():
        count = record.vehicles[name].samples
        assert len(own) == count
        assert len(pickle.dumps(own)) < (count + 0.5) * 50_000


def test_a_sample_of_several_labels_is_of_its_rarest_class() -> None:
    assert name_classes([{"Car": 5, "Cyclist": 1}, {"Car": 1}, {}]) == ["Cyclist", "Car", "none"]


def test_samples_without_labels_are_not_dealt_by_class() -> None:
    samples = {"grid/cav0": [SimpleNamespace()] * 3}
    with pytest.raises(InputError, match="no sample has a label to deal by"):
        deal_samples(Partition(by="class"), samples, count_labels(samples, ()), None, _rng())
    _, record = deal_samples(Partition(by="amount"), samples, count_labels(samples, ()), None, _rng())
    assert record.vehicles["grid/cav0"].distance is None


def _recipe(task: str = "weather", **federation: Any) -> RunRecipe:
    return RunRecipe.model_validate(
        {
            "tasks": {task: {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}},
            "budgets_mb": {"wireless": 100, "wireline": 100},
            "placement": {"rule": "none"},
            "federation": federation,
        }
    )


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"by": "class", "alpha": 1.0}, "'alpha' is of a partition by amount or dirichlet"),
        ({"by": "place", "shards": 2}, "'shards' are of a partition by class"),
        ({"by": "weather"}, "'class', 'place', 'amount' or 'dirichlet'"),
        ({"by": "amount", "alpha": 0}, "0.001"),
    ],
)
def test_fields_of_another_kind_are_refused(fields: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        parse_config(Partition, fields, "federation.partition")


def test_a_task_without_classes_is_not_dealt_by_class(tmp_path: Any) -> None:
    recipe = _recipe("trajectory", partition={"by": "dirichlet"})
    with pytest.raises(InputError, match="'trajectory' has no classes to deal by; take 'place' or 'amount'"):
        check_federations(recipe, Graph(recipe, tmp_path).settings.values())


def test_groups_on_request_keep_what_they_recorded(tmp_path: Any) -> None:
    recipe = _recipe(partition={"by": "class"}, requests={})
    with pytest.raises(InputError, match="leave out 'requests' and 'lifelong'"):
        check_federations(recipe, Graph(recipe, tmp_path).settings.values())


def test_samples_are_where_their_frames_are_also_where_a_frame_has_several_or_none() -> None:
    held = {0: 2, 1: 0, 2: 1, 3: 1}  # pictures of each frame; the first two are of cav0

    class Pictures:
        def samples(self, data: Any, config: Any, frames: tuple[int]) -> list[int]:
            if not held[frames[0]]:
                raise InputError("no picture")
            return [0] * held[frames[0]]

    def frame(i: int) -> Any:
        return SimpleNamespace(world_from_agent=np.array([[1, 0, 0, 10.0 * i], [0, 1, 0, 5.0], [0, 0, 1, 0]]))

    keys = [SimpleNamespace(agent=agent) for agent in ("cav0", "cav0", "cav1", "cav1")]
    split: Any = SimpleNamespace(data=SimpleNamespace(frame=frame, keys=keys))

    def locate(samples: Any) -> list[Any]:
        return list(locate_samples(cast(Any, Pictures()), None, split, [*held], "grid", samples))

    found = locate({"grid/cav0": "ab", "grid/cav1": "cd"})
    assert [each.tolist() for each in found] == [[0, 5], [0, 5], [20, 5], [30, 5]]
    with pytest.raises(InputError, match="grid/cav1 do not tell where"):
        locate({"grid/cav0": "ab", "grid/cav1": "cde"})


def test_the_chart_has_a_bar_for_each_vehicle_and_class_as_long_as_what_it_holds() -> None:
    held = {
        "grid/cav0": VehicleHolding(5, {"clear": 5, "fog": 0}, 0.4),
        "grid/cav1": VehicleHolding(4, {"clear": 1, "fog": 3}, 0.5),
    }
    figure = draw_dealt({"main · grid · weather": Partitioned("class", held)})
    (axes,) = figure.axes
    assert [bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle)] == [5, 1, 0, 3]  # by class
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cav0", "cav1"]
    bare = {name: VehicleHolding(own.samples, {}, None) for name, own in held.items()}
    (axes,) = draw_dealt({"main · grid · trajectory": Partitioned("place", bare)}).axes
    assert [bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle)] == [5, 4]
