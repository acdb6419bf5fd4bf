"""nuScenes' files: encodings of point clouds, radar sweeps and the map; classes, channels, tokens and constant rows."""

from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from flcav.config import InputError, Json, read_file
from flcav.dataset.formats.clouds import BRIGHTEST, encode_pcd
from flcav.dataset.formats.reading import check_cloud
from flcav.geometry import Array
from flcav.sensors.radar import compute_echo_directions
from flcav.world.map.town import Town

OURS_FROM_LIDAR = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # nuScenes: x right, y ahead
POINT_BYTES = 20  # x, y, z, intensity, ring, each float32
RESOLUTION_M = 0.1  # size of a pixel of the map
RADAR = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z")]
    + [("dyn_prop", "i1"), ("id", "<i2")]
    + [(name, "<f4") for name in ("rcs", "vx", "vy", "vx_comp", "vy_comp")]
    + [(name, "i1") for name in ("is_quality_valid", "ambig_state", "x_rms", "y_rms")]
    + [(name, "i1") for name in ("invalid_state", "pdh0", "vx_rms", "vy_rms")]
)
MOVING_M_S = 0.5  # speed over ground from which a radar return counts as moving
MOVING, STATIONARY, UNAMBIGUOUS, CERTAIN = 0, 1, 3, 1


def encode_lidar(points: NDArray[np.float32], elevations: Array) -> bytes:
    """Return the bytes of points (N, 5) float32: x, y, z [m] in nuScenes' LiDAR frame, intensity 0 to 255, ring.

    `points` is (N, 4): x, y, z [m], intensity [0, 1] in flcav's LiDAR frame (x ahead, y left). The ring is the index of
    the channel nearest in elevation; `elevations` [rad] lists the channels from the lowest. Without any, it is 0.
    """
    x, y, z, intensity = points.T
    ring = np.zeros(len(points), np.float32)
    if len(elevations):
        between = (elevations[1:] + elevations[:-1]) / 2
        ring = np.searchsorted(between, np.arctan2(z, np.hypot(x, y)))
    return np.column_stack((-y, x, z, intensity * 255, ring)).astype("<f4").tobytes()


