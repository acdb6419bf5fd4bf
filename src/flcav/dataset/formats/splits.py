"""Which scenes of a dataset train a network, and which say how good it is."""

import math
from collections.abc import Mapping

from flcav.dataset.store import Dataset

SPLITS = ("train", "val", "test")


def split_scenes(dataset: Dataset, validation: float) -> Mapping[str, str]:
    """Return scene -> "train", "val" or "test". A scene is never divided: its frames show the same cars.

    A dataset recorded for validation or for testing goes there whole. Of any other, the last scenes validate: the
    share `validation` of them, rounded up, but never all.
    """
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    recorded_for = str(dataset.manifest["recipe"].get("split", ""))
    for split in ("val", "test"):
        if recorded_for.startswith(split):
            return dict.fromkeys(scenes, split)
    held_out = min(math.ceil(validation * len(scenes)), len(scenes) - 1)
    first = len(scenes) - held_out
    return {scene: "val" if i >= first else "train" for i, scene in enumerate(scenes)}
