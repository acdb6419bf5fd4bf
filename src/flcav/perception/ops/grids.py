"""Point clouds on grids: voxels with the mean of their points, and pillars with statistics of their points.

Voxels are those of SECOND's published configuration (mean VFE). The grid of pillars is that of Lang et al.,
"PointPillars: Fast Encoders for Object Detection from Point Clouds", CVPR 2019; statistics replace its learned encoder:
they cost one pass over the points, and the highest point of a pillar is the height of an object.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from flcav.perception.ops.rulebook import Triple, encode_cells

BINS_M = (0.3, 0.7, 1.1, 1.5, 1.9, 2.4)  # heights above the ground at which bins of occupancy begin
STATISTICS = 7 + len(BINS_M)  # channels of the map
EXTREMES = ("amax", "amin")


def pillar_statistics(
    points: Tensor, sample: Tensor, samples: int, range_m: Sequence[float], pillar_m: Sequence[float], ground_z_m: float
) -> Tensor:
    """Return the map (samples, STATISTICS, rows along y, columns along x) of a batch of point clouds.

    Channels: half the logarithm of one plus the number of points; highest, lowest and mean height above the ground [m];
    mean intensity; mean position in the pillar along x and y, in [-1/2, 1/2]; whether a bin of heights has a point. All
    are 0 in a pillar without points.

    Args:
        points: (N, 4) x, y, z [m], intensity; those outside the range are left out.
        sample: (N,) number of each point's cloud.
        samples: number of clouds.
        range_m: minima x, y, z, then maxima [m], in the LiDAR's frame.
        pillar_m: size of a pillar along x and along y [m].
        ground_z_m: height of the ground [m].
    """
    kept, key, offset, (rows, columns) = _pillars_of(points, sample, range_m, pillar_m)
    height = points[kept, 2] - ground_z_m
    cells = samples * rows * columns
    count = torch.bincount(key, minlength=cells).to(points.dtype)
    whole = torch.column_stack((height, points[kept, 3], offset))
    mean = whole.new_zeros(cells, 4).index_add_(0, key, whole) / count.clamp(min=1)[:, None]
    extremes = [whole.new_zeros(cells).scatter_reduce_(0, key, height, how, include_self=False) for how in EXTREMES]
    bins = whole.new_zeros(len(BINS_M), cells)
    for number, (low_m, high_m) in enumerate(zip(BINS_M, (*BINS_M[1:], torch.inf), strict=True)):
        bins[number, key[(height >= low_m) & (height < high_m)]] = 1
    channels = torch.cat((torch.log1p(count)[None] / 2, torch.stack(extremes), mean.T, bins))
    return channels.view(STATISTICS, samples, rows, columns).transpose(0, 1)


def pillar_means(
    points: Tensor, values: Tensor, sample: Tensor, samples: int, range_m: Sequence[float], pillar_m: Sequence[float]
) -> Tensor:
    """Return the map (samples, 1 + V, rows along y, columns along x) of values of points.

    Channels: half the logarithm of one plus the number of points, and the means of the values (N, V); all are 0 in a
    pillar without points. Arguments are those of `pillar_statistics`; only the first three columns of points count.
    """
    kept, key, _, (rows, columns) = _pillars_of(points, sample, range_m, pillar_m)
    cells = samples * rows * columns
    count = torch.bincount(key, minlength=cells).to(points.dtype)
    total = values.new_zeros(cells, values.shape[1]).index_add_(0, key, values[kept])
    channels = torch.cat((torch.log1p(count)[None] / 2, (total / count.clamp(min=1)[:, None]).T))
    return channels.view(len(channels), samples, rows, columns).transpose(0, 1)


def _pillars_of(
    points: Tensor, sample: Tensor, range_m: Sequence[float], pillar_m: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor, tuple[int, int]]:
    """Return which points are in range (K,), their pillars' keys (K,) and their offsets (K, 2) from its centre.

    Offsets are in [-1/2, 1/2]; the last are the rows and columns of the grid.
    """
    low, size = points.new_tensor(range_m[:2]), points.new_tensor(pillar_m[:2])
    columns, rows = (round((range_m[i + 3] - range_m[i]) / pillar_m[i]) for i in range(2))
    place = (points[:, :2] - low) / size
    cell = torch.floor(place)
    inside = ((cell >= 0) & (cell < points.new_tensor((columns, rows)))).all(1)
    inside &= (points[:, 2] >= range_m[2]) & (points[:, 2] < range_m[5])
    kept = inside.nonzero()[:, 0]
    cell = cell[kept]
    x, y = cell.long().unbind(1)
    return kept, (sample[kept] * rows + y) * columns + x, place[kept] - cell - 0.5, (rows, columns)


def grid_shape(range_m: Sequence[float], voxel_m: Sequence[float]) -> Triple:
    """Return the extents z, y, x of a voxel grid.

    `range_m` holds the minima x, y, z, then the maxima [m], LiDAR frame; `voxel_m` the sizes along x, y, z [m]. One
    empty layer is added on top, as in the published network, so that its strides divide the height.
    """
    nx, ny, nz = (round((range_m[i + 3] - range_m[i]) / voxel_m[i]) for i in range(3))
    return nz + 1, ny, nx


def voxelize(
    points: Tensor, sample: Tensor, range_m: Sequence[float], voxel_m: Sequence[float], shape: Triple
) -> tuple[Tensor, Tensor]:
    """Return the mean features (V, C) and the ascending keys (V,) of the occupied voxels of a batch of point clouds.

    `points` is (N, C), with x, y, z [m] first; `sample` (N,) is the number of each point's cloud; for `range_m`,
    `voxel_m` and `shape` see `grid_shape`. Points outside the range are left out.
    """
    low, size = points.new_tensor(range_m[:3]), points.new_tensor(voxel_m)
    cell = torch.floor((points[:, :3] - low) / size)
    inside = ((cell >= 0) & (cell < points.new_tensor((shape[2], shape[1], shape[0] - 1)))).all(1)
    kept = inside.nonzero()[:, 0]
    x, y, z = cell[kept].long().unbind(1)
    keys, order = encode_cells(torch.stack((sample[kept], z, y, x), 1), shape).sort(stable=True)
    keys, count = torch.unique_consecutive(keys, return_counts=True)
    rows = points[kept[order]]  # may be empty, for which the checks of `unsafe=False` raise
    means = torch.segment_reduce(rows, "mean", lengths=count, axis=0, unsafe=True)
    return means, keys
