"""OpenCOOD's datasets on an export: python read_opencood.py OPENCOOD EXPORT.

It draws every sample of its three fusions, for training and for testing, and prints the boxes of those for testing.
The two things that OpenCOOD has compiled are restated in NumPy.
"""

import json
import random
import sys
from pathlib import Path

import numpy as np
from restated import VoxelGenerator, module

FUSIONS = ("late", "early", "intermediate")


def bbox_overlaps(some, others):
    """Return (N, M) the IoU of rectangles whose last pixel counts."""
    low = np.maximum(some[:, None, :2], others[None, :, :2])
    high = np.minimum(some[:, None, 2:4], others[None, :, 2:4])
    both = np.clip(high - low + 1, 0, None).prod(axis=2)
    areas = [(boxes[:, 2:4] - boxes[:, :2] + 1).prod(axis=1) for boxes in (some, others)]
    return (both / (areas[0][:, None] + areas[1] - both)).astype(np.float32)


def main(root: Path, export: Path) -> dict:
    """Return fusion -> number of samples to train on, and agent -> numbers and boxes of each to test on."""
    sys.path.insert(0, str(root))
    module("spconv")
    module("spconv.utils", VoxelGenerator=VoxelGenerator)
    module("opencood.utils.box_overlaps", bbox_overlaps=bbox_overlaps)
    from opencood.data_utils.datasets import build_dataset
    from opencood.hypes_yaml.yaml_utils import load_yaml

    read = {}
    for fusion in FUSIONS:
        settings = load_yaml(str(root / "opencood" / "hypes_yaml" / f"point_pillar_{fusion}_fusion.yaml"))
        settings |= {"root_dir": str(export / "train"), "validate_dir": str(export / "validate")}
        random.seed(0)
        np.random.seed(0)  # noqa: NPY002 (OpenCOOD draws from it)
        train, test = (build_dataset(settings, visualize=False, train=train) for train in (True, False))
        batch = train.collate_batch_train([train[i] for i in range(len(train))])
        assert len(batch["ego"]["object_bbx_center"]) == len(train)
        samples = [test[i] for i in range(len(test))]
        for sample in samples:
            test.collate_batch_test([sample])
        read[fusion] = {"train": len(train), "test": [_boxes(sample) for sample in samples]}
    return read


def _boxes(sample: dict) -> dict:
    return {
        str(agent): {
            "numbers": [int(number) for number in content["object_ids"]],
            "boxes": content["object_bbx_center"][content["object_bbx_mask"] == 1].tolist(),
        }
        for agent, content in sample.items()
    }


if __name__ == "__main__":
    found = main(Path(sys.argv[1]), Path(sys.argv[2]))
    print()
    print(json.dumps(found))
