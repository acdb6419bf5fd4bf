"""Let traffic drive through a town, look at it from two vehicles and a pole, and draw one frame from above."""

import sys
from pathlib import Path

import numpy as np

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.geometry import inverse, transform_points
from flcav.report import style
from flcav.report.pictures.birdseye import BirdseyeView, birdseye
from flcav.sensors.frame import Frame
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import write_bytes

RECIPE = {"town": "grid", "seed": 7, "cavs": 2, "poles": [8], "warmup_s": 40.0, "spins_per_scene": 2, "every_s": 2.0}


def main(out: Path) -> None:
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "this example")), out / "data")
    data = Dataset.open(out / "data")
    for i in range(len(data)):
        frame = data.frame(i)
        truth = frame.annotations
        print(
            f"{frame.key}: {len(frame.lidar['lidar'])} points at {frame.time_s:.0f} s; {len(truth)} actors around, "
            f"{int((truth.returns > 0).sum())} hit by the LiDAR, {int((truth.occlusion > 0.5).sum())} mostly hidden"
        )
    write_bytes(out / "frame.png", style.png(birdseye(seen_from_above(data.frame(0)))))
    print(f"{out / 'frame.png'}: the first frame from above")


def seen_from_above(frame: Frame) -> BirdseyeView:
    """Return the frame in its agent's coordinates, heights above the ground."""
    points = transform_points(frame.agent_from_sensor["lidar"], frame.lidar["lidar"][:, :3].astype(np.float64))
    points[:, 2] += frame.world_from_agent[2, 3]
    boxes = frame.annotations.boxes.transform(inverse(frame.world_from_agent))
    return BirdseyeView(points, boxes, frame.annotations.returns, f"{frame.key} in the town {RECIPE['town']!r}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/observe"))
