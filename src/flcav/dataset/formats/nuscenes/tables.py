"""nuScenes' tables: constant rows, classes, attributes and channels, tokens, and links between rows."""

from hashlib import sha256

import numpy as np

from flcav.config import Json

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
MOVING_M_S = 0.2  # speed above which an actor counts as moving
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
    """Return table -> rows of all TABLES: `category`, `attribute` and `visibility` filled, the others empty."""
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
    """Return the token of the visibility level of an object, from its `occlusion` in [0, 1]; "" for NaN, unknown."""
    if np.isnan(occlusion):
        return ""
    return str(int(np.digitize(1 - occlusion, VISIBILITY)) + 1)


def attributes(category: str, track: str, speed_m_s: float) -> list[str]:
    """Return the token of an actor's attribute, e.g. "vehicle.moving"; none where it needs a speed that is NaN.

    It follows from the actor's class, its track id, which says whether it is parked, and its speed.
    """
    if np.isnan(speed_m_s) and category not in ("bicycle", "motorcycle"):
        return []
    moves = speed_m_s > MOVING_M_S
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
    """Set `prev` and `next` of each of the consecutive `rows` to the tokens of its neighbours, "" at the ends."""
    for row, before, after in zip(rows, [None, *rows], [*rows[1:], None]):
        row["prev"] = before["token"] if before else ""
        row["next"] = after["token"] if after else ""
