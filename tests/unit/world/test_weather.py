from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flcav.config import Config, InputError, parse_config
from flcav.world.weather import (
    MARGINS,
    WEATHER_CLASSES,
    WEATHERS,
    Weather,
    WeatherSchedule,
    draw_weather,
    interpolate,
    weather_class,
)

CLASSES = ["clear", "cloudy", "overcast", "light_rain", "heavy_rain", "fog", "sunset", "night"]


class Wanted(Config):
    weather: WeatherSchedule


def schedule(value: Any) -> WeatherSchedule:
    return parse_config(Wanted, {"weather": value}, "recipe.yaml").weather


def test_eight_classes_with_a_preset_each():
    assert list(WEATHER_CLASSES) == CLASSES
    for name in CLASSES:
        assert weather_class(WEATHERS[name]) == name
    assert weather_class(WEATHERS["rainy_night"]) is None


@given(pair=st.sampled_from(list(combinations(CLASSES, 2))), seed=st.integers(0, 2**32))
@settings(max_examples=300, deadline=None)
def test_weathers_of_two_classes_are_a_margin_apart(pair: tuple[str, str], seed: int):
    rng = np.random.default_rng(seed)
    one, other = (draw_weather(name, rng) for name in pair)
    assert (weather_class(one), weather_class(other)) == pair
    gaps = {name: abs(getattr(one, name) - getattr(other, name)) / margin for name, margin in MARGINS.items()}
    assert max(gaps.values()) >= 1 - 1e-9, gaps


def test_regions_themselves_are_a_margin_apart():
    for one, other in combinations(WEATHER_CLASSES.values(), 2):
        apart = [max(one[p][0] - other[p][1], other[p][0] - one[p][1]) >= MARGINS[p] - 1e-9 for p in MARGINS]
        assert any(apart), (one, other)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_the_whole_space_holds_what_occurs(seed: int):
    weather = draw_weather(None, np.random.default_rng(seed))
    assert draw_weather(None, np.random.default_rng(seed)) == weather
    if weather.rain_mm_h:
        assert weather.cloud_cover >= 0.6
        assert weather.wetness >= 0.3


def test_the_whole_space_reaches_every_class_and_beyond():
    rng = np.random.default_rng(0)
    found = {weather_class(draw_weather(None, rng)) for _ in range(4000)}
    assert found == {*CLASSES, None}


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


def test_a_schedule_in_its_four_forms():
    assert schedule("fog").at(7.0) == WEATHERS["fog"]
    assert schedule({"rain_mm_h": 4.0}).at(0.0) == Weather(rain_mm_h=4.0)
    frames = [{"at_s": 2.0, "weather": "clear"}, {"at_s": 4.0, "weather": {"rain_mm_h": 8.0}}]
    changing = schedule(frames)
    assert [changing.at(t).rain_mm_h for t in (0.0, 2.0, 2.5, 3.0, 4.0, 99.0)] == pytest.approx([0, 0, 2, 4, 8, 8])
    drawn = schedule({"classes": ["sunset", "night"]})
    seen = {weather_class(drawn.draw(np.random.default_rng(seed)).at(1.0)) for seed in range(20)}
    assert seen == {"sunset", "night"}
    with pytest.raises(ValueError, match="no weather was drawn"):
        drawn.at(0.0)


@pytest.mark.parametrize("value", ["clear", {"wetness": 0.5}, [{"at_s": 1.0, "weather": "fog"}], {"classes": ["fog"]}])
def test_a_schedule_survives_its_own_dump(value: Any):
    once = schedule(value)
    assert schedule(once.model_dump(mode="json")) == once


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("drizzle", "unknown weather; known weathers: clear, cloudy"),
        ({"rain_mm_h": -1}, r"rain_mm_h' = -1"),
        ({"colour": 1}, "unknown field"),
        ({"classes": ["snow"]}, "no weather class 'snow'"),
        ({"classes": []}, "give a weather"),
        ([], "give a weather"),
        ([{"at_s": 3, "weather": "fog"}, {"at_s": 3, "weather": "clear"}], "must ascend"),
        ([{"at_s": -3, "weather": "fog"}], r"at_s' = -3"),
    ],
)
def test_bad_schedules_get_one_sentence(value: Any, message: str):
    with pytest.raises(InputError, match=message) as caught:
        schedule(value)
    assert "\n" not in str(caught.value)
