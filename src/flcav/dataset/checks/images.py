"""Checks of images and their 2D annotations; each check yields one sentence per problem."""

from collections.abc import Iterator

import numpy as np

from flcav.config import parse_config
from flcav.geometry import Boxes, points_in_boxes, transform_points
from flcav.sensors.frame import Array, CameraImage, Frame, SignViews, Views
from flcav.sensors.ground_truth import STATES
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.views import find_actor_regions

MARGIN_M = 0.3  # distance by which a pixel may lie outside its actor's 3D box: wing mirrors, turning since the spin
MARGIN_PX = 3.0  # distance by which a pixel may lie outside its actor's amodal box
INSIDE = 0.95  # share of an actor's sampled pixels that must lie in its enlarged box
JUDGED = 40  # pixels sampled of each actor; actors with fewer are skipped
SIGN_STATES = {"", "off", *STATES.values()}


def check_images(frame: Frame, *, imported: bool = False) -> Iterator[str]:
    """Check every image of a frame and its annotations of actors, signs and lights.

    Images of an imported dataset have no depths, classes and instances to be checked against.
    """
    for name in (*frame.images, *frame.infrared):
        yield from check_views(frame.key, name, frame.annotations.views[name], imported=imported)
        yield from check_signs(frame.key, name, frame.annotations.signs[name])
    for name, image in () if imported else frame.images.items():
        yield from check_planes(frame.key, name, image, len(frame.annotations))
        if not _fit(image):
            continue
        lens = _lens(frame, name, image)
        yield from check_visibility(frame, name, image)
        yield from check_projection(frame, name, image, lens)
        yield from check_placed_signs(frame.key, name, frame.annotations.signs[name], lens)


def check_views(key: str, name: str, views: Views, *, imported: bool = False) -> Iterator[str]:
    """Check that truncation and occlusion are in [0, 1] and that boxes have an area.

    `key` names the frame and `name` the camera, here and below. In an imported dataset an occlusion may be NaN, which
    is unknown.
    """
    occlusion = np.where(np.isnan(views.occlusion), 0.0, views.occlusion) if imported else views.occlusion
    shares = np.column_stack((views.truncation, occlusion))
    if not ((shares >= 0) & (shares <= 1)).all():
        yield f"{key}: '{name}' has a truncation or an occlusion outside 0 to 1"
    for kind, box in (("amodal", views.amodal_box), ("visible", views.visible_box)):
        known = box[~np.isnan(box).any(axis=1)]
        if (known[:, 2:] <= known[:, :2]).any():
            yield f"{key}: '{name}' has an {kind} box without area"


def check_planes(key: str, name: str, image: CameraImage, actors: int) -> Iterator[str]:
    """Check that the planes of an image agree in shape, depths are positive, and instances are of its `actors`."""
    if not _fit(image):
        yield f"{key}: the planes of '{name}' differ in shape"
        return
    if image.depth_m is not None and (np.isnan(image.depth_m).any() or (image.depth_m <= 0).any()):
        yield f"{key}: '{name}' has a depth that is not above 0"
    if image.instance is not None and image.instance.max(initial=0) > actors:
        yield f"{key}: '{name}' shows actor {image.instance.max()} of {actors}"


def _fit(image: CameraImage) -> bool:
    """Return whether the planes of an image have one height and width."""
    shape = image.rgb.shape[:2]
    others = (image.depth_m, image.semantic, image.instance)
    return image.rgb.shape[2:] == (3,) and all(plane is None or plane.shape == shape for plane in others)


def check_visibility(frame: Frame, name: str, image: CameraImage) -> Iterator[str]:
    """Check that the pixel counts and visible boxes of actors agree with the instance image."""
    truth, views = frame.annotations, frame.annotations.views[name]
    assert image.instance is not None
    found = find_actor_regions(image.instance.astype(np.int32), max(len(truth), int(image.instance.max(initial=0))))
    for i in np.flatnonzero(views.pixels != found.pixels[: len(truth)]):
        yield f"{frame.key}: '{name}' shows {found.pixels[i]} pixels of '{truth.track[i]}', not {views.pixels[i]}"
    same = np.isclose(views.visible_box, found.box[: len(truth)], equal_nan=True).all(axis=1)
    for i in np.flatnonzero(~same):
        yield f"{frame.key}: the visible box of '{truth.track[i]}' in '{name}' is not around its pixels"
    for i in np.flatnonzero((views.pixels > 0) & np.isnan(views.amodal_box).any(axis=1)):
        yield f"{frame.key}: '{truth.track[i]}' shows in '{name}' but has no amodal box there"


