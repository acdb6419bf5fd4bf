"""Groups on request: who is called, who leads, what an offer costs, and when a group dissolves."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from safetensors.numpy import load

from flcav.config import InputError
from flcav.federation.links.link import open_questions
from flcav.federation.links.metered import open_account
from flcav.federation.trainable import LocalUpdate
from flcav.network.ledger import BudgetExceeded, Ledger, LinkMegabytes, pack_arrays
from flcav.perception.weather.samples import Sample
from flcav.perception.weather.task import WEATHER
from flcav.runs.arm_checks import check_federations
from flcav.runs.arms import resolve_settings
from flcav.runs.extras.groups.choosing import (
    FULL,
    NOT_NEEDED,
    GroupWatch,
    choose_members,
    find_in_range,
    find_lead,
    has_levelled,
    weigh_offers,
)
from flcav.runs.extras.groups.members import (
    MESSAGE,
    SKETCH,
    Offer,
    count_sample_labels,
    find_gradient,
    hold_back,
    sketch_gradient,
)
from flcav.runs.extras.groups.rows import CheckedNetwork, Group, LeadTerm
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.recipe import RunRecipe

PLACES = {name: np.array([x, 0.0, 0.0]) for name, x in {"a": 0.0, "b": 250.0, "c": 320.0, "d": 900.0}.items()}


@pytest.mark.parametrize(("count", "held"), [(8, [2, 6]), (4, [2]), (2, [1]), (1, []), (12, [2, 6, 10])])
def test_frames_are_held_back_evenly_and_none_is_in_both(count: int, held: list[int]) -> None:
    train, found = hold_back(count, 0.25)
    assert found == held
    assert sorted([*train, *found]) == [*range(count)]


def test_who_is_in_range_of_one_that_asked() -> None:
    assert find_in_range(PLACES, ["a"], 300.0) == ["a", "b"]
    assert find_in_range(PLACES, ["a", "b"], 300.0) == ["a", "b", "c"]
    assert find_in_range(PLACES, ["gone"], 300.0) == []


def test_the_nearest_edge_server_in_range_leads_and_without_one_the_lowest_identifier() -> None:
    servers = {"pole1": np.array([280.0, 0.0, 0.0]), "pole2": np.array([-100.0, 0.0, 0.0])}
    assert find_lead(PLACES, ["a"], servers, 300.0) == "pole2"
    assert find_lead(PLACES, ["c"], servers, 300.0) == "pole1"
    assert find_lead(PLACES, ["c"], {}, 300.0) == "b"  # in range of c, before c
    assert find_lead(PLACES, ["d"], servers, 300.0) == "d"
    del PLACES["b"]  # it leaves: the next one leads
    assert find_lead(PLACES, ["c"], {}, 300.0) == "c"
    PLACES["b"] = np.array([250.0, 0.0, 0.0])


def test_data_that_add_more_are_weighed_higher() -> None:
    """By hand: c's gradient is orthogonal to what a and b have in common, and its labels are those of all together."""
    one, other = np.zeros(SKETCH), np.zeros(SKETCH)
    one[0] = other[1] = 1.0
    offers = {
        "a": Offer(4, {"rain": 4}, one),
        "b": Offer(4, {"rain": 4}, one),
        "c": Offer(4, {"rain": 2, "snow": 2}, other),
    }
    weights = weigh_offers(offers)
    # all: rain 10/12, snow 2/12. Distances 1/6, 1/6, 1/3. Cosines to the others' sums: a, b 1/sqrt 2; c 0
    novelty = [(1 - 2**-0.5) / 2, (1 - 2**-0.5) / 2, 0.5]
    worth = [(1 - each) * (1 + new) for each, new in zip((1 / 6, 1 / 6, 1 / 3), novelty, strict=True)]
    assert [*weights.values()] == pytest.approx([each / max(worth) for each in worth])
    assert weigh_offers({name: Offer(1, {}, one) for name in "ab"}) == {"a": 1.0, "b": 1.0}


