"""Commands to a live world, which a client gives between two steps.

World frame: ENU, metres, radians. If `z` is None an actor stands on the ground; at bridges, on the level nearest to
`z`. An actor placed far above the ground falls, one far below it stays there: see `dynamics.bodies.ALOFT_M`. Actors
have names that the client chooses.
"""

from dataclasses import dataclass

Size = tuple[float, float, float]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Controls:
    """The controls of a vehicle; they hold until the next ones."""

    throttle: float = 0.0  # 0 to 1
    steer: float = 0.0  # -1 to 1, in greatest steering angles, positive to the left
    brake: float = 0.0  # 0 to 1
    hand_brake: bool = False
    reverse: bool = False


@dataclass(frozen=True)
class Spawn:
    """Spawn a vehicle, walker or prop at rest."""

    name: str
    category: str  # one of `trace.CATEGORIES`, or "prop"
    shape: int  # row of `SHAPES[category]`, or of `parameters.PROPS`
    x: float  # of the centre of its box [m]
    y: float  # of the centre of its box [m]
    yaw: float = 0.0  # [rad]
    z: float | None = None  # of its underside [m]
    size: Size | None = None  # length, width, height [m]; None: those of the shape
    anywhere: bool = False  # even where another object stands


@dataclass(frozen=True)
class Remove:
    """Remove an actor; one of SUMO's traffic is not replaced."""

    name: str


@dataclass(frozen=True)
class Drive:
    """Set the controls of a vehicle."""

    name: str
    controls: Controls


@dataclass(frozen=True)
class Grip:
    """Set the friction of a vehicle's tyres until the next such command."""

    name: str
    share: float  # friction over that of a dry road, 0 to 1


@dataclass(frozen=True)
class Walk:
    """Set the velocity at which a walker walks until the next such command."""

    name: str
    velocity: tuple[float, float]  # x, y, world frame [m/s]


@dataclass(frozen=True)
class Place:
    """Move an actor to another pose instantly; it keeps its velocity."""

    name: str
    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]
    z: float | None = None  # of its underside [m]
    pitch: float = 0.0  # of an actor without physics or without gravity, as in `geometry.pose` [rad]
    roll: float = 0.0  # of the same actors [rad]


@dataclass(frozen=True)
class Push:
    """Set the velocity of an actor instantly; without physics it does not move, but reports that velocity."""

    name: str
    velocity: Vector  # x, y, z, world frame [m/s]
    yaw_rate: float | None = None  # [rad/s]; None: unchanged


@dataclass(frozen=True)
class Simulate:
    """Switch the physics of an actor on or off: without physics it stays where it is placed, and nothing moves it.

    Without `gravity` it keeps the height, pitch and roll at which it was placed.
    """

    name: str
    physics: bool = True
    gravity: bool = True


@dataclass(frozen=True)
class SetLight:
    """Set the traffic lights of a junction to these letters, one per link, or return them to their program (None)."""

    junction: str
    state: str | None


@dataclass(frozen=True)
class FreezeLights:
    """Freeze or unfreeze the programs of all traffic lights."""

    frozen: bool


Command = Spawn | Remove | Drive | Grip | Walk | Place | Push | Simulate | SetLight | FreezeLights