def check_projection(frame: Frame, name: str, image: CameraImage, lens: Lens) -> Iterator[str]:
    """Check that each actor's pixels, back-projected by their depth, lie in its 3D box, and in its amodal box."""
    truth, views = frame.annotations, frame.annotations.views[name]
    assert image.instance is not None
    assert image.depth_m is not None
    boxes = _boxes_then(frame, frame.calibration.offset_ms.get(name, 0.0) / 1e3)
    rays = compute_pixel_rays(lens).astype(np.float64).reshape(*image.instance.shape, 3)
    for i in np.flatnonzero(views.pixels >= JUDGED):
        v, u = np.nonzero(image.instance == i + 1)
        if len(v) < JUDGED:
            continue  # the annotated count is wrong, which `check_visibility` reports
        chosen = np.linspace(0, len(v) - 1, JUDGED).astype(int)
        v, u = v[chosen], u[chosen]
        points = rays[v, u] * (image.depth_m[v, u] / rays[v, u, 2])[:, None]
        world = transform_points(frame.world_from_sensor(name), points)
        inside = np.count_nonzero(points_in_boxes(world, boxes[[i]], MARGIN_M))
        if inside < INSIDE * JUDGED:
            yield (
                f"{frame.key}: pixels of '{truth.track[i]}' in '{name}' lie outside its box: "
                f"{inside} of {JUDGED} within"
            )
        x1, y1, x2, y2 = views.amodal_box[i] + np.array((-1, -1, 1, 1)) * MARGIN_PX
        if not ((u >= x1) & (u <= x2) & (v >= y1) & (v <= y2)).all():
            yield f"{frame.key}: pixels of '{truth.track[i]}' in '{name}' lie outside its amodal box"


def check_signs(key: str, name: str, signs: SignViews) -> Iterator[str]:
    """Check that annotated signs and lights have known states, boxes with area, pixels, distances, and are unique."""
    if set(signs.state.tolist()) - SIGN_STATES:
        yield f"{key}: '{name}' shows a light in an unknown state; known: {', '.join(sorted(SIGN_STATES))}"
    if not (np.isfinite(signs.box).all() and (signs.box[:, 2:] > signs.box[:, :2]).all()):
        yield f"{key}: '{name}' has a sign whose box has no area"
    if (signs.pixels <= 0).any() or not ((signs.distance_m > 0) & np.isfinite(signs.distance_m)).all():
        yield f"{key}: '{name}' has a sign without pixels, or at no distance"
    if len(np.unique(signs.thing)) < len(signs):
        yield f"{key}: '{name}' shows a sign twice"


def check_placed_signs(key: str, name: str, signs: SignViews, lens: Lens) -> Iterator[str]:
    """Check that the boxes of signs and lights lie in the image."""
    last = (lens.width - 0.5, lens.height - 0.5)
    if ((signs.box < -0.5) | (signs.box > (*last, *last))).any():
        yield f"{key}: '{name}' has a sign whose box does not lie in the image"


def _lens(frame: Frame, name: str, image: CameraImage) -> Lens:
    """Return the lens model of a camera from its calibration; raises `InputError` where that is out of range."""
    fx, fy, cx, cy = frame.calibration.intrinsics[name][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    coefficients = zip(("k1", "k2", "p1", "p2", "k3"), frame.calibration.distortion[name].tolist())
    height, width = image.rgb.shape[:2]
    values = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(coefficients)}
    return parse_config(Lens, values, f"{frame.key}: the calibration of '{name}'")


def _boxes_then(frame: Frame, offset_s: float) -> Boxes:
    """Return the annotated boxes `offset_s` after the spin, moved with constant acceleration and without turning."""
    truth = frame.annotations
    moved: Array = truth.boxes.center + offset_s * truth.velocity + offset_s**2 / 2 * truth.acceleration
    return Boxes(moved, truth.boxes.size, truth.boxes.yaw, truth.boxes.label)