def test_members_are_those_that_asked_and_the_best_of_the_others() -> None:
    quality = {"a": 0.4, "b": 0.9, "c": 1.0, "d": 0.3}
    chosen = choose_members(Requests(), ["a"], quality, {"e": "not in the town"})
    assert chosen.members == ("a", "c", "b")
    assert chosen.stayed == {"e": "not in the town", "d": NOT_NEEDED}
    few = choose_members(Requests(most=2), ["a"], quality, {})
    assert (few.members, few.stayed) == (("a", "c"), {"d": NOT_NEEDED, "b": FULL})
    assert choose_members(Requests(most=1), ["a", "d"], quality, {}).members == ("a",)  # no more than that
    assert choose_members(Requests(most=2), ["a", "d"], quality, {}).members == ("a", "d")  # those that asked first


def test_an_offer_is_a_message_of_some_hundred_bytes() -> None:
    message = Offer(5, {"rain": 3, "snow": 2}, np.arange(SKETCH) / 7).message()
    found = load(message)
    assert len(message) < 1000
    assert (found["samples"].item(), found["counts"].tolist()) == (5, [3, 2])
    assert found["sketch"].dtype == np.float32
    again = Offer.read(message)
    assert (again.samples, again.labels) == (5, {"rain": 3, "snow": 2})
    np.testing.assert_array_equal(again.sketch, found["sketch"])


def test_a_group_dissolves_when_rounds_gain_too_little() -> None:
    how = Requests(patience=2, least_gain=0.1)
    assert not has_levelled([1.0, 0.99], how)
    assert has_levelled([1.0, 0.95, 0.94], how)
    assert not has_levelled([1.0, 0.95, 0.89], how)
    assert not has_levelled([1.0, 0.95, 0.80, 0.79], how)
    assert has_levelled([1.0, 0.95, 0.80, 0.79, 0.78], how)
    assert has_levelled([1.0, 1.5, 2.0], how)  # or gets worse
    assert not GroupWatch(how, {}, [1.0, 1.0, 1.0]).over  # of nobody who holds something back


def test_losses_that_members_tell_are_in_the_ledger_and_held_to_the_budget() -> None:
    member: Any = SimpleNamespace(task=WEATHER, answer=lambda question, arrays: {MESSAGE: as_message(loss=0.25)})
    watch, book = GroupWatch(Requests(), {"grid/a": member}, [0.5]), Ledger(LinkMegabytes(1e-4, 0.0))
    with open_questions({"grid/a": member}, None, open_account()) as ask:
        watch.follow(book, 3, {}, ask)
        assert [(each.client, each.round, each.direction) for each in book] == [("grid/a", 3, "up")]
        assert watch.losses == [0.5, 0.25]
        with pytest.raises(BudgetExceeded):
            watch.follow(book, 4, {}, ask)


def as_message(**numbers: float) -> np.ndarray:
    return np.frombuffer(pack_arrays({name: np.array([each], np.float32) for name, each in numbers.items()}), np.uint8)


def test_a_loss_that_is_lost_or_cannot_be_read_counts_for_nothing() -> None:
    watch = GroupWatch(Requests(), {}, [0.5])
    watch.note({"grid/a": as_message(loss=0.25).tobytes(), "grid/b": b"", "grid/c": as_message(other=9.0).tobytes()})
    watch.note({"grid/b": b""})
    assert watch.losses == [0.5, 0.25, 0.25]


def test_labels_are_counted_by_class_and_sketches_keep_angles() -> None:
    picture = np.zeros((32, 32, 3), np.uint8)
    assert count_sample_labels([Sample(picture, each) for each in (3, 3, 5)]) == {"3": 2, "5": 1}
    boxes = SimpleNamespace(boxes=SimpleNamespace(label=np.array(["car", "car"])))
    assert count_sample_labels([boxes]) == {"car": 2}
    assert count_sample_labels([SimpleNamespace(past=1)]) == {}
    gradients = np.random.default_rng(1).normal(size=(3, 500))
    gradients[1] = 0.8 * gradients[0] + 0.6 * gradients[1]

    def sketch(row: int) -> np.ndarray:
        class Client:
            def train(self, weights: Any, **how: Any) -> LocalUpdate:
                return LocalUpdate(weights, 1, 0.0, {"w": gradients[row]})

        return sketch_gradient(find_gradient(Client(), {}, 7), 7)  # type: ignore[arg-type]

    cosine = lambda one, other: one @ other / np.linalg.norm(one) / np.linalg.norm(other)  # noqa: E731
    found = [sketch(row) for row in range(3)]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert cosine(found[i], found[j]) == pytest.approx(cosine(gradients[i], gradients[j]), abs=0.3)


