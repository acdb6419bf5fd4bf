"""Labels that a sensor on a pole adds to those of vehicles: expected before it stands, and found in its sweeps.

Coverage counts registered errors within a radius. Vehicles learn from what the road detector labels, in frames in which
they have returns of the object themselves:

- *expected labels*: the missed objects of which the vehicle had returns, each weighted by the road detector's recall at
  its distance from the pole, where the pole sees its place through town and traffic. Known before a sensor stands.
- *labels really added*: boxes of the road detector with returns of a vehicle whose own detections lack them, over the
  frames that vehicles train on. Known once a sensor has recorded: a bound of what any objective could predict.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.dataset.ground import Ground
from flcav.fusion.labels import label_sample
from flcav.perception.errors import MISS, PerceptionError
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar
from flcav.runs.frames import Frames
from flcav.runs.labels.pseudo_labels import road_views
from flcav.world.line_of_sight import find_visible
from flcav.world.map.town import Town
from flcav.world.trace import Trace

Array = NDArray[np.float64]

BIN_M = 5.0  # of horizontal distance from the pole
RECALL = np.array(
    (0.67, 0.99, 0.92, 0.96, 0.91, 0.97, 0.94, 0.86, 0.53, 0.29, 0.05, 0.0)
)  # reproductions/sensor-ranges
REACH_M = 100.0  # between a pole and a vehicle, farther than both see together


def expect_labels(town: Town, traces: Sequence[Trace], errors: Sequence[PerceptionError], sites: Array) -> Array:
    """Return (P,) the expected labels of a sensor on each of `sites` (P, 3), world [m]: see the module.

    traces: of the traffic that may stand in the way.
    """
    missed = [error for error in errors if error.kind == MISS and error.returns > 0]
    places = np.array([(error.x, error.y, error.z) for error in missed]).reshape(-1, 3)
    apart = np.linalg.norm(sites[:, None, :2] - places[None, :, :2], axis=2)
    recall = np.append(RECALL, 0.0)[np.minimum(apart / BIN_M, len(RECALL)).astype(np.int64)]
    pole, error = (rows.astype(np.int64) for rows in np.nonzero(recall))
    seen = find_visible(town, traces, sites, places, (pole, error))
    return np.bincount(pole, recall[pole, error] * seen, minlength=len(sites)).astype(np.float64)


def count_added_labels(
    network: Second, threshold: float, split: Frames, frames: Sequence[int], poles: Mapping[int, Array]
) -> dict[int, int]:
    """Return by pole the labels that its sensor adds to vehicles' `frames` of a split: see the module.

    The network's detections that score `threshold` or more are the vehicles' own. poles: places (3,) of those whose
    sweeps are in the split, world [m].
    """
    keys, relief = split.data.keys, Ground(split.data).relief
    own = {i: detect_in(network, [split.data.frame(i)], score_threshold=threshold)[0] for i in frames}
    added = {}
    for pole, place in poles.items():
        near = [i for i in frames if np.linalg.norm((split.data.world_from_agent(i)[:3, 3] - place)[:2]) <= REACH_M]
        spins = {(keys[i].scene, keys[i].index) for i in near}
        views = road_views(split, [pole], True, spins)
        added[pole] = 0
        for i in near:
            frame, told = split.data.frame(i), [*views.get((keys[i].scene, keys[i].index), {}).values()]
            lidar = choose_lidar(frame)
            alone, helped = (label_sample(frame, own[i], each, network.config, lidar, relief) for each in ([], told))
            if helped.exact is not None:
                road, known = helped.boxes[helped.exact], alone.boxes.center[:, :2]
                offset = np.linalg.norm(road.center[:, None, :2] - known[None], axis=2)
                added[pole] += int((offset >= road.size[:, :1] / 2).all(axis=1).sum())
    return added
