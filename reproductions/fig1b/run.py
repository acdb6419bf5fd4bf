"""Fig. 1b of Wang et al. (IEEE Network 37(3), 2023), redrawn: the four perception tasks on one recorded scene.

From top to bottom: sensor data, the network's preprocessed input, activations of its layers, and its output. The
networks are those of the package.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from torch import nn

from flcav.config import parse_config
from flcav.dataset.layout import payload_path
from flcav.dataset.payloads import POINTS
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.geometry import inverse, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.marks import Bars, CloudBoxes, Paths, PictureBoxes
from flcav.perception.networks import resolve_network
from flcav.perception.objects.task import OBJECTS
from flcav.perception.ops.sparse import SparseTensor
from flcav.perception.signs.model import STRIDES
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import Finding, Task
from flcav.perception.tasks import task_named
from flcav.perception.trajectory.rasters import LAYERS as RASTER_LAYERS
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.weather.samples import reduce_picture
from flcav.perception.weather.task import WEATHER
from flcav.report import style
from flcav.report.pictures.clouds import draw_boxes, draw_points
from flcav.report.pictures.inference import boxes_in_picture
from flcav.report.pictures.predicted_paths import MAP_COLOURS, paths_on_map
from flcav.reproductions.fig1b import columns as page
from flcav.reproductions.fig1b.columns import Layer
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

WIDE, NARROW, LIDAR = "wide", "narrow", "velodyne"
CAMERA = {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 640, "height": 384}}
PRESENT = 5  # the shown spin: 2.5 s after the first, 3.5 s before the last
RECIPE: Mapping[str, Any] = {
    "town": "grid",
    "seed": 79,
    "warmup_s": 75.0,
    "spins_per_scene": 13,
    "every_s": 0.5,
    "cavs": 4,
    "vehicle_rig": {
        "lidars": RIGS["kitti_lidar"].model_dump(mode="json")["lidars"],
        "cameras": {
            WIDE: {**CAMERA, "settings": {**CAMERA["settings"], "fov_deg": 90.0}},
            NARROW: {**CAMERA, "settings": {**CAMERA["settings"], "fov_deg": 45.0}},
        },
    },
    "weather": "clear",
}
MAP_M = 50.0  # shown to either side of the observer
SCORE = 0.3  # least score of shown detections
CELL_M = 0.4  # of a drawn voxel, four times the network's, which would be too small to see
WAY, SELF, OTHERS, PEDESTRIAN = (0.75, 0.87, 0.95), (0.84, 0.37, 0), (0.0, 0.45, 0.7), (0.8, 0.47, 0.65)
RASTER_COLOURS = {
    **dict(zip(("road", "lane", "crossing"), MAP_COLOURS, strict=True)),
    "way": WAY,
    "self": SELF,
    "pedestrian": PEDESTRIAN,
    **{name: OTHERS for name in RASTER_LAYERS if name.startswith("others")},
}


def fig1b(out: Path, progress: Report = ignore_progress) -> bytes:
    """Record the scene to `out`, run the package's networks on it, and return the figure as a PNG.

    Raises `InputError` where one of the tasks has no weights in the package.
    """
    networks = {name: resolve_network(task_named(name), None) for name in LAYERS}
    record(EmbeddedSource(parse_config(Recipe, dict(RECIPE), "fig1b")), out / "data", progress=progress)
    data = Dataset.open(out / "data")
    number = choose_frame(data)
    columns = [
        _weather(networks["weather"], data.plane_path(number, WIDE, "rgb")),
        _signs(networks["signs"], data.plane_path(number, NARROW, "rgb")),
        _objects(networks["objects"], data.folder / payload_path(LIDAR, data.name(number), POINTS)),
        _trajectory(networks["trajectory"], data, number),
    ]
    return style.png(page.task_columns(columns), dpi=130)


def choose_frame(data: Dataset) -> int:
    """Return the number of the frame with the most legible signs and near objects ahead, of the spin `PRESENT`."""

    def worth(number: int) -> float:
        frame = data.frame(number)
        truth = frame.annotations
        ahead, left, _ = transform_points(inverse(frame.world_from_agent), truth.boxes.center).T
        near = (truth.returns >= 30) & (ahead > 4) & (ahead < 32) & (np.abs(left) < 20)
        signs = int((truth.signs[NARROW].pixels >= 100).sum())
        return 2 * min(signs, 6) + min(int(near.sum()), 20)

    return max(data.select(spins=[PRESENT]), key=worth)


def _weather(network: Any, picture: Path) -> page.Column:
    finding, layers = _run_network(WEATHER, network, picture)
    (bars,) = (mark for mark in finding.marks if isinstance(mark, Bars))
    return page.Column(
        "Weather",
        {
            "sensor": partial(page.show_picture, picture=finding.seen),
            "processing": partial(page.show_picture, picture=reduce_picture(finding.seen), smooth=False),
            "network": partial(page.show_layers, layers=layers),
            "output": partial(page.show_probabilities, probabilities=bars.share),
        },
        {
            "sensor": "camera, 90°",
            "processing": "32 × 32 pixels, means of areas",
            "network": "LeNet-5",
            "output": "probability of each class",
        },
    )


def _signs(network: Any, picture: Path) -> page.Column:
    finding, layers = _run_network(SIGNS, network, picture)
    (boxes,) = (mark for mark in finding.marks if isinstance(mark, PictureBoxes))

    def output(axes: Axes) -> None:
        page.show_picture(axes, finding.seen)
        boxes_in_picture(axes, boxes)

    anchors = [size for level in network.config.anchors_px for size in level]
    return page.Column(
        "Signs and lights",
        {
            "sensor": partial(page.show_picture, picture=finding.seen),
            "processing": partial(page.show_anchors, picture=finding.seen, stride=STRIDES[-1], anchors=anchors),
            "network": partial(page.show_layers, layers=layers),
            "output": output,
        },
        {
            "sensor": "camera, 45°",
            "processing": f"cells of 8, 16 and {STRIDES[-1]} pixels; nine anchors",
            "network": "YOLOv5-style: CSP, SPPF, PAN",
            "output": f"boxes with class and score: {len(boxes.box)}",
        },
    )


def _objects(network: Any, points: Path) -> page.Column:
    finding, layers = _run_network(OBJECTS, network, points)
    cloud, range_m, ground_m = finding.seen, network.config.range_m, network.config.ground_z_m
    (boxes,) = (mark.boxes for mark in finding.marks if isinstance(mark, CloudBoxes))

    def output(axes: Axes) -> None:
        draw_points(axes, cloud, ground_m, (range_m[0], range_m[3], range_m[4]))
        draw_boxes(axes, boxes, style.VERMILLION, width=1.6)
        axes.set(**page.FROM_ABOVE)

    return page.Column(
        "Objects",
        {
            "sensor": partial(page.show_sweep, points=cloud, range_m=range_m, height_m=-ground_m),
            "processing": partial(page.show_voxels, points=cloud, range_m=range_m, cell_m=CELL_M),
            "network": partial(page.show_layers, layers=layers),
            "output": output,
        },
        {
            "sensor": f"LiDAR, {len(cloud):,} points",
            "processing": f"voxels of {network.config.voxel_m[0]:g} m, from above (drawn at {CELL_M:g} m)",
            "network": "SECOND",
            "output": f"boxes, from above: {len(boxes)}",
        },
    )


def _trajectory(network: Any, data: Dataset, number: int) -> page.Column:
    """Return the column of the trajectory task: the raster of one road user, and the predicted paths of all."""
    with capture_outputs(LAYERS["trajectory"](network)) as seen, capture_inputs(network.view) as given:
        finding = next(islice(TRAJECTORY.infer(network, data.folder), number, None))
    raster = given[0].raster[0].cpu().numpy()
    (paths,) = (mark for mark in finding.marks if isinstance(mark, Paths))
    colours = [RASTER_COLOURS.get(name) for name in RASTER_LAYERS]

    def on_map(shown: Paths) -> page.Draw:
        def draw(axes: Axes) -> None:
            paths_on_map(axes, finding.seen, shown)
            axes.set(ylim=(-0.4 * MAP_M, 0.8 * MAP_M), xlim=(-MAP_M, MAP_M), aspect="auto")

        return draw

    still = replace(paths, users=tuple(replace(user, modes=(), truth=None) for user in paths.users))
    return page.Column(
        "Trajectories",
        {
            "sensor": on_map(still),
            "processing": partial(page.show_raster, raster=raster, colours=colours),
            "network": partial(page.show_layers, layers=list(seen.values())),
            "output": on_map(paths),
        },
        {
            "sensor": "tracks on the map; dashed: constant velocity",
            "processing": f"{len(raster)} layers around one road user, 2 s of past",
            "network": "convolutions, LSTM encoder and decoder",
            "output": f"{network.config.modes} futures of {paths.times_s[-1]:g} s; black: what came",
        },
    )


def _run_network(task: Task, network: Any, path: Path) -> tuple[Finding, list[page.Layer]]:
    with capture_outputs(LAYERS[task.name](network)) as seen:
        finding = next(task.infer(network, path, SCORE))
    return finding, list(seen.values())


Named = Mapping[str, nn.Module]

LENET = (1, 2, 4, 5, 7, 10)  # indices of its layers, after the rectifiers


def weather_layers(network: Any) -> Named:
    """Return the layers of a LeNet-5 by their names in the paper (LeCun et al. 1998)."""
    return {name: network.layers[place] for name, place in zip(("C1", "S2", "C3", "S4", "C5", "F6"), LENET)}


def signs_layers(network: Any) -> Named:
    """Return the backbone's three scales and the finest scale of the neck."""
    stages = {"CSP, 1/8": network.to_8, "CSP, 1/16": network.to_16, "SPPF, 1/32": network.to_32}
    return {**stages, "PAN, 1/8": network.down_8}


