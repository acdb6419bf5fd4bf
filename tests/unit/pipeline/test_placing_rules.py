"""Sensors of a region by each rule of a run's recipe."""

import numpy as np
import pytest

from flcav.config import InputError, parse_config
from flcav.perception.errors import PerceptionError
from flcav.pipeline.recipe import Placement
from flcav.pipeline.stages.placement import Sites, place_sensors

SITES = Sites(np.array([2, 5, 7, 9]), np.array([[0, 0, 6], [100, 0, 6], [200, 0, 6], [300, 0, 6]], dtype=np.float64))


def place(seed: int = 1, **how: object) -> tuple[int, ...]:
    settings = parse_config(Placement, {"range_m": 40.0, **how}, "placement")
    return place_sensors("grid", settings, SITES, {}, {}, [], seed).chosen


def test_named_poles_have_the_sensors() -> None:
    assert place(rule="fixed", poles=[9, 2]) == (9, 2)
    with pytest.raises(
        InputError, match=r"placement.poles: 3 is none of the candidate poles of region 'grid': 2, 5, 7, 9"
    ):
        place(rule="fixed", poles=[3])


def test_random_poles_are_drawn_by_the_seed_and_fewer_are_the_first_of_more() -> None:
    three = place(rule="random", count=3)
    assert len(set(three)) == 3
    assert place(rule="random", count=2) == three[:2]
    assert len({place(seed, rule="random") for seed in range(20)}) == 4


@pytest.mark.parametrize("how", [{"rule": "fixed"}, {"poles": [1]}, {"rule": "fixed", "poles": [1, 1]}])
def test_poles_are_named_once_and_by_their_rule_alone(how: dict[str, object]) -> None:
    with pytest.raises(InputError, match="'poles'"):
        parse_config(Placement, how, "placement")


def test_errors_count_only_where_the_rule_is_theirs() -> None:
    error = PerceptionError(195.0, 0.0, 0.0, 1.0, "miss", "Car", 3, 0.0, "a", "car1")
    how = Placement(rule="fixed", poles=(2,), tasks=("objects",))
    placed = place_sensors("grid", how, SITES, {"objects": [error]}, {"objects": 1.0}, [])
    assert (placed.chosen, placed.covered, placed.errors) == ((2,), 0, 1)
    assert [pole.covered for pole in placed.poles] == [0, 0, 1, 0]
