"""Film strips: the same test frames through the networks of several plans, with what each finds and misses.

Signs are shown around a STOP sign under clouds, cars at a cross-road from above. Frames are chosen by their annotations
alone, before any network sees them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle

from flcav.arrays import Array, Ints, Mask
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes, inverse, transform_points
from flcav.perception.metrics.detection import assign_targets, match_greedily, on_neutral
from flcav.perception.objects.predict import OVERLAP, detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import asked_of, choose_lidar
from flcav.perception.ops.boxes import rectangle_iou
from flcav.perception.signs.predict import SignDetections, detect_in_picture
from flcav.perception.signs.samples import Sample, size_px
from flcav.perception.signs.task import SIGNS
from flcav.perception.weights import load_network
from flcav.report import style
from flcav.report.pictures.clouds import draw_boxes, draw_points, on_page
from flcav.runs.arms import Names
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD
from flcav.runs.results.saved import WEIGHTS
from flcav.sensors.frame import Frame
from flcav.world.map.town import Town
from flcav.world.weather import classify_weather

STOP, STOP_TOWN, CROSS_TOWN = "stop", "suburb", "grid"
CLOUDY = ("cloudy", "overcast")
SHOWN = 3  # frames of a strip
SIGNS_FROM, OBJECTS_FROM = 0.1, 0.3  # scores from which detections are shown
WINDOW_PX = (100.0, 240.0)  # least and most width of the part of a picture that is shown
AROUND = 12  # its width in sizes of the STOP sign
WIDE = 5 / 3  # its width, in heights
FOUND = style.GREEN  # of annotations
VIEW_M = (-4.0, 48.0, 24.0)  # of a sweep: behind, ahead, aside
AHEAD_M, ASIDE_M = (5.0, 35.0), 15.0  # where a cross-road's pole is from a vehicle before it


@dataclass(frozen=True)
class Counted:
    """Detections of a plan's network in the frames of a strip: right and false ones, and the targets."""

    found: int
    targets: int
    false: int


@dataclass(frozen=True)
class Panel:
    """A frame as the network of a plan sees it."""

    counted: Counted
    draw: Callable[[Axes], None]


@dataclass(frozen=True)
class Strip:
    """A PNG, and the counts over its frames by rule."""

    picture: bytes
    counted: Mapping[str, Counted]


def take_apart(values: Mapping[int, float], scenes: Mapping[int, str], shown: int = SHOWN) -> list[int]:
    """Return the `shown` frames of the largest values, the best of each scene before any second one, ascending."""
    ranked = sorted(values, key=lambda number: (-values[number], number))
    best = {scenes[number]: number for number in reversed(ranked)}
    return sorted(sorted(ranked, key=lambda number: number not in best.values())[:shown])


def spread_out(values: Mapping[int, float], shown: int = SHOWN) -> list[int]:
    """Return `shown` frames at equal distances in the order of their values, from the least to the largest."""
    ranked = sorted(values, key=lambda number: (values[number], number))
    places = np.linspace(0, len(ranked) - 1, min(shown, len(ranked))).round().astype(int)
    return [ranked[place] for place in places]


def judge(matched: Ints, targets: int) -> tuple[Mask, Mask]:
    """Return which detections are true (D,) and which targets are found, by the target (D,) of each, -1 for none."""
    return matched >= 0, np.isin(np.arange(targets), matched)


def count(hit: Mask, found: Mask) -> Counted:
    """Return the numbers of found targets, of targets, and of false detections."""
    return Counted(int(found.sum()), len(found), int((~hit).sum()))


def film_stops(names: Names, work: Path, arms: Mapping[str, str]) -> Strip:
    """Return the strip of STOP signs under clouds, from far to near, by the networks of each rule.

    `names`: of the run's steps, whose folders are in `work`; `arms`: by rule.
    """
    split = Frames.open(work / names.recording(STOP_TOWN, "test", SIGNS.name))
    config = next(iter(SIGNS.configurations.values()))
    samples = dict(zip(split.vehicles, SIGNS.samples(split.data, config, split.vehicles), strict=True))
    stop = config.classes.index(STOP)
    sizes = {
        number: float(size_px(stops).max())
        for number, sample in samples.items()
        if len(stops := sample.boxes[sample.label == stop]) and is_cloudy(split.data.frame(number))
    }
    frames = spread_out(sizes)

    def see(arm: str) -> list[Panel]:
        network = load_network(SIGNS, work / names.stage(arm, CLOUD, STOP_TOWN, SIGNS.name) / WEIGHTS)
        seen = (samples[number] for number in frames)
        return [
            show_signs(sample, detect_in_picture(network, sample.picture, threshold=SIGNS_FROM), stop)
            for sample in seen
        ]

    return draw_strip({rule: see(arm) for rule, arm in arms.items()}, 1 / WIDE)


