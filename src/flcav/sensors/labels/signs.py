"""Image annotations of traffic signs and signal heads: classes, signal states, visible boxes."""

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import heading_vectors
from flcav.sensors.frame import Array, SignViews
from flcav.sensors.labels.views import find_thing_regions
from flcav.world.scene import Scene

READABLE = np.cos(np.radians(80.0))  # of the largest angle between a sign's normal and the line of sight
STATES = {
    **dict.fromkeys("rR", "red"),
    **dict.fromkeys("yY", "amber"),
    **dict.fromkeys("gG", "green"),
    "u": "red_amber",
    "s": "red",  # in SUMO a red with a green right-turn arrow; the heads have no arrow
}  # by SUMO's letters for link states; all others are "off"


def view_signs(scene: Scene, world_from_camera: Array, instance: NDArray[np.int32]) -> SignViews:
    """Return the signs and signal heads whose front an image shows.

    `instance` (H, W) is -(t + 1) at the town's thing t; `world_from_camera` (4, 4) is the camera's pose. The scene is
    at the instant of the image.
    """
    things = scene.things
    regions = find_thing_regions(instance, len(things))
    camera = world_from_camera[:3, 3]
    sight = camera - things.position
    distance = np.linalg.norm(sight, axis=1)
    normal = heading_vectors(things.yaw)
    facing = (sight[:, 0] * normal[:, 0] + sight[:, 1] * normal[:, 1]) / np.maximum(distance, 1e-9)
    seen = np.flatnonzero((regions.pixels > 0) & (facing > READABLE))
    state_of = dict(zip(scene.trace.light.tolist(), scene.trace.light_state[scene.index].tolist()))
    states = [STATES.get(state_of.get(things.link[row], ""), "off") if things.link[row] else "" for row in seen]
    return SignViews(
        kind=np.array([things.kind[row] for row in seen], dtype=np.str_),
        state=np.array(states, dtype=np.str_),
        box=regions.box[seen],
        pixels=regions.pixels[seen],
        distance_m=distance[seen],
        thing=seen.astype(np.int64),
    )
