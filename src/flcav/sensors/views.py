"""Image annotations of actors: visible pixels, visible and amodal boxes, truncation, occlusion.

Amodal 2-D boxes are the bounding rectangles of actors' projected convex hulls, exact for lenses without distortion.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from flcav.arrays import Array, Ints, Ints32, Mask
from flcav.geometry import inverse, transform_points
from flcav.machine.compiled import compiled
from flcav.sensors.frame import Views
from flcav.sensors.lens import Lens, compute_pixel_rays, project_optical, unproject
from flcav.world.meshes import actor_mesh
from flcav.world.scene import Scene

OUTER_EDGES = np.array((-0.5, -0.5, 0.5, 0.5))  # offsets from the centres of the outermost pixels
SAMPLES = 4096  # approximate limit of sampled pixels per amodal box; larger boxes use every n-th row and column


class Regions(NamedTuple):
    """Pixel counts and bounding boxes of K instances in an image."""

    pixels: Ints  # (K,) number of pixels
    box: Array  # (K, 4) x1 y1 x2 y2 [px], to the pixels' outer edges; NaN where there are none


def find_actor_regions(instance: Ints32, count: int) -> Regions:
    """Return the regions of actors 0 to `count` - 1, which have the values 1 to `count` in the image (H, W)."""
    return _regions(instance, count, 1)


def find_thing_regions(instance: Ints32, count: int) -> Regions:
    """Return the regions of things 0 to `count` - 1, which have the values -1 to -`count` in the image (H, W)."""
    return _regions(instance, count, -1)


def _regions(instance: Ints32, count: int, sign: int) -> Regions:
    pixels = np.zeros(count + 1, np.int64)
    box = np.empty((count + 1, 4))
    box[:, :2], box[:, 2:] = np.inf, -np.inf
    _collect(instance, sign, pixels, box)
    box[pixels == 0] = np.nan
    return Regions(pixels[1:], box[1:] + OUTER_EDGES)


@compiled
def _collect(instance, sign, pixels, box):
    for v in range(instance.shape[0]):
        for u in range(instance.shape[1]):
            number = instance[v, u] * sign
            if number > 0:
                pixels[number] += 1
                box[number, 0] = min(box[number, 0], u)
                box[number, 1] = min(box[number, 1], v)
                box[number, 2] = max(box[number, 2], u)
                box[number, 3] = max(box[number, 3], v)


def view_actors(
    scene: Scene, world_from_camera: Array, lens: Lens, instance: Ints32, regions: Regions, actors: Ints
) -> Views:
    """Return the image annotations of `actors` (M,): 2-D boxes, pixels, truncation and occlusion.

    `instance` (H, W) is a + 1 at the scene's actor a, `regions` are those of all the scene's actors. The scene must be
    at the instant of the image. Occlusion compares the image's pixels with rays cast at the actor in an empty world.
    """
    box = compute_amodal_boxes(scene, world_from_camera, lens, actors)
    occlusion = np.ones(len(actors))
    inside = clip_boxes(box, lens)
    for row in np.flatnonzero(regions.pixels[actors]):  # the occlusion of the others is 1
        actor = int(actors[row])
        sampled = _sampled(inside[row])
        visible = np.count_nonzero(instance[np.ix_(*sampled)] == actor + 1)
        unoccluded = _unoccluded(scene, world_from_camera, lens, actor, sampled)
        if visible and unoccluded:
            occlusion[row] = 1 - min(visible / unoccluded, 1.0)
    return Views(
        amodal_box=box,
        visible_box=regions.box[actors],
        pixels=regions.pixels[actors],
        truncation=compute_truncation(box, lens),
        occlusion=occlusion,
    )


def _sampled(box: Array) -> tuple[Ints, Ints]:
    """Return the rows and columns of the pixels sampled for the occlusion of an actor with the `box` (4,) [px]."""
    x1, y1, x2, y2 = box
    step = max(1, int(np.sqrt((x2 - x1) * (y2 - y1) / SAMPLES)))
    first_column, first_row = int(np.ceil(x1)), int(np.ceil(y1))
    return np.arange(first_row, int(np.floor(y2)) + 1, step), np.arange(first_column, int(np.floor(x2)) + 1, step)


def _unoccluded(scene: Scene, world_from_camera: Array, lens: Lens, actor: int, sampled: tuple[Ints, Ints]) -> int:
    """Return the number of sampled pixels that show the actor in an empty world."""
    rows, columns = sampled
    rays = compute_pixel_rays(lens).reshape(lens.height, lens.width, 3)[np.ix_(rows, columns)].reshape(-1, 3)
    if not len(rays):
        return 0
    body_from_camera = inverse(scene.world_from_actor(actor)) @ world_from_camera
    hits = scene.cast_each(np.array([actor]), body_from_camera[None], np.array([len(rays)]), rays)
    return int(np.count_nonzero(hits.face >= 0))


NEAR_M = 0.1  # depth of the near plane, where actors are clipped
BOX_EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)])
BEYOND_IMAGE = 1.3  # multiple of the image's radius up to which the distortion is extrapolated


class Hull(NamedTuple):
    """The vertices and edges of a mesh's convex hull."""

    vertices: Array  # (V, 3) body frame [m]
    edges: Ints  # (E, 2) indices of vertices


