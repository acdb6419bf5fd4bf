"""Samples of roadside units that train: their sweeps, labelled by their detector, as if from a vehicle's height."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from flcav.dataset.ground import DatasetGround
from flcav.fusion.labels import label_sample
from flcav.geometry import Boxes, inverse, pose
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample, move_points
from flcav.perception.objects.truth import QUARTERS, choose_lidar
from flcav.runs.frames import Frames
from flcav.runs.labels.pseudo_labels import Spin, road_views
from flcav.sensors.frame import Frame


def label_roadside(
    split: Frames, poles: Sequence[int], region: str, config: SecondConfig, spins: Collection[Spin]
) -> dict[str, list[Sample]]:
    """Return the samples of the units on `poles` in `spins`, by "region/pole", in the frame of a vehicle's network.

    That network looks ahead, from as high above the ground as vehicles' LiDARs are: a sweep gives a sample for each
    quarter turn, and its returns are as high above the ground as they are. Boxes and free cells are those of the unit's
    detector; elsewhere nothing is background.
    """
    views, ground = road_views(split, poles, True, spins), DatasetGround(split.data)
    samples: dict[str, list[Sample]] = {}
    for pole in poles:
        for i in split.poles.get(pole, ()):
            key = split.data.keys[i]
            if (view := views.get((key.scene, key.index), {}).get(pole)) is None:
                continue
            frame = split.data.frame(i)
            for turn in range(QUARTERS):
                seen = _lower(frame, ground.height_of(i), -config.ground_z_m, turn * np.pi / 2)
                sample = label_sample(seen, Boxes.empty(), [view], config, choose_lidar(seen), ground.relief)
                samples.setdefault(f"{region}/{key.agent}", []).append(sample)
    return samples


def _lower(frame: Frame, height_m: float, eye_m: float, turn_rad: float) -> Frame:
    """Return the sweep of a unit, `height_m` above the ground, from a level LiDAR `eye_m` above it, turned to the left.

    Returns keep their places in the world.
    """
    lidar = choose_lidar(frame)
    x, y = frame.agent_from_sensor[lidar][:2, 3].tolist()
    stands = frame.world_from_agent @ pose(x, y, -height_m, turn_rad)  # on the ground below the LiDAR
    eye = pose(0, 0, eye_m, 0)
    points = move_points(frame.lidar[lidar], inverse(stands @ eye) @ frame.world_from_sensor(lidar))
    calibration = replace(frame.calibration, agent_from_sensor={lidar: eye})
    return replace(
        frame,
        world_from_agent=stands,
        calibration=calibration,
        assumed=calibration,
        lidar={lidar: points},
        agent_at_trigger={},
    )
