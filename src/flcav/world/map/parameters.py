"""Parameters of a town: the schema of `town.yaml`, from which buildings, furniture and traffic are drawn."""

from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from flcav.config import Config
from flcav.interface.wording import suggest
from flcav.world.shapes import ANGLED, PARKED_ONLY, RARE, SHAPES, Shape

LARGEST_M = 1000.0
MOST = 10_000  # vehicles, or pedestrians
CLUTTER: dict[str, tuple[float, float, float]] = {  # kind -> length, width, height [m]
    "hedge": (5.0, 0.8, 1.2),
    "bins": (3.2, 0.9, 1.3),
    "planter": (3.4, 1.3, 1.0),
    "kiosk": (3.6, 1.8, 2.2),
    "shelter": (4.0, 1.5, 2.3),
    "container": (4.2, 1.8, 1.6),
    "cabinet": (1.4, 0.6, 1.3),
    "hedgerow": (4.0, 0.9, 1.5),
    "shrub": (1.6, 1.4, 1.2),
    "wall": (4.0, 0.25, 1.2),
    "fence": (4.0, 0.1, 1.3),
    "railing": (4.0, 0.06, 1.1),
    "bin": (0.6, 0.7, 1.1),
    "bollard": (0.15, 0.15, 0.95),
    "post": (0.09, 0.09, 2.6),
    "rack": (3.6, 1.8, 1.1),  # of bicycles
    "bicycle": (1.75, 0.62, 1.05),  # parked
    "motorbike": (2.1, 0.8, 1.15),  # parked
    "trailer": (3.4, 1.7, 1.5),
    "guard_rail": (4.0, 0.3, 0.75),
}
PROPS: tuple[Shape, ...] = tuple(Shape(kind, *size) for kind, size in CLUTTER.items())  # of the category "prop"
BOUNDARIES = ("hedge", "hedgerow", "wall", "fence", "railing", "guard_rail")  # of `CLUTTER`: they enclose plots
KERBSIDE = ("bin", "bollard", "cabinet", "post", "bicycle", "motorbike")  # kinds that stand between kerb and walkers
Height = Annotated[float, Field(ge=0.1, le=100)]
Spacing = Annotated[float, Field(ge=0.5, le=10_000)]
NotNegative = Annotated[float, Field(ge=0, le=10_000)]
Many = Annotated[int, Field(ge=0, le=MOST)]
Share = Annotated[float, Field(ge=0, le=1)]
Component = Annotated[float, Field(ge=-100, le=100)]


