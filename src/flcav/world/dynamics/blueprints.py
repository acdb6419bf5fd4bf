"""Blueprints: the mechanical parameters of vehicles and people, by category and size."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flcav.config import InputError
from flcav.world.map.parameters import PROPS
from flcav.world.map.relief import AXLE_SHARE
from flcav.world.shapes import SHAPES

STEER_LIMIT_RAD = float(np.radians(70.0))  # of the inner front wheel


class _Make(NamedTuple):
    """What vehicles of a category have in common."""

    density: float  # mass over the volume of the box [kg/m^3]
    pull: float  # greatest acceleration by the engine [m/s^2]
    power: float  # of the engine, over the mass [W/kg]
    drag: float  # coefficient of drag, of the frontal area
    brake: float  # greatest deceleration by the brakes [m/s^2]


_MAKES: dict[str, _Make] = {
    "car": _Make(115.0, 4.0, 70.0, 0.30, 8.0),
    "van": _Make(100.0, 3.2, 45.0, 0.35, 7.5),
    "truck": _Make(140.0, 1.6, 15.0, 0.60, 6.0),
    "bus": _Make(120.0, 1.4, 15.0, 0.60, 6.0),
    "motorcycle": _Make(95.0, 5.0, 130.0, 0.60, 8.0),
    "bicycle": _Make(47.0, 1.0, 3.0, 0.90, 4.0),
    "pedestrian": _Make(110.0, 0.0, 0.0, 1.00, 0.0),
    "prop": _Make(200.0, 0.0, 0.0, 1.00, 0.0),
}
VEHICLES = ("car", "van", "truck", "bus", "motorcycle", "bicycle")


@dataclass(frozen=True)
class Blueprint:
    """Category, shape and mechanical parameters of a vehicle, a walker or a prop."""

    category: str  # one of `trace.CATEGORIES`, or "prop"
    shape: int  # row of `SHAPES[category]`, or of `PROPS`
    size: tuple[float, float, float]  # length, width, height [m]
    mass_kg: float
    engine_n: float  # greatest force of the engine [N]
    power_w: float  # greatest power of the engine [W]
    drag_area_m2: float  # coefficient of drag times frontal area
    brake_mps2: float  # greatest deceleration by the brakes
    wheelbase_m: float  # between the axles, which are symmetric about the box's middle
    steer_limit_rad: float = STEER_LIMIT_RAD  # greatest angle of the front wheels

    @property
    def inertia_kgm2(self) -> float:
        """The moment of inertia about the vertical axis, of a homogeneous box."""
        length, width, _ = self.size
        return self.mass_kg * (length**2 + width**2) / 12


def blueprint(category: str, shape: int = 0, size: tuple[float, float, float] | None = None) -> Blueprint:
    """Return the blueprint of a shape, with its own or another `size` (length, width, height [m]).

    Raises `InputError` for an unknown category or shape, and for a size that is not positive.
    """
    shapes = PROPS if category == "prop" else SHAPES.get(category)
    if shapes is None:
        raise InputError(f"category '{category}': must be one of {', '.join((*SHAPES, 'prop'))}")
    if not 0 <= shape < len(shapes):
        raise InputError(f"shape {shape}: category '{category}' has the shapes 0 to {len(shapes) - 1}")
    length, width, height = size or shapes[shape][1:]
    if not all(0.05 <= side <= 100.0 for side in (length, width, height)):
        raise InputError(f"size {length}, {width}, {height}: must be between 0.05 and 100 m")
    make = _MAKES[category]
    mass = make.density * length * width * height
    return Blueprint(
        category=category,
        shape=shape,
        size=(float(length), float(width), float(height)),
        mass_kg=mass,
        engine_n=mass * make.pull,
        power_w=mass * make.power,
        drag_area_m2=make.drag * width * height,
        brake_mps2=make.brake,
        wheelbase_m=2 * AXLE_SHARE * length,
    )
