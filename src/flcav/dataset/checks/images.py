"""What can be wrong with images and what is said of them: each check returns sentences, none where all is well."""

from collections.abc import Iterator

import numpy as np

from flcav.config import parse_config
from flcav.geometry import Boxes, points_in_boxes, transform_points
from flcav.sensors.camera.lens import Lens, directions
from flcav.sensors.frame import Array, CameraImage, Frame, SignViews, Views
from flcav.sensors.labels.signs import STATES
from flcav.sensors.labels.views import actor_regions

MARGIN_M = 0.3  # a pixel may lie so far outside its actor's box: mirrors, turning between the spin and the trigger
MARGIN_PX = 3.0
INSIDE = 0.95  # share of an actor's pixels that must lie in its box, grown by the margin
JUDGED = 40  # pixels from which on an actor is judged, and by how many at most
SIGN_STATES = {"", "off", *STATES.values()}


def check_images(frame: Frame) -> Iterator[str]:
    """Check every image of a frame and what its annotations say of it."""
    for name in (*frame.images, *frame.infrared):
        yield from check_views(frame.key, name, frame.annotations.views[name])
        yield from check_signs(frame.key, name, frame.annotations.signs[name])
    for name, image in frame.images.items():
        yield from check_planes(frame.key, name, image, len(frame.annotations))
        if not _fit(image):
            continue
        lens = _lens(frame, name, image)
        yield from check_visibility(frame, name, image)
        yield from check_projection(frame, name, image, lens)
        yield from check_placed_signs(frame.key, name, frame.annotations.signs[name], lens)


def check_views(key: str, name: str, views: Views) -> Iterator[str]:
    """Check that shares are shares and boxes are boxes."""
    shares = np.column_stack((views.truncation, views.occlusion))
    if not ((shares >= 0) & (shares <= 1)).all():
        yield f"{key}: '{name}' has a truncation or an occlusion outside 0 to 1"
    for kind, box in (("amodal", views.amodal_box), ("visible", views.visible_box)):
        known = box[~np.isnan(box).any(axis=1)]
        if (known[:, 2:] <= known[:, :2]).any():
            yield f"{key}: '{name}' has an {kind} box without area"


def check_planes(key: str, name: str, image: CameraImage, actors: int) -> Iterator[str]:
    """Check that the planes of an image go together."""
    if not _fit(image):
        yield f"{key}: the planes of '{name}' differ in shape"
        return
    if np.isnan(image.depth_m).any() or (image.depth_m <= 0).any():
        yield f"{key}: '{name}' has a depth that is not above 0"
    if image.instance.max(initial=0) > actors:
        yield f"{key}: '{name}' shows actor {image.instance.max()} of {actors}"


def _fit(image: CameraImage) -> bool:
    """Return whether the planes of an image are of one shape."""
    shape = image.rgb.shape[:2]
    others = (image.depth_m, image.semantic, image.instance)
    return image.rgb.shape[2:] == (3,) and all(plane.shape == shape for plane in others)


def check_visibility(frame: Frame, name: str, image: CameraImage) -> Iterator[str]:
    """Check that the pixels and visible boxes of actors are those of the instance image."""
    truth, views = frame.annotations, frame.annotations.views[name]
    found = actor_regions(image.instance.astype(np.int32), max(len(truth), int(image.instance.max(initial=0))))
    for i in np.flatnonzero(views.pixels != found.pixels[: len(truth)]):
        yield f"{frame.key}: '{name}' shows {found.pixels[i]} pixels of '{truth.track[i]}', not {views.pixels[i]}"
    same = np.isclose(views.visible_box, found.box[: len(truth)], equal_nan=True).all(axis=1)
    for i in np.flatnonzero(~same):
        yield f"{frame.key}: the visible box of '{truth.track[i]}' in '{name}' is not around its pixels"
    for i in np.flatnonzero((views.pixels > 0) & np.isnan(views.amodal_box).any(axis=1)):
        yield f"{frame.key}: '{truth.track[i]}' shows in '{name}' but has no amodal box there"


def check_projection(frame: Frame, name: str, image: CameraImage, lens: Lens) -> Iterator[str]:
    """Check that pixels, put where their depth says, lie in their actors' boxes, and in the amodal rectangles."""
    truth, views = frame.annotations, frame.annotations.views[name]
    boxes = _boxes_then(frame, frame.calibration.offset_ms.get(name, 0.0) / 1e3)
    rays = directions(lens).astype(np.float64).reshape(*image.instance.shape, 3)
    for i in np.flatnonzero(views.pixels >= JUDGED):
        v, u = np.nonzero(image.instance == i + 1)
        if len(v) < JUDGED:
            continue  # `check_visibility` tells that they are not those of the annotations
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
    """Check that the boxes, pixels, distances and states of signs and lights are such."""
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
    """Return the lens of a camera; raises `InputError` where its calibration is that of none."""
    fx, fy, cx, cy = frame.calibration.intrinsics[name][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    coefficients = zip(("k1", "k2", "p1", "p2", "k3"), frame.calibration.distortion[name].tolist())
    height, width = image.rgb.shape[:2]
    values = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(coefficients)}
    return parse_config(Lens, values, f"{frame.key}: the calibration of '{name}'")


def _boxes_then(frame: Frame, offset_s: float) -> Boxes:
    """Return the annotated boxes `offset_s` after the spin."""
    truth = frame.annotations
    moved: Array = truth.boxes.center + offset_s * truth.velocity + offset_s**2 / 2 * truth.acceleration
    return Boxes(moved, truth.boxes.size, truth.boxes.yaw, truth.boxes.label)
