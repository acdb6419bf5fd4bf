from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError, parse_config, read_config
from flcav.sensors.rig import RIGS
from flcav.sources.recipe import Recipe, find_recipe, load_recipe, recipe_path
from flcav.world.map.town import load_town

RECIPES = Path(__file__).parents[3] / "recipes"


def parsed(**fields: object) -> Recipe:
    return parse_config(Recipe, {"town": "grid", **fields}, "recipe.yaml")


def test_rigs_by_name_and_written_out():
    recipe = parsed(vehicle_rig="car_surround", pole_rig={"lidars": {"lidar": {"settings": {"channels": 16}}}})
    assert recipe.vehicle_rig == RIGS["car_surround"]
    assert recipe.pole_rig.lidars["lidar"].settings.channels == 16
    assert parse_config(Recipe, recipe.model_dump(mode="json"), "resolved") == recipe


def test_times_are_exact_tenths_of_a_second():
    recipe = parsed(warmup_s=59.9, every_s=0.1, spins_per_scene=300)
    assert recipe.warmup_steps == (599, 599)
    times = recipe.times_s(599)
    assert len(times) == 300
    assert times.tolist() == [(599 + spin) / 10 for spin in range(300)]
    assert times.dtype == np.float64


def test_a_window_is_a_spin_before_and_one_after_each():
    recipe = parsed(every_s=4.0, spins_per_scene=2, window_s=0.5)
    assert recipe.times_s(600).tolist() == [59.5, 60.0, 60.5, 63.5, 64.0, 64.5]
    assert (recipe.spins, recipe.middle_spins) == (6, (1, 4))
    dense = parsed(every_s=1.0, spins_per_scene=3, window_s=0.5)  # a spin between two is of both windows
    assert dense.times_s(600).tolist() == [59.5, 60.0, 60.5, 61.0, 61.5, 62.0, 62.5]
    assert dense.middle_spins == (1, 3, 5)
    plain = parsed(every_s=1.0, spins_per_scene=3)
    assert (plain.times_s(600).tolist(), plain.middle_spins) == ([60.0, 61.0, 62.0], (0, 1, 2))


def test_a_window_of_several_spins():
    recipe = parsed(every_s=4.0, spins_per_scene=2, window_s=0.4, window_every_s=0.2)
    assert recipe.times_s(600).tolist() == [59.6, 59.8, 60.0, 60.2, 60.4, 63.6, 63.8, 64.0, 64.2, 64.4]
    assert recipe.middle_spins == (2, 7)
    assert [recipe.find_middles(spin).tolist() for spin in (0, 2, 9)] == [[2], [2], [7]]
    dense = parsed(every_s=0.5, spins_per_scene=2, window_s=0.4, window_every_s=0.2)
    assert dense.find_middles(dense.middle_spins[0]).tolist() == [2]
    shared = [spin for spin in range(dense.spins) if len(dense.find_middles(spin)) == 2]
    assert dense.times_s(600)[shared].tolist() == [60.1, 60.2, 60.3, 60.4]


