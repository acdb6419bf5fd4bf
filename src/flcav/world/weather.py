"""Weather parameters, presets, the classes of the weather task, and schedules of the weather over a scene.

A preset is a point of the parameter space, a class an axis-aligned box in it.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from flcav.config import Config
from flcav.interface.wording import suggest

NO_FOG_M = 20_000.0  # from this visibility on, the air is clear
NIGHT_DEG = -6.0  # sun elevation at the end of civil twilight: below it, street lamps and headlamps are on
ANY = "any"  # instead of a class: the whole parameter space
Region = Mapping[str, tuple[float, float]]  # parameter -> lowest and highest value; others are free
_DAY = {"sun_elevation_deg": (20.0, 75.0)}
_DRY = {"rain_mm_h": (0.0, 0.0), "wetness": (0.0, 0.2)}
_FAR = {"visibility_m": (10_000.0, NO_FOG_M)}
_WET_FAR = {"visibility_m": (3000.0, NO_FOG_M)}
WEATHER_CLASSES: dict[str, Region] = {
    "clear": {**_DAY, **_DRY, **_FAR, "cloud_cover": (0.0, 0.2)},
    "cloudy": {**_DAY, **_DRY, **_FAR, "cloud_cover": (0.4, 0.65)},
    "overcast": {**_DAY, **_DRY, **_FAR, "cloud_cover": (0.85, 1.0)},
    "light_rain": {**_DAY, **_WET_FAR, "cloud_cover": (0.75, 1.0), "rain_mm_h": (1.0, 5.0), "wetness": (0.3, 0.7)},
    "heavy_rain": {**_DAY, **_WET_FAR, "cloud_cover": (0.9, 1.0), "rain_mm_h": (20.0, 60.0), "wetness": (0.85, 1.0)},
    "fog": {**_DAY, **_DRY, "cloud_cover": (0.5, 1.0), "visibility_m": (50.0, 400.0)},
    "sunset": {**_DRY, **_FAR, "sun_elevation_deg": (1.0, 7.0), "cloud_cover": (0.0, 0.5)},
    "night": {**_DRY, **_FAR, "sun_elevation_deg": (-60.0, -10.0), "cloud_cover": (0.0, 1.0)},
}
# Least gap between the regions of any two classes, in at least one of these parameters, in units of
# `find_nearest_class`: degrees, share of the sky, decades of rain (+ DRIZZLE_MM_H), decades of visibility.
SEPARATION: dict[str, float] = {"sun_elevation_deg": 10.0, "cloud_cover": 0.2, "rain_mm_h": 0.59, "visibility_m": 0.85}
DRIZZLE_MM_H = 0.1  # added to the rain rate before its logarithm


class Weather(Config):
    """The weather at one instant, as continuous parameters."""

    sun_elevation_deg: float = Field(default=45.0, ge=-90, le=90)  # above the horizon; night below -6
    sun_azimuth_deg: float = 160.0  # azimuth of the sun, clockwise from north
    cloud_cover: float = Field(default=0.1, ge=0, le=1)  # fraction of the sky covered by clouds
    rain_mm_h: float = Field(default=0.0, ge=0, le=300)  # rain rate
    visibility_m: float = Field(default=NO_FOG_M, ge=5, le=1e6)  # meteorological optical range, of haze and fog
    wetness: float = Field(default=0.0, ge=0, le=1)  # wetness of the road: 0 dry, 1 under water

    @property
    def night(self) -> bool:
        """True where the sun is below civil twilight, so that lamps are on."""
        return self.sun_elevation_deg < NIGHT_DEG

    @property
    def fog_per_m(self) -> float:
        """The extinction coefficient of fog [1/m]: ln 20 / visibility (5 % contrast, ICAO); 0 in clear air."""
        return np.log(20.0) / self.visibility_m if self.visibility_m < NO_FOG_M else 0.0


WEATHERS: dict[str, Weather] = {
    "clear": Weather(),
    "cloudy": Weather(cloud_cover=0.5),
    "overcast": Weather(cloud_cover=0.97, sun_elevation_deg=40.0),
    "light_rain": Weather(cloud_cover=0.9, rain_mm_h=3.0, wetness=0.5, visibility_m=10_000.0),
    "heavy_rain": Weather(cloud_cover=1.0, rain_mm_h=35.0, wetness=0.95, visibility_m=4000.0, sun_elevation_deg=35.0),
    "fog": Weather(cloud_cover=0.9, visibility_m=120.0, wetness=0.15, sun_elevation_deg=30.0),
    "sunset": Weather(sun_elevation_deg=4.0, sun_azimuth_deg=265.0, cloud_cover=0.25),
    "night": Weather(sun_elevation_deg=-25.0, sun_azimuth_deg=330.0, cloud_cover=0.3),
    "rainy_night": Weather(sun_elevation_deg=-25.0, cloud_cover=1.0, rain_mm_h=12.0, wetness=0.9, visibility_m=6000.0),
    "foggy_night": Weather(sun_elevation_deg=-20.0, cloud_cover=0.9, visibility_m=90.0, wetness=0.2),
    "hard_sun": Weather(sun_elevation_deg=14.0, sun_azimuth_deg=90.0, cloud_cover=0.0),
    "wet_sun": Weather(cloud_cover=0.3, wetness=0.8),
}


def classify_weather(weather: Weather) -> str | None:
    """Return the class of `WEATHER_CLASSES` whose region contains `weather`; None outside all regions."""
    for name, region in WEATHER_CLASSES.items():
        if all(low <= getattr(weather, parameter) <= high for parameter, (low, high) in region.items()):
            return name
    return None


def find_nearest_class(weather: Weather) -> str:
    """Return the class whose region is nearest to `weather`; inside a region, its class.

    The distance is Euclidean over the gaps between the parameters in `SEPARATION` and the region, in units of the least
    gap between two classes; rain and visibility are on logarithmic scales. Wetness is left out, since roads stay wet
    after rain.
    """
    return min(WEATHER_CLASSES, key=lambda name: _distance(weather, WEATHER_CLASSES[name]))


def draw_weather(name: str, rng: np.random.Generator) -> Weather:
    """Draw a weather from the region of the class `name`, or from the whole space for "any".

    Rain and visibility are log-uniform, all other parameters uniform, the sun's azimuth over the full circle. Raises
    `KeyError` for an unknown class.
    """
    region = _anywhere(rng) if name == ANY else WEATHER_CLASSES[name]
    drawn = {parameter: _draw(parameter, *limits, rng) for parameter, limits in region.items()}
    return Weather(**{**drawn, "sun_azimuth_deg": float(rng.uniform(0.0, 360.0))})


def interpolate(one: Weather, other: Weather, share: float) -> Weather:
    """Interpolate between two weathers, at `share` (0 to 1) of the way from `one` to `other`.

    Parameters are interpolated linearly, the visibility by its reciprocal (linearly in the extinction coefficient of
    fog), the sun's azimuth along the shorter arc.
    """
    parts = {name: (getattr(one, name), getattr(other, name)) for name in Weather.model_fields}
    mixed = {name: (1 - share) * a + share * b for name, (a, b) in parts.items()}
    a, b = parts["visibility_m"]
    mixed["visibility_m"] = 1 / ((1 - share) / a + share / b)
    a, b = parts["sun_azimuth_deg"]
    mixed["sun_azimuth_deg"] = (a + share * ((b - a + 180.0) % 360.0 - 180.0)) % 360.0
    return Weather(**mixed)


def _expand_preset(value: Any) -> Any:
    """Expand a weather given by a preset's name, or by `preset` and fields, to its fields.

    Return others as they are.
    """
    if isinstance(value, dict) and "preset" in value:
        return _preset(value["preset"]) | {field: given for field, given in value.items() if field != "preset"}
    return _preset(value) if isinstance(value, str) else value


def _preset(name: Any) -> dict[str, Any]:
    """Return the fields of a preset. Raises `ValueError` for an unknown one."""
    if not isinstance(name, str) or name not in WEATHERS:
        raise ValueError(f"unknown weather; known weathers: {', '.join(WEATHERS)}{suggest(str(name), WEATHERS)}")
    return WEATHERS[name].model_dump()


class Keyframe(Config):
    """The weather at one time of a scene."""

    at_s: float = Field(ge=0)  # time after the scene's first spin
    weather: Annotated[Weather, BeforeValidator(_expand_preset)]  # weather at that time: a preset, or values


class WeatherSchedule(Config):
    """The weather over a scene: keyframes, or classes from which each scene draws.

    Without `turn_s` a scene draws one class; with it, a scene goes through all classes in an order drawn for it, and
    takes `turn_s` from one to the next. A class may be named several times. In a recipe a schedule may also be written
    as the name of a preset, as one weather, or as the list of keyframes alone. A weather is written as its fields, as
    the name of a preset, or as a `preset` with the fields that differ from it.
    """

    keyframes: tuple[Keyframe, ...] = ()  # weather at given times, interpolated in between
    classes: tuple[str, ...] = ()  # one is drawn per scene, and a weather from its region; "any": the whole space
    turn_s: float | None = Field(
        default=None, gt=0, exclude_if=lambda value: value is None
    )  # time of a transition; with it, a scene passes through all classes in a random order

    @model_validator(mode="before")
    @classmethod
    def _from_short_forms(cls, value: Any) -> Any:
        if isinstance(value, list | tuple):
            if names := [entry for entry in value if isinstance(entry, str)]:
                raise ValueError(
                    f"a list is of keyframes, such as {{at_s: 0, weather: {names[0]}}}; for scenes that each draw one "
                    f"of several weathers write {{classes: [{', '.join(names)}]}}"
                )
            return {"keyframes": value}
        if isinstance(value, str | Weather) or (isinstance(value, dict) and not {"keyframes", "classes"} & set(value)):
            return {"keyframes": [{"at_s": 0.0, "weather": _expand_preset(value)}]}
        if not isinstance(value, dict | WeatherSchedule):
            raise ValueError("must be the name of a weather, its fields, or a list of keyframes")
        return value

    @field_validator("classes")
    @classmethod
    def _known_classes(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if unknown := [name for name in value if name not in (*WEATHER_CLASSES, ANY)]:
            raise ValueError(f"no weather class '{unknown[0]}'; the classes are {', '.join(WEATHER_CLASSES)}, {ANY}")
        return value

    @model_validator(mode="after")
    def _one_of_both_in_order(self) -> "WeatherSchedule":
        if bool(self.keyframes) == bool(self.classes):
            raise ValueError("give a weather, a list of keyframes, or classes to draw from")
        if self.turn_s and not self.classes:
            raise ValueError("turn_s is how long classes take turns; give classes with it")
        times = [keyframe.at_s for keyframe in self.keyframes]
        if any(later <= earlier for earlier, later in pairwise(times)):
            raise ValueError(f"the keyframes' at_s must ascend, not {times}")
        return self

    def draw(self, rng: np.random.Generator) -> "WeatherSchedule":
        """Return the schedule of one scene as keyframes: those given, or weathers drawn from its classes."""
        if not self.classes:
            return self
        if self.turn_s is None:
            weather = draw_weather(self.classes[int(rng.integers(len(self.classes)))], rng)
            return WeatherSchedule(keyframes=(Keyframe(at_s=0.0, weather=weather),))
        order = rng.permutation(len(self.classes))
        turns = (
            Keyframe(at_s=i * self.turn_s, weather=draw_weather(self.classes[k], rng)) for i, k in enumerate(order)
        )
        return WeatherSchedule(keyframes=tuple(turns))

    def at(self, time_s: float) -> Weather:
        """Return the weather at `time_s` [s] after the scene's first spin, interpolated between keyframes.

        Before the first and after the last keyframe it is constant. Raises `ValueError` for a schedule of classes from
        which none was drawn.
        """
        if not self.keyframes:
            raise ValueError("no weather was drawn from the classes: see WeatherSchedule.draw")
        after = int(np.searchsorted([keyframe.at_s for keyframe in self.keyframes], time_s, side="right"))
        if after == 0 or after == len(self.keyframes):
            return self.keyframes[max(after - 1, 0)].weather
        one, other = self.keyframes[after - 1 : after + 1]
        return interpolate(one.weather, other.weather, (time_s - one.at_s) / (other.at_s - one.at_s))


def _draw(parameter: str, low: float, high: float, rng: np.random.Generator) -> float:
    """Draw a value between the limits: log-uniformly for rain and visibility, else uniformly."""
    if parameter in ("rain_mm_h", "visibility_m") and low > 0:
        return float(np.clip(np.exp(rng.uniform(np.log(low), np.log(high))), low, high))
    return float(rng.uniform(low, high))


def _distance(weather: Weather, region: Region) -> float:
    """Return the distance of a weather from a region in units of `SEPARATION`; 0 inside."""
    gaps = []
    for parameter, unit in SEPARATION.items():
        low, high = (_scaled(parameter, limit) for limit in region.get(parameter, (-np.inf, np.inf)))
        value = _scaled(parameter, getattr(weather, parameter))
        gaps.append(max(low - value, value - high, 0.0) / unit)
    return float(np.hypot.reduce(gaps))


def _scaled(parameter: str, value: float) -> float:
    """Convert a parameter to the scale of `SEPARATION`: decades for rain and visibility, others unchanged."""
    if not np.isfinite(value) or parameter not in ("rain_mm_h", "visibility_m"):
        return value
    return float(np.log10(value + DRIZZLE_MM_H if parameter == "rain_mm_h" else value))


def _anywhere(rng: np.random.Generator) -> Region:
    """Draw limits of plausible weathers: 40 % with rain (from clouds, on wet roads), 25 % with fog."""
    rains, foggy, dries = rng.random(3) < (0.4, 0.25, 0.7)
    return {
        "sun_elevation_deg": (-60.0, 75.0),
        "cloud_cover": (0.6, 1.0) if rains else (0.0, 1.0),
        "rain_mm_h": (0.3, 60.0) if rains else (0.0, 0.0),
        "visibility_m": (50.0, 3000.0) if foggy else (3000.0, NO_FOG_M),
        "wetness": (0.3, 1.0) if rains else (0.0, 0.2 if dries else 0.9),
    }