def _interval(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= value[0] <= value[1] <= LARGEST_M:
        raise ValueError(f"must be two numbers, 0 <= low <= high, up to {LARGEST_M:g}")
    return value


def _extent(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] < 1:
        raise ValueError("must be two numbers of at least 1, low <= high")
    return _interval(value)


def _mix(value: dict[str, float], allowed: list[str]) -> dict[str, float]:
    if unknown := sorted(set(value) - set(allowed)):
        raise ValueError(f"unknown {unknown[0]!r}; allowed: {', '.join(allowed)}{suggest(unknown[0], allowed)}")
    if not 1e-6 <= sum(value.values()) <= 1e6 or min(value.values(), default=0.0) < 0:
        raise ValueError("weights must be >= 0 and not all zero, and their sum at most 1e+06")
    return value


def _rare_kinds(value: dict[str, float]) -> dict[str, float]:
    """Validate the shares. Raises `ValueError` for an unknown kind, and where those of a category exceed 1."""
    if unknown := sorted(set(value) - set(RARE)):
        raise ValueError(f"unknown {unknown[0]!r}; allowed: {', '.join(RARE)}{suggest(unknown[0], list(RARE))}")
    for category in dict.fromkeys(RARE.values()):
        shares = [share for kind, share in value.items() if RARE[kind] == category and kind != ANGLED]
        if min(shares, default=0.0) < 0 or sum(shares) > 1 or not 0 <= value.get(ANGLED, 0.0) <= 1:
            raise ValueError(f"shares of kinds of '{category}' must be >= 0 and at most 1 together")
    return value


def _mix_of(allowed: Iterable[str], *, empty: bool = False) -> AfterValidator:
    """Return the validator of weights by kind, one of `allowed`; `empty`: there may be none."""
    kinds = list(allowed)
    return AfterValidator(lambda value: value if empty and not value else _mix(value, kinds))


Interval = Annotated[tuple[float, float], AfterValidator(_interval)]
Extent = Annotated[tuple[float, float], AfterValidator(_extent)]
RareKinds = Annotated[dict[str, float], AfterValidator(_rare_kinds)]
VehicleMix = Annotated[dict[str, float], _mix_of(name for name in SHAPES if name != "pedestrian")]
ClutterMix = Annotated[dict[str, float], _mix_of(CLUTTER)]
BoundaryMix = Annotated[dict[str, float], _mix_of(BOUNDARIES, empty=True)]
KerbsideMix = Annotated[dict[str, float], _mix_of(KERBSIDE, empty=True)]


class StreetParameters(Config):
    """Parameters of one street type: buildings, street furniture, parked vehicles and weight as a destination."""

    frontage_m: NotNegative = 0.0  # width of the paving behind the sidewalk
    setback_m: Interval = (2.0, 4.0)  # distance from the paving to the facades; intervals are drawn from uniformly
    building_length_m: Extent = (9.0, 14.0)  # length of a building along the street
    building_depth_m: Extent = (8.0, 11.0)  # depth of a building
    building_height_m: Extent = (5.0, 8.0)  # height of a building
    building_gap_m: Interval = (3.0, 7.0)  # gap between two buildings
    tree_spacing_m: Spacing = 18.0  # distance between street trees
    lamp_spacing_m: Spacing = 32.0  # distance between street lamps
    clutter_spacing_m: Spacing = 25.0  # distance between pieces of street furniture
    clutter: ClutterMix = Field(default={"hedge": 1.0})  # kinds of street furniture with their weights
    clutter_size: Interval = (0.85, 1.15)  # factors of the usual length, width and height of a piece
    boundary: BoundaryMix = Field(default={})  # kinds of hedges, walls and fences along the street; none if empty
    boundary_length_m: Extent = (5.0, 20.0)  # length of a stretch of one kind
    boundary_gap_m: Interval = (1.0, 5.0)  # gap between two stretches, for drives
    boundary_setback_m: Interval = (0.1, 1.0)  # distance from the sidewalk
    kerbside: KerbsideMix = Field(default={})  # kinds of small objects at the kerb with their weights; none if empty
    kerbside_spacing_m: Spacing = 20.0  # distance between two of them
    trees_at_kerb: Share = 0.0  # fraction of the street trees that stand at the kerb, not behind the sidewalk
    parked: Share = 0.0  # fraction of the parking lane's places that are taken
    parked_mix: VehicleMix = Field(default={"car": 1.0})  # categories of parked vehicles with their weights
    traffic: NotNegative = 1.0  # weight of its edges as destinations of vehicles
    footfall: NotNegative = 1.0  # weight of its edges as destinations of pedestrians


class PoleParameters(Config):
    """A candidate site of a roadside sensor, at the kerb of an edge."""

    id: Annotated[int, Field(ge=1, le=10**6)]  # number of the pole in its town
    kind: Literal["straight", "cross", "tee", "roundabout"]  # kind of street or junction it stands at
    edge: str  # edge of the net; the pole stands on its right
    before_end_m: (
        NotNegative  # distance to the edge's end; unless `kind` is straight, the site faces the junction there
    )
    height_m: Height = 6.0  # height of the mount above the ground


Ordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class SignParameters(Config):
    """A traffic sign of the map that a town was imported from."""

    kind: Literal["stop", "yield", "speed_30", "speed_60", "speed_90"]  # kind of sign
    x: Ordinate  # place of the plate
    y: Ordinate  # place of the plate
    yaw_deg: Annotated[float, Field(ge=-360, le=360)]  # direction that the plate faces, counter-clockwise from east
    height_m: Height = 2.2  # height of the plate's centre above the ground


class SignalParameters(Config):
    """A signal head of the map that a town was imported from."""

    x: Ordinate  # place of its centre
    y: Ordinate  # place of its centre
    height_m: Height  # height of its centre above the ground
    yaw_deg: Annotated[float, Field(ge=-360, le=360)]  # direction that it faces, counter-clockwise from east
    light: str  # "junction:link" of the net: the signal that it shows
    walkers: bool = False  # it is for pedestrians
    reach_m: Annotated[float, Field(ge=-50, le=50)] = 0.0  # from its mast to the left of its direction; an arm bears it
    controller: str = ""  # id of the map's controller; empty without one


class StopLineParameters(Config):
    """A stop line of the map that a town was imported from, across one lane of its net."""

    lane: str  # the lane of the net
    before_end_m: Annotated[float, Field(ge=-50, le=50)]  # from the line's middle on to the end of the lane


class ParkingParameters(Config):
    """A parking space of the map that a town was imported from."""

    x: Ordinate  # its middle
    y: Ordinate  # its middle
    yaw_deg: Annotated[float, Field(ge=-360, le=360)]  # direction of its length, counter-clockwise from east
    length_m: Annotated[float, Field(ge=1, le=30)]  # extent along that direction
    width_m: Annotated[float, Field(ge=1, le=10)]  # extent across it


class ObjectParameters(Config):
    """An object beside the roads of the map that a town was imported from."""

    kind: Literal["building", "tree", "hedge", "wall", "fence", "railing", "cabinet"]  # kind of object
    x: Ordinate  # its middle
    y: Ordinate  # its middle
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0  # direction of its length, counter-clockwise from east
    length_m: Annotated[float, Field(ge=0.01, le=LARGEST_M)]  # extent along that direction
    width_m: Annotated[float, Field(ge=0.01, le=LARGEST_M)]  # extent across it; that of a tree is its crown's
    height_m: Annotated[float, Field(ge=0.1, le=200)]  # height above the ground


class PostParameters(Config):
    """A pole of the map that a town was imported from."""

    x: Ordinate  # place of its foot
    y: Ordinate  # place of its foot
    height_m: Height  # height above the ground


class GeoReference(Config):
    """Geodetic position of a town's local origin on the WGS 84 ellipsoid, with its axes on the ground."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = 49.0  # geodetic latitude, positive north
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 8.4  # geodetic longitude, positive east
    altitude_m: Annotated[float, Field(ge=-10_000, le=10_000)] = 0.0  # height above the ellipsoid
    x_axis: tuple[Component, Component] = (1.0, 0.0)  # east and north of a metre along x [m]
    y_axis: tuple[Component, Component] = (0.0, 1.0)  # east and north of a metre along y [m]


class MapSource(Config):
    """The map a town was imported from."""

    file: str  # name of the OpenDRIVE file
    offset_m: tuple[float, float] = (0.0, 0.0)  # shift from map to town coordinates: town = map + offset


class TownParameters(Config):
    """The parameters of a town, as in its file `town.yaml`."""

    description: str  # one line about the town
    geo: GeoReference = GeoReference()  # geodetic position of the origin
    source: MapSource | None = None  # map that the town was imported from; None: not imported
    seed: Annotated[int, Field(ge=0, lt=2**63)]  # seed of buildings, trees, lamps and clutter
    vehicles: Many  # vehicles moving at once, without the CAVs
    pedestrians: Many  # pedestrians walking at once
    mix: VehicleMix  # categories of moving vehicles with their weights
    shapes: dict[str, dict[str, float]] = Field(default={})  # weights of shapes, by category; equal where left out
    rare: RareKinds = Field(default={})  # kinds of corner cases, with their shares among the vehicles of their category
    streets: dict[str, StreetParameters]  # parameters of the streets, by the net's edge type
    poles: tuple[PoleParameters, ...] = ()  # candidate sites of roadside sensors
    signs: tuple[SignParameters, ...] = ()  # signs of the map; signs of the same sort are not placed by rule then
    limits_known: bool = False  # the map says where speed-limit signs are: none is placed by rule
    posts: tuple[PostParameters, ...] = ()  # poles of the map
    objects: tuple[ObjectParameters, ...] = ()  # further objects of the map; with buildings or trees it has no others
    signals: tuple[SignalParameters, ...] = ()  # signal heads of the map; approaches with one have no others
    stop_lines: tuple[StopLineParameters, ...] = ()  # stop lines of the map; approaches with one have no others
    parking: tuple[ParkingParameters, ...] = ()  # parking spaces of the map
    parking_taken: Share = 0.6  # fraction of these that are taken
    worn_paint: Share = 0.0  # wear of the road markings: 0 as painted, 1 faded, half of it gone

    @model_validator(mode="after")
    def _known_shapes(self) -> "TownParameters":
        for category, weights in self.shapes.items():
            _mix({category: 1.0}, list(SHAPES))
            _mix(weights, [shape.name for shape in SHAPES[category] if shape.name not in RARE])
        ids = [pole.id for pole in self.poles]
        if len(set(ids)) != len(ids):
            raise ValueError("pole ids must differ")
        return self

    def shape_weights(self, category: str, *, parked: bool = False) -> list[float]:
        """Return the probabilities of a category's shapes for moving or `parked` vehicles, in the order of `SHAPES`."""
        rare = {kind: share for kind, share in self.rare.items() if kind != ANGLED and RARE[kind] == category}
        rare = {kind: share for kind, share in rare.items() if parked or kind not in PARKED_ONLY}
        weights = self.shapes.get(category) or {shape.name: 1.0 for shape in SHAPES[category] if shape.name not in RARE}
        total, common = sum(weights.values()), 1 - sum(rare.values())
        return [rare.get(shape.name, weights.get(shape.name, 0.0) / total * common) for shape in SHAPES[category]]
