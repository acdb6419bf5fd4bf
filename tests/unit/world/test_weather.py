from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import Config, InputError, parse_config
from flcav.world.weather import (
    ANY,
    DRIZZLE_MM_H,
    SEPARATION,
    WEATHER_CLASSES,
    WEATHERS,
    Weather,
    WeatherSchedule,
    classify_weather,
    draw_weather,
    find_nearest_class,
    interpolate,
)

CLASSES = ["clear", "cloudy", "overcast", "light_rain", "heavy_rain", "fog", "sunset", "night"]

# least gap between the regions of any two classes, in at least one of these parameters
MARGINS = {"sun_elevation_deg": 10.0, "cloud_cover": 0.2, "rain_mm_h": 1.0, "visibility_m": 5000.0}


class Wanted(Config):
    weather: WeatherSchedule


def schedule(value: Any) -> WeatherSchedule:
    return parse_config(Wanted, {"weather": value}, "recipe.yaml").weather


def test_eight_classes_with_a_preset_each():
    assert list(WEATHER_CLASSES) == CLASSES
    for name in CLASSES:
        assert classify_weather(WEATHERS[name]) == name
    assert classify_weather(WEATHERS["rainy_night"]) is None


@given(pair=st.sampled_from(list(combinations(CLASSES, 2))), seed=st.integers(0, 2**32))
@settings(max_examples=300, deadline=None)
def test_weathers_of_two_classes_are_a_margin_apart(pair: tuple[str, str], seed: int):
    rng = np.random.default_rng(seed)
    one, other = (draw_weather(name, rng) for name in pair)
    assert (classify_weather(one), classify_weather(other)) == pair
    gaps = {name: abs(getattr(one, name) - getattr(other, name)) / margin for name, margin in MARGINS.items()}
    assert max(gaps.values()) >= 1 - 1e-9, gaps


def test_regions_themselves_are_a_margin_apart():
    for one, other in combinations(WEATHER_CLASSES.values(), 2):
        apart = [max(one[p][0] - other[p][1], other[p][0] - one[p][1]) >= MARGINS[p] - 1e-9 for p in MARGINS]
        assert any(apart), (one, other)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_the_whole_space_holds_what_occurs(seed: int):
    weather = draw_weather(ANY, np.random.default_rng(seed))
    assert draw_weather(ANY, np.random.default_rng(seed)) == weather
    if weather.rain_mm_h:
        assert weather.cloud_cover >= 0.6
        assert weather.wetness >= 0.3


def test_the_whole_space_reaches_every_class_and_beyond():
    rng = np.random.default_rng(0)
    found = {classify_weather(draw_weather(ANY, rng)) for _ in range(4000)}
    assert found == {*CLASSES, None}


