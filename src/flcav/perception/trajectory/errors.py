"""Error registry of the trajectory task: forecasts whose single path has a final error above `MISS_M`."""

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.errors import FINAL_ERROR, PerceptionError, Registry
from flcav.perception.trajectory.evaluate import MISS_M
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import find_medoid, predict
from flcav.perception.trajectory.samples import Samples
from flcav.world.trace import Trace


def register_errors(
    network: TrajectoryNetwork, data: Dataset, samples: Samples, progress: Report = ignore_progress
) -> Registry:
    """Return the first miss of each road user and scene: a single path with a final error above `MISS_M`.

    Its position is that of the road user at the present, on the ground of the town.
    """
    columns = samples.columns
    paths, probabilities = predict(network, samples, progress)
    said = paths[np.arange(len(paths)), find_medoid(paths, probabilities), -1]
    wrong = np.linalg.norm(said - columns.future[:, -1], axis=1) > MISS_M
    town = data.town()
    traces: dict[str, Trace | None] = {scene: data.trace(scene) for scene in np.unique(columns.scene).tolist()}
    found: dict[int, list[PerceptionError]] = {}
    for row in np.flatnonzero(wrong):
        scene, actor = str(columns.scene[row]), int(columns.actor[row])
        trace = traces[scene]
        assert trace is not None  # the samples come from it
        x, y, _ = columns.pose[row]
        found.setdefault(int(columns.frame[row]), []).append(
            PerceptionError(
                x=float(x),
                y=float(y),
                z=0.0 if town is None else town.ground(float(x), float(y)),
                weight=1.0,
                kind=FINAL_ERROR,
                label=str(trace.category[actor]),
                returns=0,
                occlusion=float("nan"),
                scene=scene,
                track=str(trace.actor[actor]),
            )
        )
    return Registry.of(found)
