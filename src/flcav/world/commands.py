"""Commands to a live world: what a client does to it between two steps.

World frame: ENU, metres, radians. Where `z` is None an actor stands on the ground; where bridges are, on the level that
is nearest to `z`. An actor placed far above it falls, one far below it stays there: see `dynamics.bodies.ALOFT_M`.
Actors are known by names that the client chooses.
"""

from dataclasses import dataclass

Size = tuple[float, float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Controls:
    """The controls of a vehicle; they hold until the next ones."""

    throttle: float = 0.0  # 0 to 1
    steer: float = 0.0  # -1 to 1, share of the greatest steering angle, positive to the left
    brake: float = 0.0  # 0 to 1
    hand_brake: bool = False
    reverse: bool = False


@dataclass(frozen=True)
class Spawn:
    """A vehicle, walker or prop appears, at rest."""

    name: str
    category: str  # one of `trace.CATEGORIES`, or "prop"
    shape: int  # row of `SHAPES[category]`, or of `parameters.PROPS`
    x: float  # of the middle of its box [m]
    y: float
    yaw: float = 0.0
    z: float | None = None  # of its underside
    size: Size | None = None  # length, width, height [m]; None: those of the shape
    anywhere: bool = False  # even where something else stands


@dataclass(frozen=True)
class Remove:
    """An actor disappears; of SUMO's traffic nobody sets out in its place."""

    name: str


@dataclass(frozen=True)
class Drive:
    """A vehicle is driven by these controls."""

    name: str
    controls: Controls


@dataclass(frozen=True)
class Grip:
    """The tyres of a vehicle have this share of the friction of a dry road, until the next such command."""

    name: str
    share: float  # 0 to 1


@dataclass(frozen=True)
class Walk:
    """A walker walks at this velocity in the plane, until the next such command."""

    name: str
    velocity: tuple[float, float]  # x, y [m/s]


@dataclass(frozen=True)
class Place:
    """An actor is moved to another pose at once; it keeps its velocity."""

    name: str
    x: float
    y: float
    yaw: float
    z: float | None = None
    pitch: float = 0.0  # of an actor without physics or without gravity, as `roll`: see `geometry.pose`
    roll: float = 0.0


@dataclass(frozen=True)
class Push:
    """An actor has another velocity at once; without physics it does not move, and only reports that velocity."""

    name: str
    velocity: Vector  # [m/s]
    yaw_rate: float | None = None  # [rad/s]; None: as it is


@dataclass(frozen=True)
class Simulate:
    """The physics of an actor are on or off: without, it stays where it is placed, and nothing moves it.

    Without `gravity` it keeps the height, pitch and roll at which it was placed.
    """

    name: str
    physics: bool = True
    gravity: bool = True


@dataclass(frozen=True)
class SetLight:
    """The lights of a junction show these letters, one for each link; None: those of their program again."""

    junction: str
    state: str | None


@dataclass(frozen=True)
class FreezeLights:
    """The programs of all lights stand still, or go on."""

    frozen: bool


Command = Spawn | Remove | Drive | Grip | Walk | Place | Push | Simulate | SetLight | FreezeLights