@lru_cache(maxsize=256)
def hull(category: str, shape: int, size: tuple[float, ...] | None = None) -> Hull:
    """Compute the convex hull of an actor's mesh, body frame [m]: see `actor_mesh`."""
    vertices = actor_mesh(category, shape, size).vertices.astype(np.float64)
    convex = ConvexHull(vertices)
    rows = np.searchsorted(convex.vertices, convex.simplices, sorter=(order := np.argsort(convex.vertices)))
    faces = order[rows]
    sides = np.sort(np.concatenate((faces[:, :2], faces[:, 1:], faces[:, ::2])), axis=1)
    return Hull(vertices[convex.vertices], np.unique(sides, axis=0))


def compute_amodal_boxes(
    scene: Scene, world_from_camera: Array, lens: Lens, actors: Ints, near_m: float = NEAR_M
) -> Array:
    """Return the amodal 2-D boxes (M, 4) x1 y1 x2 y2 [px] of `actors` (M,), around their parts beyond the near plane.

    They are not clipped to the image; NaN where they do not touch it. `world_from_camera` (4, 4) [m] is the pose of the
    optical frame, `near_m` the depth of the near plane [m].
    """
    camera_from_world = inverse(world_from_camera)
    boxes = np.full((len(actors), 4), np.nan)
    outlines: dict[int, Array] = {}
    for row in np.flatnonzero(_may_show(scene, camera_from_world, lens, actors)).tolist():
        actor = actors[row]
        model = hull(*scene.trace.model(int(actor)))
        points = transform_points(camera_from_world @ scene.world_from_actor(int(actor)), model.vertices)
        points = points if points[:, 2].min() >= near_m else clip_in_front(points, model.edges, near_m)
        if len(points):
            outlines[row] = points
    if outlines:
        pixels = _project(lens, np.concatenate(list(outlines.values())))
        first = np.cumsum([0, *(len(points) for points in outlines.values())])[:-1]
        lowest, highest = np.minimum.reduceat(pixels, first), np.maximum.reduceat(pixels, first)
        boxes[list(outlines)] = np.concatenate((lowest, highest), axis=1)
    boxes[compute_truncation(boxes, lens) == 1] = np.nan
    return boxes


def clip_boxes(boxes: Array, lens: Lens) -> Array:
    """Return boxes (M, 4) [px] clipped to the image; of zero area where they are outside, NaN where they are NaN."""
    last = (lens.width - 0.5, lens.height - 0.5)
    return np.clip(boxes, -0.5, (*last, *last))


