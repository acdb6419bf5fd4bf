"""Train the network that paints points, whose weights come with flcav: `python tools/train_painter.py --out FOLDER`.

It records pictures of the simulated streets with a class for every pixel, of seeds that no other recording of the
repository has, trains on them, and writes `painter.safetensors`. Other pictures, of other traffic, are only tested on.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from flcav.config import Json
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.client import camera_ahead
from flcav.perception.device import inference
from flcav.perception.objects.config import PAINT_CLASSES
from flcav.perception.objects.painter import classes_of, train_painter
from flcav.perception.road.model import STRIDE, RoadNetwork, enlarge
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import parse_recipe

WEATHERS: Json = {"classes": ["clear", "heavy_rain", "fog", "night"]}
COMMON: dict[str, Json] = {"warmup_s": 40.0, "vehicle_rig": camera_ahead(416, 192, 70.0), "weather": WEATHERS}
EACH: dict[str, Json] = {**COMMON, "scenes": 40, "cavs": 3, "spins_per_scene": 2, "every_s": 6.0}
FEW: dict[str, Json] = {"town": "grid", "seed": 71, "scenes": 20, "cavs": 2, "spins_per_scene": 3, "every_s": 3.0}
TRAIN = [
    {**COMMON, **FEW},
    *({**EACH, "town": town, "seed": 81 + number} for number, town in enumerate(("suburb", "arterial", "grid"))),
]
TEST = {**EACH, "town": "suburb", "seed": 91, "scenes": 12}
EPOCHS, SEED = 30, 0


def main() -> None:
    """Record, train, test, and write the weights."""
    parser = argparse.ArgumentParser(description="train the network that paints points")
    parser.add_argument("--out", type=Path, required=True, help="folder of the recordings and of the weights")
    out = parser.parse_args().out
    torch.set_num_threads(1)
    sets = [open_recording(out / f"data{number}", recipe) for number, recipe in enumerate((*TRAIN, TEST))]
    pictures = [data.plane(i, "camera", "rgb") for data in sets[:-1] for i in range(len(data))]
    classes = [classes_of(data.plane(i, "camera", "semantic")) for data in sets[:-1] for i in range(len(data))]
    network = train_painter(pictures, classes, epochs=EPOCHS, seed=SEED)
    weights = {name: each.half() if each.is_floating_point() else each for name, each in network.state_dict().items()}
    save_file({name: each.contiguous() for name, each in weights.items()}, out / "painter.safetensors")
    shares = measure_iou(network, sets[-1])
    print(", ".join(f"{name} {share:.3f}" for name, share in zip(PAINT_CLASSES, shares, strict=True)))


def open_recording(folder: Path, recipe: dict[str, Json]) -> Dataset:
    """Return the dataset of a recipe, recorded into the folder unless it is there."""
    record(EmbeddedSource(parse_recipe(recipe, folder.name)), folder)
    return Dataset.open(folder)


def measure_iou(network: RoadNetwork, data: Dataset) -> list[float]:
    """Return the IoU of each class over all pictures."""
    both, either = np.zeros(len(PAINT_CLASSES)), np.zeros(len(PAINT_CLASSES))
    for i in range(len(data)):
        truth = classes_of(data.plane(i, "camera", "semantic"))
        picture = torch.from_numpy(data.plane(i, "camera", "rgb")).permute(2, 0, 1)[None].float() / 127.5 - 1
        with inference(network):
            found = enlarge(network(picture), STRIDE)[0].argmax(0).numpy()
        for number in range(len(PAINT_CLASSES)):
            both[number] += ((found == number) & (truth == number)).sum()
            either[number] += ((found == number) | (truth == number)).sum()
    return (both / np.maximum(either, 1)).tolist()


if __name__ == "__main__":
    main()
