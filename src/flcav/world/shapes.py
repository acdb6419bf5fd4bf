"""Shapes of actors by category: outer dimensions for the traffic simulation and for the meshes."""

from typing import NamedTuple


class Shape(NamedTuple):
    """The shape of an actor: its name and outer dimensions."""

    name: str
    length: float  # [m]
    width: float  # [m]
    height: float  # [m]


SHAPES: dict[str, tuple[Shape, ...]] = {
    "car": (
        Shape("city", 3.60, 1.66, 1.50),
        Shape("hatchback", 4.05, 1.76, 1.48),
        Shape("compact", 4.30, 1.80, 1.46),
        Shape("sedan", 4.70, 1.84, 1.45),
        Shape("wagon", 4.75, 1.84, 1.50),
        Shape("coupe", 4.40, 1.82, 1.35),
        Shape("suv", 4.65, 1.90, 1.70),
        Shape("minivan", 4.80, 1.88, 1.78),
        Shape("pickup", 5.25, 1.92, 1.80),
        Shape("taxi", 4.65, 1.84, 1.66),
        Shape("trailer_car", 7.40, 1.90, 1.50),  # a hatchback with a trailer
        Shape("overturned", 4.40, 1.50, 1.80),  # on its side
    ),
    "van": (
        Shape("panel_van", 5.40, 2.00, 2.30),
        Shape("high_van", 5.90, 2.05, 2.65),
        Shape("caddy", 4.50, 1.83, 1.85),
        Shape("ladder_van", 5.60, 2.00, 2.60),  # ladders on its roof
        Shape("box_van", 6.20, 2.15, 3.00),
    ),
    "truck": (Shape("box_truck", 7.80, 2.50, 3.30), Shape("tipper", 8.80, 2.50, 3.10)),
    "bus": (Shape("city_bus", 12.0, 2.55, 3.10), Shape("midi_bus", 8.90, 2.40, 3.00)),
    "motorcycle": (Shape("roadster", 2.10, 0.78, 1.60), Shape("scooter", 1.85, 0.72, 1.62)),
    "bicycle": (
        Shape("city_bike", 1.75, 0.62, 1.75),
        Shape("sport_bike", 1.70, 0.58, 1.62),
        Shape("cargo_bike", 2.55, 0.66, 1.75),
    ),
    "pedestrian": (
        Shape("tall", 0.60, 0.62, 1.82),
        Shape("medium", 0.58, 0.58, 1.70),
        Shape("child", 0.45, 0.45, 1.30),
    ),
}
ANGLED = "angled"  # parked at an angle
RARE: dict[str, str] = {  # kinds of objects that a town has only on request, with their category
    "trailer_car": "car",
    "overturned": "car",
    "ladder_van": "van",
    "box_van": "van",
    "cargo_bike": "bicycle",
    ANGLED: "car",
}
PARKED_ONLY = ("overturned", ANGLED)  # rare kinds that are only parked
