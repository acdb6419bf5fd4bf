"""Voxelisation of point clouds: the mean of the points in each voxel (mean VFE of SECOND's published configuration)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from flcav.perception.ops.rulebook import Triple, encode_cells


def grid_shape(range_m: Sequence[float], voxel_m: Sequence[float]) -> Triple:
    """Return the extents z, y, x of a voxel grid.

    range_m: minima x, y, z, then maxima [m], LiDAR frame; voxel_m: sizes along x, y, z [m]. One empty layer is added on
    top, as in the published network, so that its strides divide the height.
    """
    nx, ny, nz = (round((range_m[i + 3] - range_m[i]) / voxel_m[i]) for i in range(3))
    return nz + 1, ny, nx


def voxelize(
    points: Tensor, sample: Tensor, range_m: Sequence[float], voxel_m: Sequence[float], shape: Triple
) -> tuple[Tensor, Tensor]:
    """Return the mean features (V, C) and the ascending keys (V,) of the occupied voxels of a batch of point clouds.

    points (N, C), x, y, z first [m]; sample (N,) number of each point's cloud; range_m, voxel_m and shape: see
    `grid_shape`. Points outside the range are left out.
    """
    low, size = points.new_tensor(range_m[:3]), points.new_tensor(voxel_m)
    cell = torch.floor((points[:, :3] - low) / size)
    inside = ((cell >= 0) & (cell < points.new_tensor((shape[2], shape[1], shape[0] - 1)))).all(1)
    kept = inside.nonzero()[:, 0]
    x, y, z = cell[kept].long().unbind(1)
    keys, order = encode_cells(torch.stack((sample[kept], z, y, x), 1), shape).sort(stable=True)
    keys, count = torch.unique_consecutive(keys, return_counts=True)
    means = torch.segment_reduce(
        points[kept[order]], "mean", lengths=count, axis=0, unsafe=True
    )  # unchecked: may be empty
    return means, keys
