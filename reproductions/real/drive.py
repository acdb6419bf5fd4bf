"""Errors on KITTI's drive, in its coordinates by odometry, and poles that cover most of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from flcav.arrays import Array
from flcav.dataset.formats.conversion import import_dataset
from flcav.dataset.store import Dataset
from flcav.fusion.registration import DrivenSource
from flcav.optimization.placement.place import place
from flcav.perception.errors import THRESHOLD, PerceptionError, save_errors
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import find_shipped, load_network
from flcav.reproductions.real.regions import DRIVE, find_folder, read_drive, write_tracking
from flcav.storage.records import write_any_table

EVERY_M, ASIDE_M, HEIGHT_M = 20.0, 6.0, 5.0  # of candidates: along the drive, from it to either side, above its ground
RANGE_M, MOST = 30.0, 3  # reach of a sensor; sensors that are placed, one after another
ERRORS, POLES = "errors.csv", "poles.csv"


@dataclass(frozen=True)
class DriveErrors:
    """Errors on the drive by kind and class, and the poles along it that cover most of them."""

    sweeps: int
    length_m: float  # of the drive
    counts: dict[str, int]  # "miss Car": number of objects missed at least once, of false positives by place
    poles: int  # candidates
    chosen: tuple[tuple[int, ...], ...]  # numbers of the candidates, for 1, 2, ... sensors
    covered: tuple[int, ...]  # errors that these cover
    optimal: bool  # whether all of these are proven to be the best


def measure_drive(data: Sequence[Path], out: Path) -> DriveErrors:
    """Register the errors of the drive and place sensors along it; write `errors.csv` and `poles.csv` to `out`."""
    kitti, folder = out / "tracking", out / "drive"
    if not (folder / "manifest.json").is_file():
        write_tracking(read_drive(find_folder(data, DRIVE)), kitti)
        import_dataset("kitti-tracking", kitti, folder, posed=DrivenSource)
    dataset = Dataset.open(folder)
    network = load_network(OBJECTS, find_shipped(OBJECTS))
    errors = OBJECTS.register_errors(network, dataset, None, THRESHOLD).errors
    way = np.array([dataset.world_from_agent(i)[:3, 3] for i in range(len(dataset))])
    poles = line_poles(way)
    save_errors(errors, out / ERRORS)
    write_poles(poles, out / POLES)
    places = np.array([(each.x, each.y, each.z) for each in errors]).reshape(-1, 3)
    placed = [place(places, poles, RANGE_M, count) for count in range(1, min(MOST, len(poles)) + 1)]
    return DriveErrors(
        sweeps=len(dataset),
        length_m=float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()),
        counts=count_errors(errors),
        poles=len(poles),
        chosen=tuple(each.chosen for each in placed),
        covered=tuple(each.covered for each in placed),
        optimal=all(each.optimal for each in placed),
    )


def line_poles(way: Array) -> Array:
    """Return candidate poles (P, 3) [m, world] on both sides of a way (N, 3), `EVERY_M` apart along it.

    Vehicles that stand measure small steps of noise, so that the way is taken at points a metre apart at least.
    """
    kept = [way[0]]
    for point in way[1:]:
        if np.linalg.norm(point - kept[-1]) >= 1.0:
            kept.append(point)
    line = np.array(kept)
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))))
    marks = np.arange(0.0, along[-1] + 1e-9, EVERY_M)
    points = np.column_stack([np.interp(marks, along, column) for column in line.T])
    ahead = np.column_stack([np.interp(marks + 1.0, along, column) for column in line.T])
    behind = np.column_stack([np.interp(marks - 1.0, along, column) for column in line.T])
    heading = (ahead - behind)[:, :2]
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    left = np.column_stack((-heading[:, 1], heading[:, 0], np.zeros(len(marks))))
    up = np.array((0.0, 0.0, HEIGHT_M))
    sides = np.stack((points + ASIDE_M * left, points - ASIDE_M * left), axis=1)  # (marks, 2, 3)
    return sides.reshape(-1, 3) + up


def write_poles(poles: Array, path: Path) -> None:
    """Write poles (P, 3) [m, world] as a table that `flcav place --poles` reads, numbered from 0."""
    columns = {"id": range(len(poles)), **dict(zip("xyz", poles.T.tolist(), strict=True))}
    write_any_table(pa.table({name: pa.array(values) for name, values in columns.items()}), path)


def count_errors(errors: Sequence[PerceptionError]) -> dict[str, int]:
    """Return the number of errors by kind and class."""
    names = sorted(f"{each.kind} {each.label}" for each in errors)
    return {name: names.count(name) for name in dict.fromkeys(names)}