def film_crossings(names: Names, work: Path, arms: Mapping[str, str]) -> Strip:
    """Return the strip of cross-roads from above; arguments as of `film_stops`."""
    split = Frames.open(work / names.recording(CROSS_TOWN, "test", OBJECTS.name))
    town = split.data.town()
    assert town is not None  # it was simulated
    networks = {
        rule: load_network(OBJECTS, work / names.stage(arm, CLOUD, CROSS_TOWN, OBJECTS.name) / WEIGHTS)
        for rule, arm in arms.items()
    }
    config = next(iter(networks.values())).config
    seen = {number: split.data.frame(number) for number in split.vehicles}
    wanted = {
        number: float(len(asked_of(frame, config).targets))
        for number, frame in seen.items()
        if faces_crossing(frame.world_from_agent, town)
    }
    frames = [seen[number] for number in take_apart(wanted, name_scenes(split.data))]
    panels = {
        rule: [
            show_cars(frame, found, asked_of(frame, config).targets, asked_of(frame, config).neutral, town)
            for frame, found in zip(frames, detect_in(network, frames, score_threshold=OBJECTS_FROM), strict=True)
        ]
        for rule, network in networks.items()
    }
    return draw_strip(panels, (VIEW_M[1] - VIEW_M[0]) / (2 * VIEW_M[2]))


def is_cloudy(frame: Frame) -> bool:
    """Return whether a frame was recorded under clouds."""
    return frame.weather is not None and classify_weather(frame.weather) in CLOUDY


def faces_crossing(world_from_agent: Array, town: Town) -> bool:
    """Return whether a pole of a cross-road stands ahead of an agent of this pose (4, 4)."""
    poles = town.poles.position[np.array(town.poles.kind) == "cross"]
    ahead, left, _ = transform_points(inverse(world_from_agent), poles).T
    return bool(((ahead > AHEAD_M[0]) & (ahead < AHEAD_M[1]) & (np.abs(left) < ASIDE_M)).any())


def name_scenes(data: Dataset) -> dict[int, str]:
    """Return the scene of each frame by number."""
    return {number: key.scene for number, key in enumerate(data.keys)}


def match_signs(found: SignDetections, sample: Sample) -> Ints:
    """Return the target (D,) of each detection in a picture, of its class; -1 for none, -2 on a sign to be ignored."""
    box = torch.from_numpy(found.box)
    overlap = rectangle_iou(box, torch.from_numpy(sample.boxes)).numpy()
    matched = match_greedily(np.where(found.label[:, None] == sample.label, overlap, 0.0), OVERLAP)
    ignored = (rectangle_iou(box, torch.from_numpy(sample.ignore)).numpy() > 0).any(axis=1)
    return np.where((matched < 0) & ignored, -2, matched)


def show_signs(sample: Sample, detections: SignDetections, stop: int) -> Panel:
    """Return the part of a picture around its largest STOP sign, with the signs there that are found and missed."""
    stops = sample.boxes[sample.label == stop]
    x1, y1, x2, y2 = place_window(stops[size_px(stops).argmax()], sample.picture.shape[1::-1])
    matched = match_signs(detections, sample)
    _, found = judge(matched, len(sample.boxes))
    shown = np.array([is_inside(box, (x1, y1, x2, y2)) for box in sample.boxes], dtype=bool)
    kept = np.array([is_inside(box, (x1, y1, x2, y2)) for box in detections.box], dtype=bool) & (matched > -2)
    hit = matched >= 0

    def draw(axes: Axes) -> None:
        height, width = sample.picture.shape[:2]
        axes.imshow(sample.picture, extent=(0, width, height, 0))
        for box, seen in zip(sample.boxes[shown], found[shown], strict=True):
            outline(axes, box, FOUND if seen else style.MISSED)
        named = hit | (np.cumsum(kept & ~hit) == 1)  # of false ones the best: scores fall
        for number in np.flatnonzero(kept):
            text = f"{detections.score[number]:.2f}" if named[number] else ""
            outline(axes, detections.box[number], style.HIT if hit[number] else style.FALSE, text)
        axes.set(xlim=(x1, x2), ylim=(y2, y1))

    return Panel(count(hit[kept], found[shown]), draw)


Window = tuple[float, float, float, float]  # left, top, right, bottom [px]


