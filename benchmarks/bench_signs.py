"""CPU time of one training sample and one inference of each sign detector, on pictures of recipes/signs.yaml.

CPU milliseconds at one thread, medians, the networks taken in turns: a training sample is augmentation, targets,
forward, loss, backward and optimiser on a window, in batches of the task's practice; inference is a whole picture.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from cpu_time import cpu_ms

from flcav.config import read_config
from flcav.perception.signs.evaluate import LOWEST_SCORE
from flcav.perception.signs.model import CONFIGURATIONS, SignDetector
from flcav.perception.signs.predict import detect_in_picture
from flcav.perception.signs.samples import Sample, label_picture
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import build_network
from flcav.perception.training import AdamW, step
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream

RECIPE = Path(__file__).parents[1] / "recipes/signs.yaml"
FRAMES, REPEATS = 16, 7


def main() -> None:
    torch.set_num_threads(1)
    recipe = read_config(Recipe, RECIPE).model_copy(update={"frames": FRAMES})
    source = EmbeddedSource(recipe)
    frames = list(source.frames(source.scenes()[0]))
    batch = SIGNS.practice.batch
    works: list[Callable[[], object]] = []
    for config in CONFIGURATIONS.values():
        samples = [label_picture(frame, "camera", frame.images["camera"].rgb, config) for frame in frames]
        works += [
            training(build_network(SIGNS, config, 0), samples, batch),
            inference(build_network(SIGNS, config, 0), samples),
        ]
    taken = cpu_ms(works, REPEATS)
    height, width = frames[0].images["camera"].rgb.shape[:2]
    print(f"CPU-ms per sample, medians of {REPEATS}; training in batches of {batch}, inference {width} x {height}")
    for name, config, train_ms, infer_ms in zip(
        CONFIGURATIONS, CONFIGURATIONS.values(), taken[::2], taken[1::2], strict=True
    ):
        across, down = config.window_px
        print(f"  {name}: training {train_ms / batch:6.1f} ({across} x {down}), inference {infer_ms:6.1f}")


def training(network: SignDetector, samples: list[Sample], batch: int) -> Callable[[], object]:
    """Return a function that takes one optimiser step of the network."""
    optimizer = AdamW(network.train(), SIGNS.practice.learning_rate)

    def work() -> float:
        drawn = [SIGNS.draw(samples, place, network.config, stream(0, "augment", place)) for place in range(batch)]
        return step(SIGNS, network, optimizer, drawn)

    return work


def inference(network: SignDetector, samples: list[Sample]) -> Callable[[], object]:
    """Return a function that detects signs in one picture."""
    return lambda: detect_in_picture(network, samples[0].picture, threshold=LOWEST_SCORE)


if __name__ == "__main__":
    main()
