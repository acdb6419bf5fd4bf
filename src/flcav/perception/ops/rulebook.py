"""Rulebooks of submanifold and strided sparse 3D convolutions: pairs of input and output voxels per kernel offset.

A voxel of sample b at grid cell (z, y, x) has the integer key ((b D + z + 1) H + y + 1) W + x + 1, where D, H, W are
the extents of the grid plus two. The padding of one cell on every side keeps a neighbour's key from wrapping to another
row, so a kernel offset is one difference of keys. Keys are sorted (ascending), so a neighbour is found by binary
search. Source: Graham et al., "3D Semantic Segmentation with Submanifold Sparse Convolutional Networks", CVPR 2018.

There are two implementations with the same result. On a CPU a compiled one merges the sorted keys with themselves,
shifted, in one pass per offset, about ten times faster than tensor operations. On a GPU tensor operations do it; the
host waits once per rulebook, for the number of pairs of every offset and of outputs together.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from flcav.arrays import Ints, Ints32
from flcav.machine.compiled import compiled

Triple = tuple[int, int, int]


@compiled
def find_submanifold_pairs(keys: Ints, steps: Ints) -> tuple[Ints32, Ints32, Ints]:
    """Return the pairs of a 3x3x3 submanifold convolution: source (P,), target (P,), number of pairs per offset (27,).

    `keys` (N,) ascend; `steps` (13,) are key differences of the offsets after the centre, z-major. Pairs are grouped by
    offset; within an offset, targets ascend.
    """
    count, half = len(keys), len(steps)
    later = np.empty((half, count), dtype=np.int32)  # the neighbour at each later offset, -1 for none
    per_offset = np.zeros(2 * half + 1, dtype=np.int64)
    for k in range(half):
        place = 0
        found = 0
        for row in range(count):
            wanted = keys[row] + steps[k]
            while place < count and keys[place] < wanted:
                place += 1
            if place < count and keys[place] == wanted:
                later[k, row] = place
                found += 1
            else:
                later[k, row] = -1
        per_offset[half + 1 + k] = found
        per_offset[half - 1 - k] = found
    per_offset[half] = count
    pairs = per_offset.sum()
    source, target = np.empty(pairs, dtype=np.int32), np.empty(pairs, dtype=np.int32)
    pair = 0
    for offset in range(2 * half + 1):
        for row in range(count):
            if offset == half:
                other = row
            elif offset > half:
                other = later[offset - half - 1, row]
            else:
                other = later[half - 1 - offset, row]
            if other >= 0:
                source[pair] = row if offset < half else other
                target[pair] = other if offset < half else row
                pair += 1
    return source, target, per_offset


@compiled
def find_strided_pairs(
    keys: Ints, samples: int, shape: Ints, kernel: Ints, stride: Ints, padding: Ints, out_shape: Ints
) -> tuple[Ints32, Ints32, Ints, Ints]:
    """Return the pairs of a strided convolution: source (P,), target (P,), number per offset (K,), output keys (M,).

    `keys` (N,) and output keys ascend. `shape`, `kernel`, `stride`, `padding` and `out_shape` are (3,) along z, y, x.
    Pairs are grouped by offset, z-major; within an offset, targets ascend.
    """
    height, width = shape[1] + 2, shape[2] + 2
    layers = shape[0] + 2
    out_height, out_width = out_shape[1] + 2, out_shape[2] + 2
    out_layers = out_shape[0] + 2
    offsets = kernel[0] * kernel[1] * kernel[2]
    reached = np.full((offsets, len(keys)), -1, dtype=np.int64)
    occupied = np.zeros(samples * out_layers * out_height * out_width, dtype=np.bool_)
    per_offset = np.zeros(offsets, dtype=np.int64)
    for row in range(len(keys)):
        rest, x = divmod(keys[row], width)
        rest, y = divmod(rest, height)
        sample, z = divmod(rest, layers)
        z, y, x = z - 1 + padding[0], y - 1 + padding[1], x - 1 + padding[2]
        for kz in range(kernel[0]):
            oz = (z - kz) // stride[0]
            if z < kz or oz * stride[0] != z - kz or oz >= out_shape[0]:
                continue
            for ky in range(kernel[1]):
                oy = (y - ky) // stride[1]
                if y < ky or oy * stride[1] != y - ky or oy >= out_shape[1]:
                    continue
                line = ((sample * out_layers + oz + 1) * out_height + oy + 1) * out_width + 1
                for kx in range(kernel[2]):
                    ox = (x - kx) // stride[2]
                    if x < kx or ox * stride[2] != x - kx or ox >= out_shape[2]:
                        continue
                    offset = (kz * kernel[1] + ky) * kernel[2] + kx
                    reached[offset, row] = line + ox
                    occupied[line + ox] = True
                    per_offset[offset] += 1
    out_keys = np.flatnonzero(occupied)
    number = np.empty(len(occupied), dtype=np.int32)
    for index in range(len(out_keys)):
        number[out_keys[index]] = index
    pairs = per_offset.sum()
    source, target = np.empty(pairs, dtype=np.int32), np.empty(pairs, dtype=np.int32)
    pair = 0
    for offset in range(offsets):
        for row in range(len(keys)):
            key = reached[offset, row]
            if key >= 0:
                source[pair], target[pair] = row, number[key]
                pair += 1
    return source, target, per_offset, out_keys


@dataclass(frozen=True)
class Groups:
    """Pairs of a rulebook grouped by a row of input or output, as offsets into one list (compressed sparse rows)."""

    order: Tensor  # (P,) int32 numbers of the pairs, those of row 0 first
    begins: Tensor  # (rows,) int32 place in `order` where the pairs of each row begin


@dataclass(frozen=True)
class Rulebook:
    """Rulebook of a sparse convolution: P pairs (input voxel, output voxel), grouped by kernel offset.

    Within an offset, targets ascend.
    """

    source: Tensor  # (P,) int32 row of the input
    target: Tensor  # (P,) int32 row of the output
    counts: tuple[int, ...]  # pairs per kernel offset, z-major
    targets: int  # rows of the output
    by_target: Groups | None = None  # None on a CPU, where products are added pair by pair
    by_source: Groups | None = None  # None, too, where offset k has the pairs of offset K-1-k with exchanged roles


def _compiled(keys: Tensor) -> bool:
    return keys.device.type == "cpu"


def _group_pairs(row: Tensor, offset: Tensor, offsets: int, rows: int) -> Groups:
    # row (P,): of each pair, in [0, rows); offset (P,): its kernel offset, in [0, offsets)
    number = torch.arange(len(row), device=row.device, dtype=torch.int32)
    table = torch.full((rows * offsets,), -1, device=row.device, dtype=torch.int32)
    table[row.long() * offsets + offset] = number  # a row has at most one pair per offset
    used = table >= 0
    per_row = used.view(rows, offsets).sum(1, dtype=torch.int32)
    return Groups(table[_places(used, len(row))], per_row.cumsum(0, dtype=torch.int32) - per_row)


def _places(mask: Tensor, count: int) -> Tensor:
    """Return the ascending indices (count,) where a flat mask is True: `nonzero` without waiting for the GPU."""
    rank = mask.cumsum(0, dtype=torch.int32)
    return torch.searchsorted(rank, torch.arange(1, count + 1, device=mask.device, dtype=torch.int32))


def encode_cells(cells: Tensor, shape: Triple) -> Tensor:
    """Return the integer keys (N,) of cells (N, 4), rows sample, z, y, x, of a grid of extents `shape` (z, y, x)."""
    depth, height, width = (extent + 2 for extent in shape)
    sample, z, y, x = cells.unbind(1)
    return ((sample * depth + z + 1) * height + y + 1) * width + x + 1


def decode_keys(keys: Tensor, shape: Triple) -> Tensor:
    """Return the cells (N, 4), rows sample, z, y, x, of keys (N,): the inverse of `encode_cells`."""
    depth, height, width = (extent + 2 for extent in shape)
    row = keys.div(width, rounding_mode="floor")
    layer = row.div(height, rounding_mode="floor")
    sample = layer.div(depth, rounding_mode="floor")
    return torch.stack((sample, layer - sample * depth - 1, row - layer * height - 1, keys - row * width - 1), 1)


def build_submanifold_rulebook(keys: Tensor, shape: Triple) -> Rulebook:
    """Return the rulebook of a 3x3x3 submanifold convolution, whose output voxels are its input voxels.

    keys (N,): ascending; shape: extents z, y, x of the grid. Only the 13 offsets after the centre are searched: the
    others have the same pairs with exchanged roles. On a GPU three offsets that differ in x alone share one search,
    because their keys are consecutive.
    """
    _, height, width = (extent + 2 for extent in shape)
    if _compiled(keys):
        steps = [(z * height + y) * width + x for z, y, x in product((-1, 0, 1), repeat=3)]
        source, target, counts = find_submanifold_pairs(keys.numpy(), np.array(steps[14:]))
        return Rulebook(torch.from_numpy(source), torch.from_numpy(target), tuple(counts.tolist()), len(keys))
    return _build_submanifold_rulebook(keys, height, width)


def _build_submanifold_rulebook(keys: Tensor, height: int, width: int) -> Rulebook:
    count = len(keys)
    later = torch.cat((keys, keys.new_full((3,), -1)))  # padded: a look-up of up to 3 rows past the end finds no key
    lines = (width, (height - 1) * width, height * width, (height + 1) * width)
    wanted = torch.stack([keys + (line - 1) for line in lines])  # (4, N): the first of three consecutive keys
    place = torch.searchsorted(keys, wanted)
    found = [later[1 : count + 1] == keys + 1]
    where = [torch.arange(1, count + 1, device=keys.device)]
    for line in range(4):
        at = place[line]
        for step in range(3):
            hit = later[at] == wanted[line] + step
            found.append(hit)
            where.append(at)
            at = at + hit
    hits = torch.stack(found)  # (13, N): whether voxel n has a neighbour at the offset
    per_offset = hits.sum(1)
    counts = per_offset.tolist()
    flat = _places(hits.flatten(), sum(counts))
    near, far = flat % max(count, 1), torch.stack(where).flatten()[flat]
    itself = torch.arange(count, device=keys.device)
    near_parts, far_parts = near.split(counts)[::-1], far.split(counts)[::-1]
    source = torch.cat((*near_parts, itself, far)).int()
    target = torch.cat((*far_parts, itself, near)).int()
    per_offset = torch.cat((per_offset.flip(0), per_offset.new_full((1,), count), per_offset))
    offset = torch.repeat_interleave(per_offset, output_size=len(source))
    counts = (*counts[::-1], count, *counts)
    return Rulebook(source, target, counts, count, _group_pairs(target, offset, len(counts), count))


def build_strided_rulebook(
    keys: Tensor, shape: Triple, kernel: Triple, stride: Triple, padding: Triple, samples: int
) -> tuple[Rulebook, Tensor, Triple]:
    """Return the rulebook of a strided sparse convolution, its output keys (M,), sorted, and its output grid (z, y, x).

    keys (N,) of `samples` grids of extents `shape`; shape, kernel, stride, padding: z, y, x. Output voxels are the
    cells with an input voxel in their window. Axes are independent: input cell c contributes to output cell
    (c + padding - k) / stride by kernel index k, where that is a whole number inside the grid.
    """
    depth, height, width = ((n + 2 * p - k) // s + 1 for n, k, s, p in zip(shape, kernel, stride, padding, strict=True))
    out_shape = (depth, height, width)
    if _compiled(keys):
        triples = (np.array(triple) for triple in (shape, kernel, stride, padding, out_shape))
        source, target, counts, out_keys = find_strided_pairs(keys.numpy(), samples, *triples)
        rules = Rulebook(torch.from_numpy(source), torch.from_numpy(target), tuple(counts.tolist()), len(out_keys))
        return rules, torch.from_numpy(out_keys), out_shape
    rules, out_keys = _build_strided_rulebook(keys, shape, kernel, stride, padding, out_shape, samples)
    return rules, out_keys, out_shape


def _build_strided_rulebook(
    keys: Tensor, shape: Triple, kernel: Triple, stride: Triple, padding: Triple, out_shape: Triple, samples: int
) -> tuple[Rulebook, Tensor]:
    depth, height, width = (extent + 2 for extent in out_shape)
    cells = decode_keys(keys, shape)
    reached = cells[:, 0] * (depth * height * width)  # becomes (kz, ky, kx, N): key of the output voxel
    valid = torch.ones_like(reached, dtype=torch.bool)  # whether there is such a voxel
    for axis, key_step in zip((2, 1, 0), (1, width, height * width), strict=True):
        shifted = cells[:, axis + 1] + padding[axis]
        place = [(shifted - k).div(stride[axis], rounding_mode="floor") for k in range(kernel[axis])]
        whole = [p * stride[axis] == shifted - k for k, p in enumerate(place)]
        along = torch.stack([(p + 1) * key_step for p in place])
        inside = torch.stack([w & (p >= 0) & (p < out_shape[axis]) for w, p in zip(whole, place, strict=True)])
        wider = (len(place), *[1] * (reached.dim() - 1), len(keys))
        reached, valid = reached + along.view(wider), valid & inside.view(wider)
    offsets = kernel[0] * kernel[1] * kernel[2]
    reached, valid = reached.flatten(), valid.flatten()
    size = samples * depth * height * width
    occupied = torch.zeros(size + 1, dtype=torch.bool, device=keys.device)
    occupied = occupied.index_fill_(0, torch.where(valid, reached, size), True)[:size]  # entry `size`: invalid ones
    number = occupied.cumsum(0, dtype=torch.int32)
    per_offset = valid.view(offsets, -1).sum(1)
    *counts, targets = torch.cat((per_offset, number[-1:])).tolist()
    flat = _places(valid, sum(counts))
    source = (flat % max(len(keys), 1)).int()
    target = number[reached[flat]] - 1
    offset = torch.repeat_interleave(per_offset, output_size=len(source))
    by_target, by_source = (
        _group_pairs(row, offset, offsets, rows) for row, rows in ((target, targets), (source, len(keys)))
    )
    return Rulebook(source, target, tuple(counts), targets, by_target, by_source), _places(occupied, targets)
