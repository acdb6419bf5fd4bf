"""The configuration of a scripted corner case in a recipe."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from flcav.config import Config
from flcav.interface.wording import suggest
from flcav.world.shapes import SHAPES

Kind = Literal[
    "cut_in",  # a car pushes in less than a few metres ahead, from the next lane or from the kerb
    "overtaking",  # an oncoming car overtakes and meets one in one's own lane
    "pedestrian_behind_van",  # somebody runs out from behind a parked van
    "red_light_runner",  # somebody crosses the stop line on red
    "stalled_vehicle",  # the vehicle ahead breaks down and stays
    "crash",  # a vehicle runs into the one before it, and both stay
]
ROLES: dict[str, tuple[str, ...]] = {  # role of an actor created for a scenario -> categories it may be of
    "car": ("car", "van", "motorcycle"),
    "van": ("van", "truck", "bus"),
    "pedestrian": ("pedestrian",),
}
LONGEST_S = 36_000.0
NEAR_M = 50.0  # largest distance of the ego from `Scenario.position`

Ego = Annotated[str, Field(pattern=r"^cav[0-9]{1,4}$")]
Duration = Annotated[float, Field(ge=0.1, le=LONGEST_S)]


class Scenario(Config):
    """One corner case of a recipe: it begins as soon after `at_s` as the traffic around `near` allows."""

    kind: Kind  # kind of corner case
    at_s: Annotated[float, Field(gt=0, le=LONGEST_S)]  # earliest start, since the start of the traffic run
    near: Ego | None = None  # vehicle that it happens to; default: the first possible
    position: tuple[float, float] | None = (
        None  # x, y of the world [m]; it starts only while the vehicle is within 50 m
    )
    lasts_s: Duration | None = None  # standstill of a `stalled_vehicle`; default: for ever
    actors: dict[str, str] = Field(default={})  # shapes by role, e.g. van: van.high_van

    @model_validator(mode="after")
    def _known_actors(self) -> "Scenario":
        for role, name in self.actors.items():
            if role not in ROLES:
                raise ValueError(f"unknown role {role!r}; known roles: {', '.join(ROLES)}{suggest(role, ROLES)}")
            kinds = [f"{category}.{shape.name}" for category in ROLES[role] for shape in SHAPES[category]]
            if name not in kinds:
                raise ValueError(f"{role}: unknown {name!r}; allowed: {', '.join(kinds)}{suggest(name, kinds)}")
        return self
