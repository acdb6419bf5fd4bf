"""The script of each kind of scenario: who can play it now, and how it goes, one step per `yield`."""

from collections.abc import Callable, Generator
from typing import Any

from flcav.world.scenarios import breakdowns, manoeuvres, overtaking, pedestrians
from flcav.world.scenarios.scenario import Kind, Scenario
from flcav.world.scenarios.stage import Stage

Cast = Callable[[Stage, Scenario], Any]  # the roles, or None while nobody fits
Act = Callable[[Stage, Scenario, Any], Generator[None, None, None]]

SCRIPTS: dict[Kind, tuple[Cast, Act]] = {
    "cut_in": (manoeuvres.cast_cut_in, manoeuvres.cut_in),
    "overtaking": (overtaking.cast_overtaking, overtaking.overtake),
    "pedestrian_behind_van": (pedestrians.cast_behind_van, pedestrians.run_out),
    "red_light_runner": (manoeuvres.cast_runner, manoeuvres.run_the_light),
    "stalled_vehicle": (breakdowns.cast_stalled, breakdowns.stall),
    "crash": (breakdowns.cast_crash, breakdowns.crash),
}
