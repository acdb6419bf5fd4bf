"""Kinds of objects that no town has unless a recipe asks for them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from flcav.config import InputError, parse_config
from flcav.runs.frames import make_recording_recipe
from flcav.runs.recipe import RunRecipe, SplitName
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream
from flcav.world.map.parameters import TownParameters
from flcav.world.map.roads import read_net
from flcav.world.map.surfaces import make_footprint
from flcav.world.map.town import Town, load_town
from flcav.world.shapes import ANGLED, RARE, SHAPES
from flcav.world.traffic.demand import park
from flcav.world.traffic.traffic import simulate

EVERY: dict[str, float] = {
    "trailer_car": 0.1,
    "ladder_van": 0.4,
    "box_van": 0.3,
    "cargo_bike": 0.5,
    "overturned": 0.2,
    "angled": 0.4,
}


def town_with(rare: dict[str, float], name: str = "grid") -> Town:
    town = load_town(name)
    return replace(town, parameters=town.parameters.model_copy(update={"rare": rare}))


def name_of(category: str, row: int) -> str:
    return SHAPES[category][row].name


@pytest.mark.parametrize("name", ["suburb", "grid", "ring", "arterial"])
def test_no_town_has_them(name: str) -> None:
    parameters = load_town(name).parameters
    for category, shapes in SHAPES.items():
        for parked in (False, True):
            weights = parameters.shape_weights(category, parked=parked)
            assert sum(weights) == pytest.approx(1)
            assert not any(weight for shape, weight in zip(shapes, weights, strict=True) if shape.name in RARE)


def test_each_has_its_share_of_its_category_and_the_others_keep_their_proportions() -> None:
    plain, changed = load_town("grid").parameters, town_with(EVERY).parameters
    for category, shapes in SHAPES.items():
        names = [shape.name for shape in shapes]
        before, after = (dict(zip(names, each.shape_weights(category), strict=True)) for each in (plain, changed))
        parked = dict(zip(names, changed.shape_weights(category, parked=True), strict=True))
        assert sum(after.values()) == pytest.approx(1)
        assert sum(parked.values()) == pytest.approx(1)
        for name in names:
            if name in RARE:
                assert parked[name] == EVERY[name]
                assert after[name] == (0 if name == "overturned" else EVERY[name])
            elif before[name]:
                assert after[name] / before[name] == pytest.approx(sum(v for k, v in after.items() if k not in RARE))


def test_parked_ones_do_not_overlap_and_stand_at_their_angles() -> None:
    town, plain = town_with(EVERY), town_with({})
    net, overturned, angled = read_net(town.net), [], []
    along = np.array([each.yaw for seed in range(8) for each in park(net, plain.parameters, stream(seed, "parked"))])
    for seed in range(8):
        parked = park(net, town.parameters, stream(seed, "parked"))
        shapes = [SHAPES[each.category][each.shape] for each in parked]
        outlines = [
            make_footprint(each.x, each.y, each.yaw, shape.length, shape.width)
            for each, shape in zip(parked, shapes, strict=True)
        ]
        pairs = shapely.STRtree(outlines).query(outlines, predicate="intersects").T
        assert all(outlines[i].intersection(outlines[k]).area < 0.3 for i, k in pairs if i < k), "corners at most"
        cars = [each for each in parked if each.category == "car"]
        overturned += [name_of("car", each.shape) == "overturned" for each in cars]
        angled += [np.abs(np.sin(each.yaw - along)).min() > 0.1 for each in cars]
    assert np.mean(overturned) == pytest.approx(EVERY["overturned"], abs=0.07)
    assert np.mean(angled) == pytest.approx(EVERY[ANGLED], abs=0.15)


def test_traffic_has_them_but_for_those_that_are_parked_only() -> None:
    rare = {kind: 0.45 for kind in EVERY if kind != ANGLED}
    trace = simulate(town_with(rare), seed=4, cavs=1, times_s=np.array([40.0]))
    moving = np.char.startswith(trace.actor, "veh")
    kinds = {name_of(str(c), s) for c, s in zip(trace.category[moving], trace.shape[moving], strict=True)}
    assert {"trailer_car", "ladder_van", "box_van", "cargo_bike"} <= kinds
    assert "overturned" not in kinds


@pytest.mark.parametrize(
    ("rare", "told"),
    [
        ({"hovercraft": 0.1}, "unknown 'hovercraft'; allowed: trailer_car"),
        ({"ladder_van": 0.6, "box_van": 0.5}, "shares of kinds of 'van' must be >= 0 and at most 1 together"),
        ({"angled": 1.5}, "shares of kinds of 'car' must be >= 0 and at most 1 together"),
        ({"cargo_bike": -0.1}, "shares of kinds of 'bicycle'"),
    ],
)
def test_shares_that_cannot_be_are_refused(rare: dict[str, float], told: str) -> None:
    with pytest.raises(InputError, match=told):
        parse_config(Recipe, {"town": "grid", "rare": rare}, "recipe")
    values = load_town("grid").parameters.model_dump() | {"rare": rare}
    with pytest.raises(InputError, match=told):
        parse_config(TownParameters, values, "town.yaml")


def test_a_region_has_them_in_the_splits_that_it_names() -> None:
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"history": "objects"}},
            "regions": {
                "suburb": {"role": "pretrain"},
                "grid": {"role": "federate", "recording": {"rare": {"box_van": 0.2}, "rare_splits": ["test"]}},
                "ring": {"role": "federate", "recording": {"rare": {"box_van": 0.2}}},
            },
            "budgets_mb": {"wireless": 9, "wireline": 9},
        }
    )
    pairs: list[tuple[str, SplitName]] = [("suburb", "test"), ("grid", "edge"), ("grid", "test"), ("ring", "edge")]
    asked = {
        (region, split): make_recording_recipe(recipe, region, split, "objects", "recording").rare
        for region, split in pairs
    }
    assert {pair for pair, rare in asked.items() if rare == {"box_van": 0.2}} == {("grid", "test"), ("ring", "edge")}
    assert [pair for pair, rare in asked.items() if not rare] == [("suburb", "test"), ("grid", "edge")]
