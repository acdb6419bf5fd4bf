"""The signs and signal heads that show in an image."""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.frame import Array, SignViews
from flcav.sensors.labels.views import thing_regions
from flcav.world.scene import Scene

READABLE = np.cos(np.radians(80.0))  # of the angle between the line of sight and where the sign faces
STATES = {
    **dict.fromkeys("rR", "red"),
    **dict.fromkeys("yY", "amber"),
    **dict.fromkeys("gG", "green"),
    "u": "red_amber",
    "s": "red",  # with a green arrow, which the heads do not have
}  # SUMO's letters; any other is "off"


def view_signs(scene: Scene, world_from_camera: Array, instance: NDArray[np.int32]) -> SignViews:
    """Return the signs and signals of which an image shows the readable side.

    `instance` (H, W) is -(t + 1) at the town's thing t. The scene stands at the instant of the image.
    """
    things = scene.things
    regions = thing_regions(instance, len(things))
    camera = world_from_camera[:3, 3]
    sight = camera - things.position
    distance = np.linalg.norm(sight, axis=1)
    facing = (sight[:, 0] * np.cos(things.yaw) + sight[:, 1] * np.sin(things.yaw)) / np.maximum(distance, 1e-9)
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
