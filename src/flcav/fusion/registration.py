"""Registration of LiDAR clouds by generalised ICP (small_gicp, extra `fusion`): of suites, and of sweeps to odometry.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009. Suites begin from an imperfect calibration. Streets stand still and
traffic does not, so that the static background is registered. The first pass takes pairs as far apart as the
calibration may be off, the second near ones.

In odometry each sweep is registered to a map of the sweeps before it, from where the last motion leads. The map is one
of Gaussian voxels, and registration voxelised generalised ICP (Koide et al., "Voxelized GICP for fast and accurate 3D
point cloud registration", ICRA 2021). There are no loop closures: errors add up over the drive. Poses are relative to
the vehicle's first sweep in a scene.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array
from flcav.config import InputError, Json
from flcav.geometry import inverse
from flcav.interface.wording import format_install_command
from flcav.sensors.frame import Frame
from flcav.sources.source import Source

PAIR_M = (3.0, 0.8)  # farthest pair of points, in each pass
CELL_M = 0.3  # clouds are thinned to a point in each cell of this edge


@dataclass(frozen=True)
class Offset:
    """The distance between two poses."""

    position_cm: float
    rotation_deg: float


def register_clouds(target: NDArray, source: NDArray, target_from_source: Array) -> Array:
    """Return the (4, 4) pose of the cloud `source` in the frame of `target`, by generalised ICP.

    target (N, >= 3) and source (M, >= 3): x, y, z [m], each in its own frame. target_from_source: where to start, by
    calibration. Raises `InputError` where small_gicp is not installed, or the clouds have no points in common.
    """
    library = import_small_gicp()
    clouds = [np.ascontiguousarray(cloud[:, :3], dtype=np.float64) for cloud in (target, source)]
    found = target_from_source
    for far_m in PAIR_M:
        result = library.align(
            *clouds,
            init_T_target_source=found,
            registration_type="GICP",
            downsampling_resolution=CELL_M,
            max_correspondence_distance=far_m,
            num_threads=1,
        )
        if not result.num_inliers:
            raise InputError(f"registration: no points of the two clouds are within {far_m:g} m of each other")
        found = np.asarray(result.T_target_source)
    return found


def measure_offset(one: Array, other: Array) -> Offset:
    """Return distance and angle between two (4, 4) poses in the same frame."""
    between = np.linalg.inv(one) @ other
    angle = np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))
    return Offset(100 * float(np.linalg.norm(between[:3, 3])), float(np.degrees(angle)))


def import_small_gicp() -> Any:
    """Return the library small_gicp; raises `InputError` where it is not installed."""
    try:
        import small_gicp
    except ImportError:
        raise InputError(f"registration needs small_gicp, which is in: {format_install_command('fusion')}") from None
    return small_gicp


MAP_CELL_M, VOXEL_M = 0.25, 1.0  # clouds are thinned to a point in each cell; edge of the map's voxels
NEAREST_M = 2.5  # returns within this are of the vehicle itself
KEPT_SWEEPS = 100  # voxels that no sweep met for so long are forgotten
FEWEST = 200  # points of a sweep that can be registered


class Odometry:
    """The odometry of one LiDAR; raises `InputError` where small_gicp is not installed."""

    def __init__(self) -> None:
        self._library = import_small_gicp()
        self._map: Any = self._library.GaussianVoxelMap(VOXEL_M)
        self._map.set_lru(KEPT_SWEEPS)
        self._last, self._motion = np.eye(4), np.eye(4)
        self._begun = False

    def step(self, points: NDArray) -> Array:
        """Return the (4, 4) pose of the LiDAR at a sweep (N, >= 3), in its frame at the first one.

        A sweep of too few points, or that fits nowhere, takes the pose to which the last motion leads.
        """
        xyz = points[:, :3].astype(np.float64)
        xyz = xyz[np.linalg.norm(xyz, axis=1) > NEAREST_M]
        guess = self._last @ self._motion
        if len(xyz) < FEWEST:
            return self._move(guess)
        cloud, _ = self._library.preprocess_points(xyz, downsampling_resolution=MAP_CELL_M, num_threads=1)
        if not self._begun:
            self._begun, pose = True, np.eye(4)
        else:
            found = self._library.align(self._map, cloud, init_T_target_source=guess, num_threads=1)
            pose = np.asarray(found.T_target_source) if found.num_inliers >= FEWEST else guess
        self._map.insert(cloud, pose)
        return self._move(pose)

    def _move(self, pose: Array) -> Array:
        turn, _, back = np.linalg.svd(pose[:3, :3])  # to the nearest rotation, or its error would grow with each sweep
        pose = np.vstack((np.column_stack((turn @ back, pose[:3, 3])), (0, 0, 0, 1)))
        self._motion, self._last = inverse(self._last) @ pose, pose
        return pose


@dataclass(frozen=True)
class DrivenSource:
    """A source whose vehicles' poses are those of LiDAR odometry, for logs that have none.

    Each vehicle starts at the world's origin; several in one scene are not placed among one another.
    """

    source: Source

    def describe(self) -> dict[str, Json]:
        """Return what the source describes, and that poses are estimated."""
        return {**self.source.describe(), "poses": "estimated"}

    def scenes(self) -> Sequence[str]:
        """Return the names of the scenes."""
        return self.source.scenes()

    def frame_count(self, scene: str) -> int:
        """Return the number of frames of a scene."""
        return self.source.frame_count(scene)

    def trace(self, scene: str) -> None:
        """Return None: traffic is not known in a world of estimated poses."""
        return

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the frames of a scene with estimated poses; raises `InputError` where a frame has no LiDAR sweep."""
        ways: dict[str, Odometry] = {}
        for frame in self.source.frames(scene):
            if not frame.lidar:
                raise InputError(f"{frame.key}: no LiDAR sweep, which poses are estimated from")
            name = next(iter(frame.lidar))
            way = ways.setdefault(frame.agent, Odometry())
            mount = frame.agent_from_sensor[name]
            yield move_frame(frame, mount @ way.step(frame.lidar[name]) @ inverse(mount))


def move_frame(frame: Frame, world_from_agent: Array) -> Frame:
    """Return the frame with the vehicle at another (4, 4) pose, and all that it saw with it."""
    moved = world_from_agent @ inverse(frame.world_from_agent)
    seen = frame.annotations
    velocity, acceleration = (values @ moved[:3, :3].T for values in (seen.velocity, seen.acceleration))
    annotations = replace(seen, boxes=seen.boxes.transform(moved), velocity=velocity, acceleration=acceleration)
    triggers = {name: moved @ pose for name, pose in frame.agent_at_trigger.items()}
    return replace(frame, world_from_agent=world_from_agent, annotations=annotations, agent_at_trigger=triggers)