def place_window(box: Array, size: tuple[int, int]) -> Window:
    """Return the window around a box (4,) that is shown, inside a picture of this width and height."""
    width = float(np.clip(AROUND * size_px(box[None])[0], *WINDOW_PX))
    sides = np.array([width, width / WIDE])
    left, top = np.clip((box[:2] + box[2:] - sides) / 2, 0, size - sides)
    return left, top, left + sides[0], top + sides[1]


def is_inside(box: Array, window: Window) -> bool:
    """Return whether the middle of a box (4,) is in a window."""
    x, y = (box[:2] + box[2:]) / 2
    return bool(window[0] < x < window[2] and window[1] < y < window[3])


def outline(axes: Axes, box: Array, colour: str, text: str = "") -> None:
    """Draw a rectangle (4,) [px] with a text above it, below it where it is false."""
    x1, y1, x2, y2 = box.tolist()
    axes.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linewidth=2))
    if text:
        write(axes, (x1, y2 if colour == style.FALSE else y1), text, colour)


def write(axes: Axes, at: tuple[float, float], text: str, colour: str) -> None:
    """Write on a ground of `colour` above a place, below it where it is false."""
    axes.annotate(
        text,
        at,
        (0, -11 if colour == style.FALSE else 3),
        textcoords="offset points",
        color="white",
        fontsize=style.SMALL,
        annotation_clip=True,
        bbox={"facecolor": colour, "edgecolor": "none", "pad": 0.8},
    )


def show_cars(frame: Frame, detections: Boxes, targets: Boxes, neutral: Boxes, town: Town) -> Panel:
    """Return a sweep from above on the town's roads, with the cars found and missed."""
    matched = assign_targets(detections, targets, OVERLAP)
    kept = (matched >= 0) | ~on_neutral(detections, neutral)
    boxes = detections[kept]
    hit, found = judge(matched[kept], len(targets))
    lidar = choose_lidar(frame)
    lidar_from_world = inverse(frame.world_from_sensor(lidar))

    def draw(axes: Axes) -> None:
        for road in town.roads:
            corners = transform_points(lidar_from_world, np.column_stack((road, np.zeros(len(road)))))
            axes.add_patch(Polygon(on_page(corners[:, :2]), color=style.SIDEWALK, zorder=0))
        draw_points(axes, frame.lidar[lidar], -float(frame.agent_from_sensor[lidar][2, 3]), VIEW_M)
        draw_boxes(axes, targets[found], FOUND, fill=0.4, width=0.8)
        draw_boxes(axes, targets[~found], style.MISSED, fill=0.35, width=1.6)
        for part, colour, up in ((boxes[hit], style.HIT, 1.5), (boxes[~hit], style.FALSE, -1.5)):
            draw_boxes(axes, part, colour, width=1.8)
            for place, score in zip(on_page(part.center[:, :2]).tolist(), asked_score(part), strict=True):
                write(axes, (place[0] - 1.5, place[1] + up), f"{score:.2f}", colour)
        axes.plot(0, 0, "^", color=style.INK, markersize=7, clip_on=False)
        style.scale_bar(axes, 10)

    return Panel(count(hit, found), draw)


def asked_score(boxes: Boxes) -> list[float]:
    """Return the scores of detections."""
    return [] if boxes.score is None else boxes.score.tolist()


@style.styled
def draw_strip(panels: Mapping[str, Sequence[Panel]], tall: float) -> Strip:
    """Return the strip: a row for each rule, a column for each frame, `tall` times as high as wide."""
    columns = max(1, *map(len, panels.values()))
    figure = style.canvas(10.0, (10.0 / columns * tall + 0.3) * len(panels) + 0.3)
    for row, axes_of in zip(panels.items(), figure.subplots(len(panels), columns, squeeze=False), strict=True):
        rule, seen = row
        for axes in axes_of:
            style.hide_axes(axes)
        for axes, panel in zip(axes_of, seen):  # a trial of few frames may have none to show
            panel.draw(axes)
            counted = panel.counted
            axes.set_title(f"{counted.found} of {counted.targets} found, {counted.false} false")
        axes_of[0].set_ylabel(rule, fontweight="bold", color=style.INK)
    colours = {
        "truth, found": FOUND,
        "truth, missed": style.MISSED,
        "detection with its score": style.HIT,
        "false detection": style.FALSE,
    }
    style.key(figure, [Line2D([], [], color=colour, label=name) for name, colour in colours.items()])
    return Strip(style.png(figure, 100), {rule: add_counts(seen) for rule, seen in panels.items()})


def add_counts(seen: Sequence[Panel]) -> Counted:
    """Return the sums over the frames of a strip."""
    return Counted(*(sum(getattr(panel.counted, name) for panel in seen) for name in ("found", "targets", "false")))