def test_the_record_says_who_asked_why_who_came_and_what_it_mended() -> None:
    vehicles = {
        "grid/a": CheckedNetwork(3, 1.4, 0.6, asks=True),
        "grid/b": CheckedNetwork(3, 0.2, 0.3),
        "grid/c": CheckedNetwork(3, 0.1),
    }
    group = Group(
        *(0.9, vehicles, "pole3", ("grid/a", "grid/b"), {"grid/a": 1.0}, {"grid/c": "no link to spare"}),
        *(1234, 6, (0.8, 0.5, 0.45), "the loss has levelled off"),
    )
    assert group.describe() == (
        "grid/a asked, with a loss above 0.900 on frames held back; pole3 led 2 vehicles for 2 of 6 rounds; 1234 bytes "
        "of requests and offers; mended: 1 of 1; grid/a 1.400 to 0.600; grid/c stayed (no link to spare); the loss has "
        "levelled off"
    )
    assert Group.from_json(group.as_json(), "here") == group
    lasting = replace(
        group, vehicles={**vehicles, "grid/a": CheckedNetwork(3, 1.4, 1.0, asks=True)}, scores=(0.5, 0.25)
    )
    assert lasting.mended == ()
    assert "mended: 0 of 1" in lasting.describe()
    assert "on validation frames 0.500 to 0.250, which nobody acts on" in lasting.describe()
    terms = (LeadTerm("grid/a", 1, 2, 1), LeadTerm("grid/b", 2, 3), LeadTerm("grid/c", 3))
    adhoc = replace(group, lead="grid/a", terms=terms, roadside=("grid/pole3",))
    assert "grid/a led 2 vehicles and 1 roadside unit (pole3) for 2" in adhoc.describe()
    assert "grid/a left in round 2 with 1 update, and the round began again; grid/b was gone before round 3" in (
        adhoc.describe()
    )
    assert Group.from_json(adhoc.as_json(), "here") == adhoc
    early = {**vehicles, "grid/b": replace(vehicles["grid/b"], asks=True, told=2.5)}
    said = replace(group, vehicles=early).describe()
    assert "grid/a asked, with a loss above 0.900 on frames held back; grid/b had asked its fleet, with a" in said
    assert "its fleet, with a loss of 2.500; pole3 led" in said
    assert Group.from_json(replace(group, vehicles=early).as_json(), "here").vehicles == early
    calm = Group(0.9, {"grid/b": vehicles["grid/b"]}, "")
    assert calm.describe() == "nobody asked: the largest loss on held-back frames is 0.200, and 0.900 the limit"


def recipe(**federation: Any) -> RunRecipe:
    return RunRecipe.model_validate(
        {
            "tasks": {"weather": {"plan": {"samples": 4, "edge_rounds": 2, "cloud_rounds": 1}}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 3}},
            "budgets_mb": {"wireless": 9, "wireline": 9},
            "federation": {"requests": {}, **federation},
        }
    )


@pytest.mark.parametrize(
    ("federation", "told"),
    [
        ({"strategy": {"krum": {}}}, "Krum needs a known roster"),
        ({"strategy": {"fedbuff": {}}, "network": {}}, "FedBuff needs a known roster"),
        ({"selection": {"rule": "uniform", "clients": 2}}, "leave out 'selection'"),
        ({"secure": {}}, "leave out 'selection'"),
        ({"privacy": {"noise": 1.0}}, "no noise covers them"),
    ],
)
def test_what_does_not_go_with_requests_is_refused(federation: dict[str, Any], told: str) -> None:
    asked = recipe(**federation)
    with pytest.raises(InputError, match=told):
        check_federations(asked, resolve_settings(asked).values())


def test_settings_of_requests(tmp_path: Path) -> None:
    asked = recipe()
    check_federations(asked, resolve_settings(asked).values())
    with pytest.raises(ValidationError):
        recipe(requests={"held_back": 1.0})
