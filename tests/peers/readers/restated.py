"""What peers have compiled, in NumPy, and how to put it in its place."""

import sys
from types import ModuleType

import numpy as np


def module(name: str, **content: object) -> None:
    """Let `import name` find a module of this content."""
    sys.modules[name] = ModuleType(name)
    vars(sys.modules[name]).update(content)


class VoxelGenerator:
    """spconv 1's: the first `max_num_points` points of each of the first `max_voxels` voxels."""

    def __init__(self, voxel_size, point_cloud_range, max_num_points, max_voxels):
        self.size, self.low = np.array(voxel_size), np.array(point_cloud_range[:3])
        self.cells = np.round((np.array(point_cloud_range[3:]) - self.low) / self.size).astype(int)
        self.max_num_points, self.max_voxels = max_num_points, max_voxels

    def generate(self, points):
        cell = np.floor((points[:, :3] - self.low) / self.size).astype(int)
        points = points[((cell >= 0) & (cell < self.cells)).all(axis=1)]
        cell = np.floor((points[:, :3] - self.low) / self.size).astype(int)
        _, first, voxel = np.unique(cell, axis=0, return_index=True, return_inverse=True)
        rank = np.empty(len(first), int)
        rank[np.argsort(first)] = np.arange(len(first))
        voxel = rank[voxel.ravel()]
        count = min(len(first), self.max_voxels)
        voxels = np.zeros((count, self.max_num_points, points.shape[1]), np.float32)
        held = np.zeros(count, np.int32)
        for point, i in zip(points, voxel):
            if i < count and held[i] < self.max_num_points:
                voxels[i, held[i]] = point
                held[i] += 1
        return voxels, cell[np.sort(first)[:count]][:, ::-1].astype(np.int32), held