def objects_layers(network: Any) -> Named:
    """Return the sparse 3D backbone, the two scales of the bird's-eye-view network, and their concatenation."""
    ahead = network.birds_eye
    return {"sparse 3D": network.backbone, "BEV, 1/8": ahead.near, "BEV, 1/16": ahead.far, "both": ahead}


def trajectory_layers(network: Any) -> Named:
    """Return the encoders of the surroundings and of the past track, and the decoder of the future."""
    convolutions = {f"conv {number}": layer for number, layer in enumerate(network.view.layers, 1)}
    return {**convolutions, "LSTM": network.track, "context": network.context, "decoder": network.decoder}


LAYERS: dict[str, Callable[[Any], Named]] = {
    "weather": weather_layers,
    "signs": signs_layers,
    "objects": objects_layers,
    "trajectory": trajectory_layers,
}


@contextlib.contextmanager
def capture_outputs(layers: Named) -> Iterator[dict[str, Layer]]:
    """Yield a dictionary of the layers' last outputs by name, for the first sample of the batch."""
    seen: dict[str, Layer] = {}

    def keep(name: str) -> Callable[[nn.Module, Any, Any], None]:
        def kept(module: nn.Module, given: Any, out: Any) -> None:
            seen[name] = Layer(name, _values(out))

        return kept

    hooks = [layer.register_forward_hook(keep(name)) for name, layer in layers.items()]
    try:
        yield seen
    finally:
        for hook in hooks:
            hook.remove()


@contextlib.contextmanager
def capture_inputs(layer: nn.Module) -> Iterator[list[Any]]:
    """Yield a list of the positional arguments that `layer` was last called with."""
    seen: list[Any] = []
    hook = layer.register_forward_pre_hook(lambda module, given: seen.__setitem__(slice(None), given))
    try:
        yield seen
    finally:
        hook.remove()


def _values(out: Any) -> NDArray[np.float32]:
    """Return the output (C, H, W) or (C,) of the first sample; for a recurrent layer, that of its last time step."""
    if isinstance(out, SparseTensor):
        out = out.birds_eye()
    if isinstance(out, tuple):
        out = out[0]
    first = out[0, -1] if out.dim() == 3 else out[0]
    values = first.detach().float().cpu().numpy()
    return values.reshape(-1) if values.shape[1:] == (1, 1) else values


def _run(out: Path, options: Options) -> Outcome[None]:
    with options.show_progress("record") as report:
        picture = fig1b(out, report)
    return Outcome(None, {"fig1b.png": picture}, [f"{out / 'fig1b.png'}: four tasks on one scene"])


EXPERIMENT = Experiment(type(None), _run, lambda results: {}, takes=())
