"""Ranges of roadside LiDARs: the distance within which the road detector finds cars in the sweeps of each model.

All models are mounted on the same poles, in towns that the detector was not trained in, and see the same traffic. They
are the package's roadside LiDAR with fewer and more channels, and models for vehicles, mounted level. The cost of a
sensor, a stand-in for its price, is its number of channels divided by sixteen.
"""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.fusion.road import THRESHOLD, load_road_network
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import frame_reader
from flcav.perception.metrics.detection import assign_targets
from flcav.perception.objects.predict import detect
from flcav.report import style
from flcav.report.charts.roadside import draw_ranges
from flcav.reproductions.fig4.run import LIDAR, OVERLAP, find_range, list_cars
from flcav.runs.provenance import Provenance, provenance
from flcav.sensors.lidar.lidar import Lidar
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

MODELS: Mapping[str, Mapping[str, Any]] = {  # settings of `Lidar`
    **{f"pole_{channels}": {**LIDAR["settings"], "channels": channels} for channels in (16, 32, 64, 128)},
    **{name: {"beams": name, "sensitivity_m": LIDAR["settings"]["sensitivity_m"]} for name in ("hdl32e", "os1_128")},
}
TOWNS: Mapping[str, int] = {"grid": 8501, "ring": 8502}  # and their seeds
SHARED: Mapping[str, Any] = {
    "split": "test",
    "scenes": 4,
    "spins_per_scene": 2,
    "every_s": 6.0,
    "cavs": 0,
    "poles": "all",
    "pole_rig": {"lidars": {name: {"settings": dict(settings)} for name, settings in MODELS.items()}},
}
EDGES_M = tuple(range(0, 61, 5))  # of distance from the pole
CHEAPEST = 16  # channels of a sensor of cost 1


@dataclass(frozen=True)
class LidarModel:
    """A LiDAR model, the cars found in its sweeps, and its range."""

    name: str
    channels: int
    found: tuple[int, ...]  # cars found, in each interval of `EDGES_M`
    range_m: float  # distance within which four of five cars are found; 0 where nowhere

    @property
    def cost(self) -> float:
        """Return the cost relative to a sensor of `CHEAPEST` channels."""
        return self.channels / CHEAPEST


@dataclass(frozen=True)
class SensorRanges(Record):
    """Recall of the road detector in the sweeps of each LiDAR model, by distance."""

    sweeps: int  # per model
    cars: tuple[int, ...]  # with enough returns of some model, in each interval of `EDGES_M`
    models: tuple[LidarModel, ...]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return a sentence with the range of each model."""
        return [
            f"{model.name}, {model.channels} channels: four of five cars are found within {model.range_m:g} m"
            for model in self.models
        ]

    def sensors_csv(self) -> bytes:
        """Return the CSV table for `flcav place --sensors`: name, range_m, cost; without models of range 0."""
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(("name", "range_m", "cost"))
        rows.writerows((model.name, f"{model.range_m:g}", f"{model.cost:g}") for model in self.models if model.range_m)
        return text.getvalue().encode()

    def picture(self) -> bytes:
        """Return the chart of recall against distance as a PNG."""
        shares = {
            model.name: [found / cars if cars else None for found, cars in zip(model.found, self.cars, strict=True)]
            for model in self.models
        }
        return style.png(draw_ranges(EDGES_M, shares))


def measure_ranges(out: Path, progress: Report = ignore_progress) -> tuple[SensorRanges, dict[str, bytes]]:
    """Record all models on the poles of `TOWNS` into `out`; return their ranges, and a PNG and a CSV by file name."""
    network = load_road_network()
    cars = np.zeros(len(EDGES_M) - 1, dtype=np.int64)
    found = {name: np.zeros_like(cars) for name in MODELS}
    sweeps = 0
    for town, seed in TOWNS.items():
        record(EmbeddedSource(parse_config(Recipe, {**SHARED, "town": town, "seed": seed}, town)), out / town)
        data = Dataset.open(out / town)
        read = frame_reader(data, network.config.foreground)
        for number in range(len(data)):
            frame, position = read(number), data.world_from_agent(number)[:2, 3]
            targets = list_cars(data, [(number, name) for name in MODELS])
            apart = np.linalg.norm(targets.center[:, :2] - position, axis=1)
            cars += np.histogram(apart, EDGES_M)[0]
            for name in MODELS:
                boxes = detect(network, frame.lidar[name], score_threshold=THRESHOLD)
                hit = assign_targets(boxes.transform(frame.world_from_sensor(name)), targets, OVERLAP, "bev")
                found[name] += np.histogram(apart[hit[hit >= 0]], EDGES_M)[0]
            sweeps += 1
            progress(number + 1, len(data), town)
    models = tuple(
        LidarModel(
            name,
            Lidar.model_validate(dict(settings)).channels,
            tuple(found[name].tolist()),
            find_range(EDGES_M, cars.tolist(), found[name].tolist()),
        )
        for name, settings in MODELS.items()
    )
    results = SensorRanges(sweeps, tuple(cars.tolist()), models, provenance())
    return results, {"ranges.png": results.picture(), "sensors.csv": results.sensors_csv()}


def range_tables(results: SensorRanges) -> dict[str, str]:
    """Return Markdown by name: ranges."""
    rows = [
        [
            f"`{model.name}`",
            model.channels,
            *(f"{found / cars:.2f}" if cars else "" for found, cars in zip(model.found, results.cars, strict=True)),
            f"{model.range_m:g}" if model.range_m else "none",
            f"{model.cost:g}",
        ]
        for model in results.models
    ]
    header = (
        "share of cars found",
        "channels",
        *(f"{a}–{b} m" for a, b in pairwise(EDGES_M)),
        "range [m]",
        "cost",
    )
    return {"ranges": format_table(header, [["cars", "", *results.cars, "", ""], *rows])}


def _run(out: Path, options: Options) -> Outcome[SensorRanges]:
    with options.show_progress(options.title) as report:
        results, pictures = measure_ranges(out, report)
    return Outcome(results, pictures, results.sentences())


EXPERIMENT = Experiment(SensorRanges, _run, range_tables, takes=())
