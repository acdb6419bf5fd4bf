from itertools import product

import pytest
from flcav.experiments.protocol import REGIONS, SPLITS, Protocol, Split
from pydantic import ValidationError

from flcav.config import parse_config
from flcav.sources.recipe import Recipe

TOWNS = ("suburb", *REGIONS)


def test_every_split_of_every_town_and_seed_has_traffic_of_its_own():
    asked = [one for one in product(range(5), TOWNS, SPLITS) if one[1:] != ("suburb", "edge")]  # nobody federates there
    assert len({Protocol(seed=seed).recipe(town, split)["seed"] for seed, town, split in asked}) == len(asked)


@pytest.mark.parametrize(("town", "split"), [("suburb", "pool"), ("grid", "test"), ("ring", "edge")])
def test_a_recipe_is_one_that_the_recorder_takes(town: str, split: str):
    setting = Protocol(seed=3)
    recipe = parse_config(Recipe, setting.recipe(town, split, poles=(2,)), "test")
    asked: Split = getattr(setting, split)
    assert (recipe.town, recipe.split, recipe.poles) == (town, split, (2,))
    assert (recipe.scenes, recipe.spins_per_scene, recipe.every_s) == (asked.scenes, asked.spins, asked.every_s)
    assert recipe.cavs == (setting.ring_vehicles if split == "edge" else asked.cavs)


def test_frames_lie_at_least_two_seconds_apart():
    assert all(getattr(Protocol(), split).every_s >= 2 for split in SPLITS)
    with pytest.raises(ValidationError, match="greater than or equal to 2"):
        Split(scenes=1, spins=2, cavs=1, every_s=1.0)


def test_intervals_need_test_frames_of_several_scenes():
    with pytest.raises(ValidationError, match="two scenes or more are wanted: intervals are over scenes"):
        Protocol(test=Split(scenes=1, spins=2, cavs=1))
