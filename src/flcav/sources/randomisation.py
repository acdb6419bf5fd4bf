"""Domain randomisation of recordings: streets, terrain, sizes of cars and LiDARs drawn widely around those of a recipe.

A detector that meets every kind of street in training takes a real one for another of them (Tobin et al., "Domain
randomization for transferring deep neural networks from simulation to the real world", IROS 2017).
"""

import io
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import pyarrow.parquet as pq
import shapely
import yaml
from shapely.geometry import Polygon

from flcav.geometry import Array, wrap_angle
from flcav.sensors.lidar.beams import BEAMS
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.rig import MountedLidar, Rig
from flcav.world.map.parameters import (
    BOUNDARIES,
    CLUTTER,
    KERBSIDE,
    MOST,
    ParkingParameters,
    StreetParameters,
    TownParameters,
)
from flcav.world.map.relief import Relief
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.street_furniture import list_verges, outline_space
from flcav.world.map.town import HEIGHTS, Town, furnish_town, lift_town
from flcav.world.shapes import RARE, SHAPES
from flcav.world.static import LAND_M
from flcav.world.trace import Trace

Draw = np.random.Generator
# What a recipe draws: LiDARs of 40 beams and more; of 16 beams and more; these, and cars parked across the street.
Drawing = Literal["streets", "lidars", "wide"]

