"""Samples of roadside units that join a group: their sweeps, labelled by their trained detector."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from flcav.dataset.ground import DatasetGround
from flcav.fusion.labels import label_sample
from flcav.fusion.road import build_road_view, road_detector
from flcav.geometry import Boxes
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import choose_lidar
from flcav.runs.frames import Frames
from flcav.runs.labels.pseudo_labels import Spin
from flcav.sensors.frame import Frame


def label_roadside(
    split: Frames, poles: Sequence[int], spins: Collection[Spin], config: SecondConfig, region: str
) -> dict[str, list[Sample]]:
    """Return the samples of the units on `poles` in `spins`, by "region/pole": see `flcav.fusion.labels.label_sample`.

    The targets are the boxes of the unit's detector; free ground and other returns in its view are background.
    """
    ground = DatasetGround(split.data)
    samples = dict[str, list[Sample]]()
    find = road_detector(split.data) if poles else None
    for pole in poles:
        for i in split.poles.get(pole, ()):
            key = split.data.keys[i]
            if find is None or (key.scene, key.index) not in spins:
                continue
            frame = split.data.frame(i)
            below = ground.below(i)
            lidar = choose_lidar(frame)
            view = build_road_view(frame, find(i), lidar, ground.relief, below)
            seen = lower_sweep(frame, lidar, below, config)
            sample = label_sample(seen, Boxes.empty(), [view], config, lidar, ground.relief)
            samples.setdefault(f"{region}/pole{pole}", []).append(sample)
    return samples


def lower_sweep(frame: Frame, lidar: str, ground_m: float, config: SecondConfig) -> Frame:
    """Return a roadside frame as if its LiDAR were as high above the ground as those of the network's training.

    `ground_m`: height of the ground below the sensor, world frame [m].
    """
    height = -config.ground_z_m
    mount = np.array(frame.agent_from_sensor[lidar])
    above_m = float(frame.world_from_sensor(lidar)[2, 3]) - ground_m
    points = frame.lidar[lidar].copy()
    points[:, 2] += above_m - height
    # The mount is lowered, and points are raised by as much in the LiDAR frame, so that they stay where they are in the
    # world; the agent's origin moves to the ground.
    pose = np.array(frame.world_from_agent)
    pose[2, 3], mount[2, 3] = ground_m, height
    moved = replace(frame.calibration, agent_from_sensor={**frame.agent_from_sensor, lidar: mount})
    return replace(frame, world_from_agent=pose, calibration=moved, lidar={**frame.lidar, lidar: points})
