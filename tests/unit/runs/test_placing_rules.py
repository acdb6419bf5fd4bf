"""Sensors of a region by each rule of a run's recipe."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from flcav.config import InputError, parse_config
from flcav.dataset.store import Dataset
from flcav.geometry import pose
from flcav.perception.errors import PerceptionError
from flcav.runs.analysis.caveats import list_unreached
from flcav.runs.arms import resolve_settings
from flcav.runs.frames import Frames
from flcav.runs.poles import Sites, find_passed, place_sensors
from flcav.runs.recipe import EDGE, MAIN, PlacementSettings, RunRecipe
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import ArmResult
from flcav.runs.results.training import StageResult

SITES = Sites(np.array([2, 5, 7, 9]), np.array([[0, 0, 6], [100, 0, 6], [200, 0, 6], [300, 0, 6]], dtype=np.float64))


def place(seed: int = 1, passed: NDArray[np.bool_] | None = None, **how: object) -> tuple[int, ...]:
    settings = parse_config(PlacementSettings, {"range_m": 40.0, **how}, "placement")
    return place_sensors("grid", settings, SITES, {}, {}, [], seed, passed).chosen


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


def test_sensors_stand_where_vehicles_pass() -> None:
    passed = np.array([False, True, True, False])
    errors = [
        PerceptionError(x, 0.0, 0.0, 1.0, "miss", "Car", 3, 0.0, "a", f"car{x}") for x in (0, 1, 2, 100, 101, 200)
    ]
    settings = PlacementSettings(rule="vrcsp", range_m=40, count=1, tasks=("objects",))
    rule = (settings, SITES, {"objects": errors}, {"objects": 1.0}, [], 1)
    assert place_sensors("grid", *rule).chosen == (2,)
    placed = place_sensors("grid", *rule, passed)
    assert (placed.chosen, placed.covered) == ((5,), 2)
    assert place_sensors("grid", *rule, ~passed).chosen == (2,)
    assert place_sensors("grid", *rule, np.zeros(4, bool)).chosen == (2,)  # nobody passes anywhere: as before
    assert {place(seed, passed, rule="random") for seed in range(20)} == {(5,), (7,)}
    assert set(place(1, passed, rule="densest", count=3)) == {5, 7}
    assert place(1, passed, rule="fixed", poles=[9, 2]) == (9, 2)


def test_a_pole_is_passed_by_frames_of_vehicles_within_the_range() -> None:
    places = {0: (130.0, 0.0), 1: (100.0, 25.0), 2: (0.0, 0.0)}

    def world_from_agent(i: int) -> NDArray[np.float64]:
        return pose(*places[i], 0.0)

    data = cast(Dataset, SimpleNamespace(world_from_agent=world_from_agent))
    drive = Frames(data, (0, 1), {2: (2,)})  # frame 2 is a pole's
    assert find_passed(SITES, drive, 25.0).tolist() == [False, True, False, False]
    assert find_passed(SITES, drive, 24.9).tolist() == [False, False, False, False]
    assert find_passed(SITES, drive, 70.0).tolist() == [False, True, True, False]


def test_regions_whose_sensors_nobody_passes_are_told() -> None:
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"plan": {"samples": 4, "edge_rounds": 1, "cloud_rounds": 1}}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate"}, "ring": {"role": "federate"}},
            "budgets_mb": {"wireless": 9, "wireline": 9},
        }
    )
    settings = resolve_settings(recipe, {"objects": "road"})
    stages = [StageResult(EDGE, "objects", region, 1, 4, 1, poles) for region, poles in (("grid", ()), ("ring", (3,)))]
    placed = [Placed(region, "vrcsp", chosen, 1, 1, 40.0, ()) for region, chosen in (("grid", (5,)), ("ring", (3,)))]
    arms = {MAIN: cast(ArmResult, SimpleNamespace(stages=stages, placed=placed))}
    (told,) = list_unreached(arms, settings, 60.0)
    assert told.startswith("no vehicle of 'grid' came within 60 m (placement.group_range_m) of a sensor")
    assert list_unreached(arms, resolve_settings(recipe, {"objects": "own-detections"}), 60.0) == ()


@pytest.mark.parametrize("how", [{"rule": "fixed"}, {"poles": [1]}, {"rule": "fixed", "poles": [1, 1]}])
def test_poles_are_named_once_and_by_their_rule_alone(how: dict[str, object]) -> None:
    with pytest.raises(InputError, match="'poles'"):
        parse_config(PlacementSettings, how, "placement")


def test_errors_count_only_where_the_rule_is_theirs() -> None:
    error = PerceptionError(195.0, 0.0, 0.0, 1.0, "miss", "Car", 3, 0.0, "a", "car1")
    how = PlacementSettings(rule="fixed", poles=(2,), tasks=("objects",))
    placed = place_sensors("grid", how, SITES, {"objects": [error]}, {"objects": 1.0}, [])
    assert (placed.chosen, placed.covered, placed.errors) == ((2,), 0, 1)
    assert [pole.covered for pole in placed.poles] == [0, 0, 1, 0]
