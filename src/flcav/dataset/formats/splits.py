"""Which scenes of a dataset train a network, and which say how good it is."""

import math
from collections.abc import Mapping

from flcav.config import InputError
from flcav.dataset.formats.exporter import ExportOptions
from flcav.dataset.store import Dataset

SPLITS = ("train", "val", "test")


def split_scenes(dataset: Dataset, options: ExportOptions) -> Mapping[str, str]:
    """Return scene -> "train", "val" or "test". A scene is never divided: its frames show the same cars.

    A dataset recorded for validation or for testing goes there whole; raises `InputError` where a share that validates
    is asked for all the same. Of any other, the last scenes validate: that share of them, rounded up, but never all.
    """
    scenes = list(dict.fromkeys(key.scene for key in dataset.keys))
    recorded_for = str(dataset.manifest.recipe.get("split", ""))
    for split in ("val", "test"):
        if recorded_for.startswith(split):
            if "validation" in options.model_fields_set:
                raise InputError(
                    f"{dataset.folder}: its recipe says 'split: {recorded_for}', so --validation is not for it"
                )
            return dict.fromkeys(scenes, split)
    held_out = min(math.ceil(options.validation * len(scenes)), len(scenes) - 1)
    first = len(scenes) - held_out
    return {scene: "val" if i >= first else "train" for i, scene in enumerate(scenes)}


def split_validated(dataset: Dataset, options: ExportOptions, name: str) -> Mapping[str, str]:
    """Return `split_scenes` for a format `name` that trains on no dataset unless scenes of it validate.

    Raises `InputError` where the only scene trains, unless it is asked that none validates.
    """
    split_of = split_scenes(dataset, options)
    if set(split_of.values()) == {"train"} and options.validation:
        raise InputError(
            f"{dataset.folder}: cannot be exported to {name}, which needs scenes that validate beside those that "
            "train; it is one scene: record two or more, or leave the validation empty with --validation 0"
        )
    return split_of
