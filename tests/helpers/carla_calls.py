"""Calls of CARLA's clients without a network."""

from typing import Any

from flcav.carla.server import calls as carla_calls
from flcav.carla.server.blueprints import list_blueprints
from flcav.carla.server.calls import Calls


def invoke(calls: Calls, name: str, arguments: tuple[Any, ...]) -> Any:
    """Return what a call answers, of the type that the test expects."""
    return carla_calls.invoke(calls, name, arguments)


def describe(name, *attributes):
    """Return the description of a blueprint, as clients send it, with these attributes."""
    known = list_blueprints()[name].definition
    return [known.uid, name, [[key, 4, value] for key, value in attributes]]


def place(calls, number=0, ahead=0.0):
    """Return the transform of a spawn point, moved along x."""
    location, rotation = calls.episode.spawn_points[number]
    return [[location[0] + ahead, *location[1:]], list(rotation)]
