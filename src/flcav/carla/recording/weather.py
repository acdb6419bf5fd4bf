"""Our weather as CARLA's: the inverse of what our own server of its protocol makes of it."""

from typing import TYPE_CHECKING

import numpy as np

from flcav.carla.server.weather import HALF_FOG, MOST_RAIN_MM_H
from flcav.world.weather import NO_FOG_M, Weather

if TYPE_CHECKING:
    import carla


def make_weather(weather: Weather) -> "carla.WeatherParameters":
    """Return CARLA's parameters, percentages and degrees; rain above MOST_RAIN_MM_H is 100 %, as the densest fog is."""
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
