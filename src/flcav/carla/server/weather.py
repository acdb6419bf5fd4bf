"""Conversion of CARLA's weather percentages to rain rate, visibility and road wetness, and back."""

from typing import TYPE_CHECKING

import numpy as np

from flcav.carla.server.wire import WeatherParameters
from flcav.world.weather import NO_FOG_M, Weather

if TYPE_CHECKING:
    import carla

MOST_RAIN_MM_H = 60.0  # at a precipitation of 100
HALF_FOG = 4.5  # fog density at which the visibility is halved; at 100 it is 40 m


def to_weather(told: WeatherParameters) -> Weather:
    """Return the weather for rendering; wind and the colours of air and dust have no effect."""
    share = [min(max(value / 100, 0.0), 1.0) for value in told[:3]]
    clouds, rain, puddles = share
    haze = max(told.fog_density, told.dust_storm, 0.0) / HALF_FOG
    return Weather(
        sun_elevation_deg=min(max(told.sun_altitude_angle, -90.0), 90.0),
        sun_azimuth_deg=told.sun_azimuth_angle % 360.0,
        cloud_cover=clouds,
        rain_mm_h=MOST_RAIN_MM_H * rain**2,
        visibility_m=max(NO_FOG_M / (1 + haze**2), 5.0),
        wetness=min(max(told.wetness / 100, puddles, 0.0), 1.0),
    )


def make_weather(weather: Weather) -> "carla.WeatherParameters":
    """Return CARLA's parameters, percentages and degrees; rain above `MOST_RAIN_MM_H` and the densest fog are 100 %."""
    import carla

    wet = 100 * weather.wetness
    fog = HALF_FOG * np.sqrt(max(NO_FOG_M / weather.visibility_m - 1, 0.0))
    return carla.WeatherParameters(
        cloudiness=100 * weather.cloud_cover,
        precipitation=min(100 * float(np.sqrt(weather.rain_mm_h / MOST_RAIN_MM_H)), 100.0),
        precipitation_deposits=wet,
        wetness=wet,
        fog_density=min(float(fog), 100.0),
        fog_distance=0.0,
        sun_azimuth_angle=weather.sun_azimuth_deg % 360.0,
        sun_altitude_angle=weather.sun_elevation_deg,
    )