def read_nuscenes_points(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a file of `encode_lidar`: x ahead, y left, z [m], intensity [0, 1].

    Raises `InputError` where it is missing, truncated, or has a point that is not finite or an intensity out of range.
    """
    data = read_file(path)
    if not data or len(data) % POINT_BYTES:
        raise InputError(f"{path}: truncated; {len(data)} bytes are no whole points of {POINT_BYTES} bytes")
    right, ahead, up, intensity, _ = np.frombuffer(data, "<f4").reshape(-1, 5).T
    cloud = np.stack((ahead, -right, up, intensity / np.float32(BRIGHTEST)), axis=1).astype(np.float32, copy=False)
    return check_cloud(cloud, path)


def encode_radar(echoes: NDArray[np.float32], velocity: Array) -> bytes:
    """Return a binary PCD file of radar returns (N, 5): range [m], azimuth, elevation [rad], Doppler [m/s], RCS [dBsm].

    `velocity` (3,) is that of the radar, in its frame [m/s]. Only the radial velocity of a return is measured: `vx`,
    `vy` are its components relative to the radar, `vx_comp`, `vy_comp` those over ground, with the radar's motion
    added. Without returns the file has a single point, at NaN.
    """
    rows = np.zeros(max(len(echoes), 1), RADAR)
    if not len(echoes):
        rows["x"] = np.nan
    else:
        distance, _, _, doppler, rcs = echoes.T.astype(np.float64)
        ray = compute_echo_directions(echoes)
        over_ground = doppler + ray @ velocity
        for axis, name in enumerate("xyz"):
            rows[name] = distance * ray[:, axis]
        for axis, name in enumerate(("vx", "vy")):
            rows[name] = doppler * ray[:, axis]
            rows[f"{name}_comp"] = over_ground * ray[:, axis]
        rows["rcs"] = rcs
        rows["id"] = np.arange(len(rows))
        rows["dyn_prop"] = np.where(np.abs(over_ground) > MOVING_M_S, MOVING, STATIONARY)
        rows["is_quality_valid"] = 1
    rows["ambig_state"], rows["pdh0"] = UNAMBIGUOUS, CERTAIN
    return encode_pcd(rows) + b"\n"  # the devkit wants a byte after the last point


def decode_radar(rows: NDArray[np.void]) -> NDArray[np.float32]:
    """Return radar returns (N, 5) of a PCD file: range [m], azimuth, elevation [rad], Doppler [m/s], RCS [dBsm].

    Points that the devkit leaves out by default, as invalid or ambiguous, are left out.
    """
    kept = (rows["invalid_state"] == 0) & (rows["ambig_state"] == UNAMBIGUOUS) & np.isfinite(rows["x"])
    x, y, z, vx, vy, rcs = (rows[name][kept].astype(np.float64) for name in ("x", "y", "z", "vx", "vy", "rcs"))
    level = np.hypot(x, y)
    distance = np.hypot(level, z)
    doppler = (vx * x + vy * y) * distance / level**2  # the inverse of `encode_radar`: vx is Doppler times x / distance
    return np.column_stack((distance, np.arctan2(y, x), np.arctan2(z, level), doppler, rcs)).astype(np.float32)


def map_mask(town: Town) -> NDArray[np.uint8]:
    """Return the mask (H, W) of a town at RESOLUTION_M, north up: 255 on roads and sidewalks, else 0.

    Its lower left corner is that of the town's bounds.
    """
    x_min, y_min, x_max, y_max = town.bounds
    width, height = (round(extent / RESOLUTION_M) for extent in (x_max - x_min, y_max - y_min))
    image = Image.new("L", (width, height))
    draw = ImageDraw.Draw(image)
    for polygon in (*town.roads, *town.sidewalks):
        pixels = np.column_stack((polygon[:, 0] - x_min, y_max - polygon[:, 1])) / RESOLUTION_M
        draw.polygon([tuple(pixel) for pixel in pixels.tolist()], fill=255)
    return np.asarray(image)


Row = dict[str, Json]

VERSION = "v1.0-flcav"

TABLES = (
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
)
CATEGORIES = {
    "car": "vehicle.car",
    "van": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult",
}
ATTRIBUTES = (
    "vehicle.moving",
    "vehicle.stopped",
    "vehicle.parked",
    "cycle.with_rider",
    "pedestrian.moving",
    "pedestrian.standing",
)
VISIBILITY = (0.4, 0.6, 0.8)  # visible share from which the levels 2, 3 and 4 apply
MOVES_M_S = 0.2  # speed above which an actor counts as moving
CAMERAS = {  # channel -> yaw, counter-clockwise from ahead [rad]
    "CAM_FRONT": 0.0,
    "CAM_FRONT_LEFT": np.radians(55),
    "CAM_FRONT_RIGHT": np.radians(-55),
    "CAM_BACK_LEFT": np.radians(110),
    "CAM_BACK_RIGHT": np.radians(-110),
    "CAM_BACK": np.pi,
}
RADARS = {
    "RADAR_FRONT": 0.0,
    "RADAR_FRONT_LEFT": np.radians(90),
    "RADAR_FRONT_RIGHT": np.radians(-90),
    "RADAR_BACK_LEFT": np.radians(170),
    "RADAR_BACK_RIGHT": np.radians(-170),
}


def token(*names: str | int) -> str:
    """Return the token of a row, 32 hexadecimal digits of the SHA-256 of its `names`."""
    return sha256("/".join(map(str, names)).encode()).hexdigest()[:32]


def constant_rows() -> dict[str, list[Row]]:
    """Return the rows of all TABLES, by table: `category`, `attribute` and `visibility` filled, the others empty."""
    shares = ("0 to 40 %", "40 to 60 %", "60 to 80 %", "80 to 100 %")
    tables: dict[str, list[Row]] = {name: [] for name in TABLES}
    tables["category"] = [
        {"token": token("category", name), "name": name, "description": "", "index": i}
        for i, name in enumerate(dict.fromkeys(CATEGORIES.values()))
    ]
    tables["attribute"] = [{"token": token("attribute", name), "name": name, "description": ""} for name in ATTRIBUTES]
    tables["visibility"] = [
        {"token": str(i + 1), "level": f"v{share.replace(' to ', '-').removesuffix(' %')}", "description": share}
        for i, share in enumerate(shares)
    ]
    return tables


def visibility(occlusion: float) -> str:
    """Return the token of the visibility level for an `occlusion` in [0, 1]; "" for NaN, unknown."""
    if np.isnan(occlusion):
        return ""
    return str(int(np.digitize(1 - occlusion, VISIBILITY)) + 1)


def attributes(category: str, track: str, speed_m_s: float) -> list[str]:
    """Return the token of an actor's attribute, e.g. "vehicle.moving"; none where it depends on a speed that is NaN.

    It follows from the actor's class, its track id, which shows whether it is parked, and its speed.
    """
    if np.isnan(speed_m_s) and category not in ("bicycle", "motorcycle"):
        return []
    moves = speed_m_s > MOVES_M_S
    if category == "pedestrian":
        name = "pedestrian.moving" if moves else "pedestrian.standing"
    elif category in ("bicycle", "motorcycle"):
        name = "cycle.with_rider"
    elif track.startswith("parked"):
        name = "vehicle.parked"
    else:
        name = "vehicle.moving" if moves else "vehicle.stopped"
    return [token("attribute", name)]


def link_rows(rows: list[Row]) -> None:
    """Set `prev` and `next` of consecutive `rows` to the tokens of their neighbours, "" at the ends."""
    for row, before, after in zip(rows, [None, *rows], [*rows[1:], None]):
        row["prev"] = before["token"] if before else ""
        row["next"] = after["token"] if after else ""