@given(name=st.sampled_from(CLASSES), seed=st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_within_a_region_the_nearest_class_is_its_own(name: str, seed: int):
    assert find_nearest_class(draw_weather(name, np.random.default_rng(seed))) == name


@pytest.mark.parametrize(
    ("weather", "name"),
    [
        (Weather(cloud_cover=0.29), "clear"),
        (Weather(cloud_cover=0.31), "cloudy"),
        (Weather(wetness=0.9), "clear"),  # the rain is over
        (Weather(sun_elevation_deg=-25.0, cloud_cover=1.0, rain_mm_h=2.0, wetness=0.9), "night"),
        (Weather(cloud_cover=0.95, rain_mm_h=9.9, wetness=0.9), "light_rain"),
        (Weather(cloud_cover=0.95, rain_mm_h=10.2, wetness=0.9), "heavy_rain"),
        (Weather(cloud_cover=0.9, visibility_m=1000.0), "fog"),
        (Weather(cloud_cover=0.9, visibility_m=3000.0), "overcast"),
    ],
)
def test_between_the_regions_the_nearest_class_is_that_of_the_smaller_gap(weather: Weather, name: str):
    assert classify_weather(weather) is None
    assert find_nearest_class(weather) == name


def test_regions_are_a_unit_of_the_distance_apart():
    def scaled(parameter: str, value: float) -> float:
        logarithms = {"rain_mm_h": np.log10(max(value, 0) + DRIZZLE_MM_H), "visibility_m": np.log10(max(value, 1))}
        return logarithms.get(parameter, value) / SEPARATION[parameter]

    for one, other in combinations(WEATHER_CLASSES.values(), 2):
        shared = [p for p in SEPARATION if p in one and p in other]
        low, high = ([[scaled(p, region[p][end]) for p in shared] for region in (one, other)] for end in (0, 1))
        assert np.maximum(np.subtract(low[0], high[1]), np.subtract(low[1], high[0])).max() >= 1


def test_night_and_fog_follow_from_the_parameters():
    assert WEATHERS["night"].night
    assert not WEATHERS["sunset"].night
    assert Weather().fog_per_m == 0
    assert Weather(visibility_m=100.0).fog_per_m == pytest.approx(0.02996, abs=1e-5)


@pytest.mark.parametrize(
    ("one", "other", "share", "expected"),
    [(350.0, 20.0, 0.5, 5.0), (20.0, 350.0, 0.25, 12.5), (10.0, 100.0, 0.5, 55.0), (300.0, 40.0, 0.9, 30.0)],
)
def test_the_sun_goes_the_short_way_round(one: float, other: float, share: float, expected: float):
    mixed = interpolate(Weather(sun_azimuth_deg=one), Weather(sun_azimuth_deg=other), share)
    assert mixed.sun_azimuth_deg == pytest.approx(expected)


def test_parameters_change_linearly_and_fog_by_its_extinction():
    mixed = interpolate(Weather(rain_mm_h=0.0, visibility_m=1000.0), Weather(rain_mm_h=10.0, visibility_m=100.0), 0.25)
    assert mixed.rain_mm_h == pytest.approx(2.5)
    assert mixed.fog_per_m == pytest.approx(0.75 * np.log(20) / 1000 + 0.25 * np.log(20) / 100)


@given(share=st.floats(0, 1), names=st.tuples(st.sampled_from(list(WEATHERS)), st.sampled_from(list(WEATHERS))))
def test_between_two_weathers_nothing_leaves_their_limits(share: float, names: tuple[str, str]):
    one, other = WEATHERS[names[0]], WEATHERS[names[1]]
    mixed = interpolate(one, other, share)
    for parameter in set(Weather.model_fields) - {"sun_azimuth_deg"}:
        low, high = sorted((getattr(one, parameter), getattr(other, parameter)))
        assert low - 1e-6 * abs(low) <= getattr(mixed, parameter) <= high + 1e-6 * abs(high)


def test_a_schedule_in_its_forms():
    assert schedule("fog").at(7.0) == WEATHERS["fog"]
    assert schedule({"rain_mm_h": 4.0}).at(0.0) == Weather(rain_mm_h=4.0)
    changed = schedule({"preset": "rainy_night", "rain_mm_h": 8}).at(0.0)
    assert changed == WEATHERS["rainy_night"].model_copy(update={"rain_mm_h": 8.0})
    frames = [{"at_s": 2.0, "weather": "clear"}, {"at_s": 4.0, "weather": {"rain_mm_h": 8.0}}]
    changing = schedule(frames)
    assert [changing.at(t).rain_mm_h for t in (0.0, 2.0, 2.5, 3.0, 4.0, 99.0)] == pytest.approx([0, 0, 2, 4, 8, 8])
    drawn = schedule({"classes": ["sunset", "night"]})
    seen = {classify_weather(drawn.draw(np.random.default_rng(seed)).at(1.0)) for seed in range(20)}
    assert seen == {"sunset", "night"}
    assert schedule({"classes": ["any"]}).draw(np.random.default_rng(1)).at(0.0) != Weather()
    with pytest.raises(ValueError, match="no weather was drawn"):
        drawn.at(0.0)


def test_classes_take_turns_in_an_order_of_the_scene():
    turns = schedule({"classes": [*CLASSES, "any"], "turn_s": 4.0})
    scenes = [turns.draw(np.random.default_rng(seed)) for seed in range(3)]
    orders = [[classify_weather(scene.at(4.0 * i)) for i in range(9)] for scene in scenes]
    assert all({*CLASSES} <= {*order} for order in orders)
    assert orders[0] != orders[1]
    assert scenes[0].at(2.0) == interpolate(scenes[0].at(0.0), scenes[0].at(4.0), 0.5)


@pytest.mark.parametrize(
    "value",
    [
        "clear",
        {"wetness": 0.5},
        [{"at_s": 1.0, "weather": "fog"}],
        {"classes": ["fog"]},
        {"classes": ["any"], "turn_s": 2},
    ],
)
def test_a_schedule_survives_its_own_dump(value: Any):
    once = schedule(value)
    assert schedule(once.model_dump(mode="json")) == once


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("drizzle", "'weather' = 'drizzle': unknown weather; known weathers: clear, cloudy"),
        ({"preset": "drizzle"}, "'weather' = .*: unknown weather; known weathers: clear, cloudy"),
        ({"preset": "night", "rain_mm_h": -1}, r"rain_mm_h' = -1"),
        (
            ["night", "heavy_rain"],
            r"a list is of keyframes, such as {at_s: 0, weather: night}; .* {classes: \[night",
        ),
        (5, "'weather' = 5: must be the name of a weather, its fields, or a list of keyframes"),
        ({"sun_azimuth_deg": float("inf")}, "sun_azimuth_deg' = inf: Input should be a finite number"),
        ({"rain_mm_h": -1}, r"rain_mm_h' = -1"),
        ({"colour": 1}, "unknown field"),
        ({"classes": ["snow"]}, "no weather class 'snow'"),
        ({"classes": []}, "give a weather"),
        ({"classes": ["fog"], "turn_s": 0}, r"turn_s' = 0"),
        ({"keyframes": [{"at_s": 0, "weather": "fog"}], "turn_s": 4}, "give classes with it"),
        ([], "give a weather"),
        ([{"at_s": 3, "weather": "fog"}, {"at_s": 3, "weather": "clear"}], "must ascend"),
        ([{"at_s": -3, "weather": "fog"}], r"at_s' = -3"),
    ],
)
def test_bad_schedules_get_one_sentence(value: Any, message: str):
    with pytest.raises(InputError, match=message) as caught:
        schedule(value)
    assert "\n" not in str(caught.value)
