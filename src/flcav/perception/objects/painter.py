"""The camera's network that paints points: class scores by pixel, trained on pictures with classes by pixel.

It has the layers of the road task's network. Its weights come with flcav; `train_painter` makes them from recordings
that no detector is trained or tested on.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file
from torch.nn import functional

from flcav.arrays import Array, Array32, Bytes
from flcav.perception.device import inference
from flcav.perception.images import Picture
from flcav.perception.objects.config import PAINT_CLASSES
from flcav.perception.road.model import LARGEST_STRIDE, STRIDE, RoadConfig, RoadNetwork, enlarge
from flcav.sensors.frame import SEMANTICS

PAINTER = RoadConfig((12, 24, 48, 64))
WEIGHTS = Path(__file__).parent / "shipped" / "painter.safetensors"
KINDS = {  # tags of pixels -> class
    **dict.fromkeys(("car", "truck", "bus"), "vehicle"),
    "pedestrian": "person",
    **dict.fromkeys(("rider", "motorcycle", "bicycle"), "two-wheeler"),
}
CLASS_WEIGHTS = (1.0, 3.0, 6.0, 6.0)  # in the cross entropy: most pixels are of something else
GAIN = (0.5, 1.5)  # range of the brightness of training pictures


def classes_of(semantic: Bytes) -> Bytes:
    """Return the indices in `PAINT_CLASSES` (H, W) of pixels with semantic tags (H, W)."""
    table = np.zeros(256, np.uint8)
    for tag, name in KINDS.items():
        table[SEMANTICS[tag]] = PAINT_CLASSES.index(name)
    return table[semantic]


def new_painter() -> RoadNetwork:
    """Return a painter with weights drawn by torch's global generator."""
    return RoadNetwork(PAINTER, len(PAINT_CLASSES))


@lru_cache(maxsize=1)
def load_painter() -> RoadNetwork:
    """Return the painter that comes with flcav."""
    network = new_painter()
    network.load_state_dict(load_file(WEIGHTS))
    return network


def paint(network: RoadNetwork, picture: Picture, pixels: Array) -> Array32:
    """Return the class scores (N, classes) at pixels u, v (N, 2) of a picture; the first pixel's centre is (0, 0)."""
    height, width = picture.shape[:2]
    padding = ((0, -height % LARGEST_STRIDE), (0, -width % LARGEST_STRIDE), (0, 0))
    seen = torch.from_numpy(np.pad(picture, padding, mode="edge"))
    with inference(network):
        scores = network(seen.permute(2, 0, 1)[None].float() / 127.5 - 1)[0].softmax(0).numpy()
    column, row = np.floor((np.asarray(pixels) + 0.5) / STRIDE).astype(np.int64).T
    return scores[:, row, column].T


def train_painter(
    pictures: Sequence[Picture], classes: Sequence[Bytes], *, epochs: int, seed: int, rate: float = 3e-3
) -> RoadNetwork:
    """Return a painter trained on pictures (H, W, 3) of one size with classes (H, W), sides multiples of 16.

    Pictures are mirrored and their brightness is drawn. The learning rate falls by a cosine.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = new_painter()
    optimiser = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-3)
    batch = 8
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=epochs * -(-len(pictures) // batch))
    for _ in range(epochs):
        order = rng.permutation(len(pictures))
        for first in range(0, len(order), batch):
            chosen = order[first : first + batch]
            seen = np.stack([pictures[i] for i in chosen]).astype(np.float32) * rng.uniform(
                *GAIN, (len(chosen), 1, 1, 1)
            )
            truth = np.stack([classes[i] for i in chosen])
            if rng.random() < 0.5:
                seen, truth = seen[:, :, ::-1], truth[:, :, ::-1]
            inputs = torch.from_numpy(np.clip(seen, 0, 255).astype(np.float32)).permute(0, 3, 1, 2) / 127.5 - 1
            logits = enlarge(network(inputs), STRIDE)
            wanted = torch.from_numpy(truth.astype(np.int64))
            loss = functional.cross_entropy(logits, wanted, logits.new_tensor(CLASS_WEIGHTS))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return network