CELL_M, FAR_CELL_M = 5.0, 50.0  # of the terrain within the town's bounds, and beyond them
STEEPEST = 0.035  # slope of one of three long waves of the terrain
BOW_M = (0.1, 0.5)  # least and most of a car's ends; on KITTI's cars about .25 m at the rear, .35 m at the front
LARGEST = 1.06  # factor of a car's length: parked cars keep apart
Spans = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
ALIKE: Spans = ((1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
FACTORS: Mapping[str, Spans] = {  # of length, width and height, by category; others keep their size
    **dict.fromkeys(("car", "van"), ((0.85, LARGEST), (0.92, 1.08), (0.9, 1.12))),
    **dict.fromkeys(("bicycle", "motorcycle"), ((0.92, 1.08), (0.85, 1.1), (0.95, 1.06))),
    "pedestrian": ((0.75, 1.7), (0.7, 1.15), (0.9, 1.08)),
}
PATTERNS = ("hdl64e", "vlp32c twice", "vls128", "os1_128", "even")  # of beams; "twice": two LiDARs, one on the other
MORE_PATTERNS = (  # of 16 beams and more
    *("vlp16", "vlp16", "vlp16", "hdl32e", "vlp32c", "os1_32", "os2_32", "pandar40"),
    *("hdl64e", "hdl64e", "pandar64", "waymo64", "os0_64", "os1_64", "os2_64", "vlp32c twice"),
    *("vls128", "pandar128", "at128", "os0_128", "os1_128", "os2_128", "even"),
)
EVEN_BEAMS, MORE_EVEN_BEAMS = (40, 96), (16, 96)  # fewest and most of the pattern "even"
DRAWN_BEAMS: Mapping[Drawing, tuple[int, int]] = {  # fewest and most of all patterns
    "streets": (40, 128),
    "lidars": (16, 128),
    "wide": (16, 128),
}
HEIGHTS_M = (1.2, 2.3)  # above the ground, of LiDARs of `MORE_PATTERNS`
BAY_ROWS, BAY_ROW = (0.3, 0.9), (3, 12)  # share of the sidewalks with a row of bays, and bays in a row
BAY_ANGLES_DEG, BAY_M, BAY_WIDTH_M = (90.0, 90.0, 70.0, 55.0), 5.2, (2.4, 2.8)  # to the street; length and width
BAYS_TAKEN, CLEAR = (0.4, 0.95), 0.5  # share of the bays with a vehicle, and of the streets without a parking lane
FAILING, FAILED = 0.25, 0.15  # share of these LiDARs of which beams fail, and the most of the probability that one does
FASTER = 0.25  # share of these LiDARs that spin twice as fast, with half the firings in a spin
DROPPING = 0.4  # fraction of the LiDARs that lose many returns


def randomise_town(town: Town, draw: Draw, drawing: Drawing = "streets") -> Town:
    """Return a town on the same net with randomised streets and traffic, and terrain unless the town has heights."""
    parameters, net = _draw_parameters(town.parameters, draw), read_net(town.net)
    if drawing == "wide":
        parameters = parameters.model_copy(
            update={
                "parking": tuple(_draw_bays(town, net, draw)),
                "parking_taken": draw.uniform(*BAYS_TAKEN),
                "streets": {kind: _clear_lane(street, draw) for kind, street in parameters.streets.items()},
            }
        )
    drawn = furnish_town(town.name, town.net, net, parameters)
    return lift_town(drawn, town.relief or draw_terrain(drawn, draw))


def town_files(town: Town) -> Mapping[str, bytes]:
    """Return the files of a town's folder by name: net, parameters and heights, as `load_town` reads them."""
    values = town.parameters.model_dump(mode="json", exclude_defaults=True)
    files = {"town.net.xml": town.net.read_bytes(), "town.yaml": yaml.safe_dump(values, sort_keys=False).encode()}
    if town.relief is not None:
        heights = io.BytesIO()
        pq.write_table(town.relief.table(), heights, compression="zstd")
        files[HEIGHTS] = heights.getvalue()
    return files


def _draw_parameters(town: TownParameters, draw: Draw) -> TownParameters:
    """Return parameters of the same net: other streets, other traffic."""
    shapes = {
        kind: _mix([shape.name for shape in SHAPES[kind] if shape.name not in RARE], draw) for kind in ("car", "van")
    }
    mix = _mix(["van", "truck", "bus", "motorcycle", "bicycle"], draw)
    others = draw.uniform(0.15, 0.5)
    values = town.model_dump() | {
        "seed": int(draw.integers(2**31)),
        "vehicles": min(round(town.vehicles * draw.uniform(0.7, 1.4)), MOST),
        "pedestrians": min(round(town.pedestrians * draw.uniform(0.7, 1.6)), MOST),
        "mix": {"car": 1 - others} | {kind: others * share for kind, share in mix.items()},
        "shapes": shapes,
        "streets": {kind: _draw_street(street, draw).model_dump() for kind, street in town.streets.items()},
    }
    return TownParameters.model_validate(values)


def _draw_street(street: StreetParameters, draw: Draw) -> StreetParameters:
    """Return random parameters of a street: plots, boundaries, clutter, kerbside furniture and parked vehicles."""

    def span(low: tuple[float, float], more: tuple[float, float]) -> tuple[float, float]:
        start = draw.uniform(*low)
        return start, start + draw.uniform(*more)

    drawn = {
        "setback_m": span((0.5, 5.0), (0.5, 5.0)),
        "building_gap_m": span((1.0, 5.0), (1.0, 8.0)),
        "building_height_m": span((3.0, 8.0), (1.0, 8.0)),
        "tree_spacing_m": draw.uniform(7.0, 40.0),
        "trees_at_kerb": draw.uniform(0.0, 0.7),
        "lamp_spacing_m": draw.uniform(20.0, 50.0),
        "clutter_spacing_m": draw.uniform(4.0, 14.0),
        "clutter": _mix(list(CLUTTER), draw),
        "clutter_size": (draw.uniform(0.5, 0.8), draw.uniform(1.2, 1.6)),
        "boundary": _mix(list(BOUNDARIES), draw) if draw.random() < 0.85 else {},
        "boundary_length_m": span((3.0, 10.0), (5.0, 25.0)),
        "boundary_gap_m": span((0.5, 3.0), (1.0, 8.0)),
        "boundary_setback_m": (0.05, draw.uniform(0.3, 2.5)),
        "kerbside": _mix(list(KERBSIDE), draw),
        "kerbside_spacing_m": draw.uniform(6.0, 30.0),
    }
    if street.parked:
        drawn["parked"] = draw.uniform(0.1, 0.8)
        drawn["parked_mix"] = {"car": 1.0, "van": draw.uniform(0, 0.25), "truck": draw.uniform(0, 0.05)}
    return StreetParameters.model_validate(street.model_dump() | drawn)


def _clear_lane(street: StreetParameters, draw: Draw) -> StreetParameters:
    """Return the street, in `CLEAR` of all cases without vehicles in its parking lane, so that the bays are in view."""
    return street.model_copy(update={"parked": 0.0}) if draw.random() < CLEAR else street


def _draw_bays(town: Town, net: RoadNet, draw: Draw) -> list[ParkingParameters]:
    """Return rows of parking spaces across the street or at an angle to it, behind the sidewalks of a town's net."""
    share, bays = draw.uniform(*BAY_ROWS), []
    closed = shapely.union_all([Polygon(outline) for outline in (*town.roads, *town.sidewalks)])
    shapely.prepare(closed)
    for verge in list_verges(net, town.parameters):
        angle, width = np.radians(draw.choice(BAY_ANGLES_DEG)), draw.uniform(*BAY_WIDTH_M)
        along, rows = draw.uniform(2.0, 10.0), int(draw.integers(BAY_ROW[0], BAY_ROW[1] + 1))
        turn, into = float(draw.choice((-1, 1)) * angle), (BAY_M * np.sin(angle) + width * np.cos(angle)) / 2
        if draw.random() >= share:
            continue
        for number in range(rows):
            at = along + number * width / np.sin(angle)
            x, y, heading = verge.at(at, verge.half_width + 0.1 + into)
            yaw_deg = float(np.degrees(wrap_angle(heading + turn)))
            bay = ParkingParameters(x=x, y=y, yaw_deg=yaw_deg, length_m=BAY_M, width_m=width)
            if at < verge.line.length - 2.0 and not closed.intersects(outline_space(bay)):
                bays.append(bay)
                closed = closed.union(outline_space(bay).buffer(-0.05))
    return bays


def _mix(names: list[str], draw: Draw) -> dict[str, float]:
    """Return weights of `names` that sum to 1, from a flat Dirichlet distribution."""
    return dict(zip(names, draw.dirichlet(np.ones(len(names))).round(4).clip(1e-4).tolist()))


def draw_terrain(town: Town, draw: Draw) -> Relief:
    """Return random terrain [m] for a level town, world frame: long and short waves, and roughness off the roads."""
    x0, y0, x1, y1 = town.bounds
    near = _grid((x0, y0, x1, y1), CELL_M)
    far = _grid((x0 - LAND_M, y0 - LAND_M, x1 + LAND_M, y1 + LAND_M), FAR_CELL_M)
    inside = (far[:, 0] > x0) & (far[:, 0] < x1) & (far[:, 1] > y0) & (far[:, 1] < y1)
    at = np.concatenate((near, far[~inside]))
    length = np.concatenate((draw.uniform(100, 400, 3), draw.uniform(15, 60, 3)))
    height = np.concatenate((draw.uniform(0, STEEPEST, 3) * length[:3] / (2 * np.pi), draw.uniform(0, 0.08, 3)))
    heading, phase = draw.uniform(0, 2 * np.pi, (2, 6))
    along = at[:, :1] * np.cos(heading) + at[:, 1:] * np.sin(heading)
    z = (height * np.sin(2 * np.pi * along / length + phase)).sum(axis=1)
    driven = shapely.union_all([Polygon(outline) for outline in town.roads]).buffer(CELL_M)
    shapely.prepare(driven)
    smooth, rough = draw.uniform(0.0, 0.02), draw.uniform(0.02, 0.15)
    z += draw.standard_normal(len(at)) * np.where(shapely.contains_xy(driven, *at.T), smooth, rough)
    return Relief(np.column_stack((at, z)))


def _grid(bounds: tuple[float, float, float, float], cell_m: float) -> Array:
    x0, y0, x1, y1 = bounds
    x = np.linspace(x0, x1, max(2, round((x1 - x0) / cell_m) + 1))
    y = np.linspace(y0, y1, max(2, round((y1 - y0) / cell_m) + 1))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def randomise_rig(rig: Rig, draw: Draw, drawing: Drawing = "streets") -> Rig:
    """Return the rig with mount, beams, range and losses of every LiDAR randomised; other sensors stay as they are."""
    drawn = {name: _draw_lidar(one, draw, drawing) for name, one in rig.lidars.items()}
    return rig.model_copy(update={"lidars": drawn})


def _draw_lidar(lidar: MountedLidar, draw: Draw, drawing: Drawing) -> MountedLidar:
    height = lidar.mount.z + draw.uniform(-0.2, 0.4) if drawing == "streets" else draw.uniform(*HEIGHTS_M)
    mount = lidar.mount.model_copy(
        update={
            "z": height,
            "pitch_deg": lidar.mount.pitch_deg + draw.normal(0, 0.7),
            "roll_deg": lidar.mount.roll_deg + draw.normal(0, 0.7),
        }
    )
    patterns, even = (PATTERNS, EVEN_BEAMS) if drawing == "streets" else (MORE_PATTERNS, MORE_EVEN_BEAMS)
    elevations, steps = _draw_beams(str(draw.choice(patterns)), draw, even)
    if drawing != "streets":
        elevations, steps = _wear_out(elevations, draw), steps // 2 if draw.random() < FASTER else steps
    fixed = lidar.settings.model_dump(exclude={"beams", "channels", "elevations_deg", "azimuth_steps"})
    settings = Lidar.model_validate(
        fixed
        | {
            "channels": len(elevations),
            "elevations_deg": elevations,
            "azimuth_steps": steps,
            "sensitivity_m": float(np.exp(draw.uniform(np.log(80), np.log(300)))),
            "noise_m": draw.uniform(0.01, 0.035),
            "dropout": draw.uniform(0.03, 0.25) if draw.random() < DROPPING else draw.uniform(0.0, 0.03),
            "glass_pass": draw.uniform(0.6, 0.95),
            "roughness_rad": draw.uniform(0.1, 0.9),
            "intensity_gamma": draw.uniform(0.4, 1.0),
            "intensity_floor": draw.uniform(0.0, 0.15),
        }
    )
    return MountedLidar(mount=mount, settings=settings)


def _draw_beams(pattern: str, draw: Draw, even: tuple[int, int]) -> tuple[tuple[float, ...], int]:
    """Return the elevations [deg] and the azimuth steps of one of `PATTERNS`, with small errors per beam.

    `even` are the fewest and the most beams of the pattern of that name.
    """
    if pattern == "even":
        elevations = np.linspace(draw.uniform(2, 15), draw.uniform(-25, -16), int(draw.integers(even[0], even[1] + 1)))
        steps = int(draw.integers(1000, 2001))
    else:
        known = BEAMS[pattern.removesuffix(" twice")]
        elevations, steps = np.array(known.elevations_deg), known.azimuth_steps
        if pattern.endswith("twice"):
            elevations = np.concatenate((elevations, elevations + draw.uniform(-0.3, 0.3)))
    off = elevations + draw.normal(0, 0.04, len(elevations))
    return tuple(float(elevation) for elevation in off.round(3)), steps


def _wear_out(elevations: tuple[float, ...], draw: Draw) -> tuple[float, ...]:
    """Return the elevations of the beams that work: of some LiDARs each fails with a probability of up to `FAILED`."""
    failed = draw.random(len(elevations)) < (draw.uniform(0, FAILED) if draw.random() < FAILING else 0.0)
    return tuple(elevation for elevation, fails in zip(elevations, failed) if not fails)


def randomise_bodies(trace: Trace, draw: Draw) -> Trace:
    """Return the trace with the actors' sizes [m] drawn around those of their shapes, and bowed ends of cars and vans.

    Pedestrians vary most, since stride and arms count.
    """
    spans = np.array([FACTORS.get(kind, ALIKE) for kind in trace.category.tolist()]).reshape(-1, 3, 2)
    size = (trace.size * draw.uniform(spans[..., 0], spans[..., 1])).round(3)
    bow = draw.uniform(*BOW_M, size=len(size)).round(3)
    return replace(trace, size=size, bow=np.where(np.isin(trace.category, ("car", "van")), bow, 0.0))