def test_a_range_of_warm_ups_is_one_of_the_recipes_settings():
    recipe = parsed(warmup_s=[60, 90.5])
    assert recipe.warmup_steps == (600, 905)
    assert parse_config(Recipe, recipe.model_dump(mode="json"), "resolved") == recipe


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"speed": 3}, "unknown field 'speed'"),
        ({"town": 5}, "field 'town' = 5"),
        ({"seed": -1}, "field 'seed' = -1"),
        ({"scenes": 0}, "field 'scenes' = 0"),
        ({"frames": 0}, "field 'frames' = 0"),
        ({"every_s": 0}, "field 'every_s' = 0: .*greater than 0"),
        ({"every_s": 0.25}, "field 'every_s' = 0.25: must be a multiple of 0.1 s"),
        ({"window_s": 0.25}, "field 'window_s' = 0.25: must be a multiple of 0.1 s"),
        ({"window_s": -0.5}, "field 'window_s' = -0.5"),
        ({"window_s": 0.4, "window_every_s": 0.5}, ".*window_every_s = 0.5 leaves no spin within window_s = 0.4"),
        ({"window_every_s": 0.25}, "field 'window_every_s' = 0.25: must be a multiple of 0.1 s"),
        ({"window_range_m": 50.0}, ".*window_range_m: there are no windows around spins; give 'window_s'"),
        ({"window_s": 0.5, "warmup_s": 0.5}, ".*window_s = 0.5 puts the first spin before the traffic"),
        ({"warmup_s": float("inf")}, "field 'warmup_s' = inf: must be seconds"),
        ({"warmup_s": 0}, "field 'warmup_s' = 0: must be seconds above 0"),
        ({"warmup_s": [90.0, 60.0]}, "field 'warmup_s' = .*the lower first"),
        ({"warmup_s": [60.0, 90.05]}, "field 'warmup_s' = .*must be a multiple of 0.1 s"),
        ({"warmup_s": "a minute"}, "field 'warmup_s' = 'a minute': must be seconds"),
        ({"split": "../test"}, "field 'split'"),
        ({"poles": "some"}, "field 'poles' = 'some': must be a list of different pole numbers, or 'all'"),
        ({"poles": [1, 1]}, "field 'poles'"),
        ({"poles": [True]}, "field 'poles'"),
        ({"vehicle_rig": "plane"}, "field 'vehicle_rig' = 'plane': unknown rig; known rigs: car, car_surround"),
        ({"weather": "hail"}, "field 'weather.*unknown weather"),
        ({"calibration_error": {"position_m": -1}}, "field 'calibration_error.position_m' = -1"),
        ({"vehicle_rig": 3}, "field 'vehicle_rig' = 3"),
        ({"rigs": {"cav0": "plane"}}, "field 'rigs.cav0' = 'plane': unknown rig"),
        ({"rigs": {"cav5": "car"}}, ".*rigs names 'cav5', which is none of the vehicles cav0"),
        (
            {"navigation_s": 1.0, "vehicle_rig": "car", "rigs": {"cav0": "lidar32"}},
            ".*navigation_s: every vehicle needs a GNSS receiver and an IMU",
        ),
        (
            {"vehicle_rig": {"lidars": {"lidar": {"settings": {"range_m": -5}}}}},
            r"field 'vehicle_rig.lidars.lidar.settings.range_m' = -5",
        ),
    ],
)
def test_bad_values_get_one_sentence(fields: dict, message: str):
    with pytest.raises(InputError, match=f"^recipe.yaml: {message}") as error:
        parsed(**fields)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", sorted(RECIPES.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_recipes_we_ship_are_valid(path: Path):
    recipe = read_config(Recipe, path)
    assert load_town(recipe.town).name == recipe.town


def test_a_recipe_that_comes_with_flcav_is_found_by_its_name_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    assert read_config(Recipe, recipe_path("objects")).town == "suburb"
    assert recipe_path("allocation/objects") != recipe_path("objects")
    assert find_recipe(Path("recipes/objects.yaml")) == recipe_path("objects")
    assert find_recipe(Path("recipes/graphs/three_layers.yaml")) == recipe_path("graphs/three_layers")
    with pytest.raises(InputError, match=r"unknown recipe 'objekts'; those that come with flcav: .*signs_grid"):
        recipe_path("objekts")


def test_a_users_own_file_is_never_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recipes").mkdir()
    own = Path("recipes/objects.yaml")
    own.write_text("town: ring")
    for path in (own, Path("objects.yaml"), Path("mine/objects.yaml"), Path("recipes/none.yaml"), Path("recipes")):
        assert find_recipe(path) == path


def test_a_town_beside_a_recipe_s_file_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "there" / "mine").mkdir(parents=True)
    for name in ("mine", "grid", "elsewhere"):
        (tmp_path / "there" / f"{name}.yaml").write_text(f"town: {name}\n")
    monkeypatch.chdir(tmp_path)
    assert load_recipe("there/mine.yaml").town == str(tmp_path / "there" / "mine")
    assert load_recipe("there/grid.yaml").town == "grid"
    assert load_recipe("there/elsewhere.yaml").town == "elsewhere"  # a folder of the working directory, or none
    with pytest.raises(InputError, match=r"there/none\.yaml: no such file"):
        load_recipe("there/none.yaml")