def compute_truncation(boxes: Array, lens: Lens) -> Array:
    """Return (M,) the shares of boxes (M, 4) [px] that are outside the image; 1 where a box is NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        share = _area(clip_boxes(boxes, lens)) / _area(boxes)
    return 1 - np.nan_to_num(share, nan=0.0)


def _area(boxes: Array) -> Array:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def _may_show(scene: Scene, camera_from_world: Array, lens: Lens, actors: Ints) -> Mask:
    """Return (M,) whether the actors' bounding spheres touch the camera's viewing frustum (frustum culling)."""
    trace = scene.trace
    index = scene.index
    size = trace.size[actors]
    drift = abs(scene.offset_s) * np.linalg.norm(np.nan_to_num(trace.velocity[index, actors]), axis=1)
    radius = np.linalg.norm(size, axis=1) / 2 + 2 * drift
    x, y, z = transform_points(camera_from_world, trace.position[index, actors] + size * (0, 0, 0.5)).T
    right, down = np.abs(unproject(lens, _border(lens))).max(axis=0)
    aside = (np.abs(x) - right * z) / np.hypot(1, right)  # distances beyond the planes through the image's edges
    above = (np.abs(y) - down * z) / np.hypot(1, down)
    return (z > -radius) & (aside < radius) & (above < radius)


def _border(lens: Lens) -> Array:
    """Return (36, 2) points u, v [px] on the edges of the image."""
    u, v = np.linspace(0, lens.width - 1, 9), np.linspace(0, lens.height - 1, 9)
    across = [np.column_stack((u, np.full(9, edge))) for edge in (0, lens.height - 1)]
    return np.concatenate((*across, *(np.column_stack((np.full(9, edge), v)) for edge in (0, lens.width - 1))))


def clip_in_front(points: Array, edges: Ints, near_m: float) -> Array:
    """Clip a hull to z >= `near_m` [m]: return its vertices (V, 3) beyond the plane, and its edges' intersections."""
    ahead = points[:, 2] >= near_m
    one, other = (points[end] for end in edges[ahead[edges[:, 0]] != ahead[edges[:, 1]]].T)
    share = (near_m - one[:, 2:]) / (other[:, 2:] - one[:, 2:])
    return np.concatenate((points[ahead], one + share * (other - one)))


def _project(lens: Lens, points: Array) -> Array:
    """Project points (N, 3) in front of the camera to pixels (N, 2).

    Those too far out for the distortion are moved in.
    """
    if lens.distortion().any():
        plane = points[:, :2] / points[:, 2:]
        radius = np.linalg.norm(plane, axis=1, keepdims=True)
        plane = plane * np.minimum(1, BEYOND_IMAGE * _image_radius(lens) / np.maximum(radius, 1e-9))
        points = np.concatenate((plane, np.ones((len(plane), 1))), axis=1)
    return project_optical(lens, points)


def _image_radius(lens: Lens) -> float:
    corners = unproject(lens, [(u, v) for u in (0, lens.width - 1) for v in (0, lens.height - 1)])
    return float(np.linalg.norm(corners, axis=1).max())


def outline_boxes(corners: Array, lens: Lens, world_from_camera: Array) -> tuple[Array, Array]:
    """Return the bounding rectangles (M, 4) x1 y1 x2 y2 [px] of boxes in an image, and their shares (M,) outside it.

    `corners` (M, 8, 3) [m] are the boxes' corners, world frame, in the order of `Boxes.corners`; `world_from_camera`
    (4, 4) [m] is the pose of the optical frame. Rectangles are not clipped; NaN where they do not touch the image.
    """
    amodal = np.full((len(corners), 4), np.nan)
    corners = transform_points(inverse(world_from_camera), corners.reshape(-1, 3)).reshape(-1, 8, 3)
    ahead = (corners[:, :, 2] >= NEAR_M).sum(axis=1)
    whole = ahead == 8
    pixels = project_optical(lens, corners[whole].reshape(-1, 3)).reshape(-1, 8, 2)
    amodal[whole] = np.concatenate((pixels.min(axis=1), pixels.max(axis=1)), axis=1)
    for row in np.flatnonzero((ahead > 0) & ~whole):  # the others are behind the camera
        pixels = project_optical(lens, clip_in_front(corners[row], BOX_EDGES, NEAR_M))
        amodal[row] = *pixels.min(axis=0), *pixels.max(axis=0)
    truncation = compute_truncation(amodal, lens)
    amodal[truncation == 1] = np.nan
    return amodal, truncation
