"""Registration of LiDAR clouds by generalised ICP (small_gicp, extra `fusion`): of sensor suites, and for odometry.

Segal, Haehnel, Thrun, "Generalized-ICP", RSS 2009. The registration of a suite starts with an imperfect calibration. It
uses the static background, since moving traffic would bias it. The first pass accepts correspondences as far apart as
the calibration may be off, the second only near ones.

In odometry each sweep is registered to a map of the earlier sweeps, with a constant-velocity prediction as the initial
guess. The map consists of Gaussian voxels, and registration is voxelised generalised ICP (Koide et al., "Voxelized GICP
for fast and accurate 3D point cloud registration", ICRA 2021). There is no loop closure, so that the drift accumulates
over the drive. Poses are relative to the vehicle's first sweep in a scene.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Array
from flcav.config import InputError, Json
from flcav.dataset.formats.reading import difference_tracks
from flcav.geometry import inverse
from flcav.interface.wording import format_install_command
from flcav.sensors.frame import Frame
from flcav.sources.source import Source

PAIR_M = (3.0, 0.8)  # greatest distance of corresponding points, in each pass
CELL_M = 0.3  # edge of the grid by which clouds are downsampled to a point in each cell


@dataclass(frozen=True)
class Offset:
    """Position and rotation of one pose relative to another."""

    position_cm: float
    rotation_deg: float


def register_clouds(target: NDArray, source: NDArray, target_from_source: Array) -> Array:
    """Return the (4, 4) pose [m] of the cloud `source` in the frame of `target`, by generalised ICP.

    target (N, >= 3) and source (M, >= 3): x, y, z [m], each in its own frame. target_from_source: (4, 4) initial guess,
    from the calibration. Raises `InputError` where small_gicp is not installed, or the clouds have no points in common.
    """
    library = import_small_gicp()
    clouds = [np.ascontiguousarray(cloud[:, :3], dtype=np.float64) for cloud in (target, source)]
    estimate = target_from_source
    for far_m in PAIR_M:
        result = library.align(
            *clouds,
            init_T_target_source=estimate,
            registration_type="GICP",
            downsampling_resolution=CELL_M,
            max_correspondence_distance=far_m,
            num_threads=1,
        )
        if not result.num_inliers:
            raise InputError(f"registration: no points of the two clouds are within {far_m:g} m of each other")
        estimate = np.asarray(result.T_target_source)
    return estimate


def measure_offset(one: Array, other: Array) -> Offset:
    """Return distance and angle between two (4, 4) poses [m] in the same frame."""
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


MAP_CELL_M, VOXEL_M = 0.25, 1.0  # edge of the downsampling grid, and of the map's voxels
NEAREST_M = 2.5  # nearer returns are of the vehicle itself
KEPT_SWEEPS = 100  # voxels without a return in this many sweeps are removed
FEWEST = 200  # least number of points, and of inliers, of a sweep for registration


class Odometry:
    """The odometry of one LiDAR; raises `InputError` where small_gicp is not installed."""

    def __init__(self) -> None:
        self._library = import_small_gicp()
        self._map: Any = self._library.GaussianVoxelMap(VOXEL_M)
        self._map.set_lru(KEPT_SWEEPS)
        self._last = np.eye(4)
        self._motion = np.eye(4)
        self._begun = False

    def step(self, points: NDArray) -> Array:
        """Return the (4, 4) pose [m] of the LiDAR at a sweep (N, >= 3) [m], relative to its pose at the first one.

        A sweep with too few points or inliers has the pose predicted at constant velocity.
        """
        xyz = points[:, :3].astype(np.float64)
        xyz = xyz[np.linalg.norm(xyz, axis=1) > NEAREST_M]
        guess = self._last @ self._motion
        if len(xyz) < FEWEST:
            return self._move(guess)
        cloud, _ = self._library.preprocess_points(xyz, downsampling_resolution=MAP_CELL_M, num_threads=1)
        if not self._begun:
            self._begun = True
            pose = np.eye(4)
        else:
            result = self._library.align(self._map, cloud, init_T_target_source=guess, num_threads=1)
            pose = np.asarray(result.T_target_source) if result.num_inliers >= FEWEST else guess
        self._map.insert(cloud, pose)
        return self._move(pose)

    def _move(self, pose: Array) -> Array:
        # Project the rotation onto SO(3), since rounding errors would accumulate over the sweeps.
        turn, _, back = np.linalg.svd(pose[:3, :3])
        pose = np.vstack((np.column_stack((turn @ back, pose[:3, 3])), (0, 0, 0, 1)))
        self._motion = inverse(self._last) @ pose
        self._last = pose
        return pose


@dataclass(frozen=True)
class DrivenSource:
    """A source whose vehicles' poses are estimated by LiDAR odometry, for logs without poses.

    Every vehicle starts at the world's origin; several in one scene have no common frame.
    """

    source: Source

    def describe(self) -> dict[str, Json]:
        """Return the description of the source, and that poses are estimated."""
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
        """Yield the frames of a scene with estimated poses, and velocities of tracks where the source knows none.

        The source is read twice, since velocities are differences of neighbouring labels in the world of those poses.
        Raises `InputError` where a frame has no LiDAR sweep.
        """
        odometry_of: dict[str, Odometry] = {}
        poses, tracks = list[Array](), list[tuple[list[str], float, Array]]()
        for frame in self.source.frames(scene):
            if not frame.lidar:
                raise InputError(f"{frame.key}: no LiDAR sweep, which poses are estimated from")
            name = next(iter(frame.lidar))
            odometry = odometry_of.setdefault(frame.agent, Odometry())
            mount = frame.agent_from_sensor[name]
            poses.append(mount @ odometry.step(frame.lidar[name]) @ inverse(mount))
            known = move_frame(frame, poses[-1]).annotations
            named = [f"{frame.agent}/{track}" for track in known.track.tolist()]  # each agent has a world of its own
            tracks.append((named, frame.time_s, known.boxes.center))
        counts = [len(named) for named, _, _ in tracks]
        moving = difference_tracks(
            np.array([track for named, _, _ in tracks for track in named], np.str_),
            np.repeat([time_s for _, time_s, _ in tracks], counts),
            np.concatenate([np.zeros((0, 3)), *(center for _, _, center in tracks)]),
        )
        velocities = np.split(moving, np.cumsum(counts)[:-1])
        for frame, pose, velocity in zip(self.source.frames(scene), poses, velocities, strict=True):
            moved = move_frame(frame, pose)
            known = moved.annotations
            filled = np.where(np.isnan(known.velocity), velocity, known.velocity)
            yield replace(moved, annotations=replace(known, velocity=filled))


def move_frame(frame: Frame, world_from_agent: Array) -> Frame:
    """Return the frame with the vehicle at another (4, 4) pose [m], and its annotations and triggers moved with it."""
    moved = world_from_agent @ inverse(frame.world_from_agent)
    known = frame.annotations
    velocity, acceleration = (values @ moved[:3, :3].T for values in (known.velocity, known.acceleration))
    annotations = replace(known, boxes=known.boxes.transform(moved), velocity=velocity, acceleration=acceleration)
    triggers = {name: moved @ pose for name, pose in frame.agent_at_trigger.items()}
    return replace(frame, world_from_agent=world_from_agent, annotations=annotations, agent_at_trigger=triggers)
