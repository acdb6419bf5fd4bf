"""Recordings of a finished run, for the page: drives, a sweep before and after training, a camera picture.

Everything is read from the run's folder when it is asked for, and is empty where the folder no longer has it.
"""

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flcav.config import InputError, Json, shorten
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.perception.errors import MISS, THRESHOLD, PerceptionError, load_errors
from flcav.perception.marks import PictureBoxes
from flcav.perception.objects.task import OBJECTS
from flcav.perception.signs.task import SIGNS
from flcav.perception.tasks import task_named
from flcav.perception.weights import load_network
from flcav.planner.placing import describe_town
from flcav.report.pictures.sweep_scene import describe_sweep
from flcav.runs.frames import DATA, Frames
from flcav.runs.recipe import PRETRAIN
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import Run
from flcav.runs.results.saved import ERRORS, WEIGHTS
from flcav.runs.results.tests import SweepComparison
from flcav.runs.stages.testing import LOOK, detect_before_after
from flcav.sensors.frame import Frame
from flcav.world.trace import Trace, find_instant

WORK = "work"  # folder of a run's steps
MOST_SCENES = 4  # of a recording that are played
APART_S = 0.8  # least time between two poses that the page is given [s]
PEDESTRIAN = "pedestrian"
SAME_M = 1e-3  # difference of distances and places that are the same [m]
MOST_PX = 960  # width of a picture
MOST_FRAMES = 60  # of a test, among which the picture with most labels is looked for


@dataclass(frozen=True)
class Footage:
    """The recordings of an arm of a finished run, by region and task."""

    folder: Path
    run: Run
    arm: str

    @property
    def shown(self) -> dict[str, Json]:
        """Return which parts the folder has: regions with drives, a sweep, tasks with camera pictures."""
        return {
            "regions": [placed.region for placed in self._placed if self._where(placed.region, "registry")],
            "sweep": self._sweep_region() is not None,
            "pictures": [*self._tasks_with_pictures()],
        }

    def drive(self, region: str) -> dict[str, Json]:
        """Return a region's map, its chosen poles, its drives, and its errors with the instant of each.

        Raises `InputError` where the run has no such region, or its recordings are gone.
        """
        placed = next((each for each in self._placed if each.region == region), None)
        if placed is None:
            raise InputError(f"the run has no region {shorten(region)} with sensors")
        registry, edge = (self._recording(region, split) for split in ("registry", "edge"))
        if registry is None or (town := registry.town()) is None:
            raise InputError(f"{region}: the run's folder no longer has its recordings")
        found = self._errors(region)
        scenes = _scenes(registry, [error.scene for error in found])
        traces = [trace for scene in scenes if (trace := registry.trace(scene)) is not None]
        poles = {int(number): place for number, place in zip(town.poles.id, town.poles.position.tolist(), strict=True)}
        errors: list[Json] = []
        for error in found:
            if error.scene in scenes:
                at = (round(error.x, 1), round(error.y, 1))
                when = _when(traces[scenes.index(error.scene)], error.track, at)
                errors.append({"at": list(at), "kind": error.kind, "scene": scenes.index(error.scene), "when": when})
        return {
            "map": describe_town(town),
            "poles": [poles[number] for number in placed.chosen if number in poles],
            "range_m": self.run.recipe.placement.range_m,
            "errors": errors,
            "all": len(found),
            "registry": [_drive(trace) for trace in traces],
            "edge": [] if edge is None else [_drive(trace) for _, trace in _first_traces(edge)],
        }

    def sweep(self) -> dict[str, Json]:
        """Return the run's sweep with the detections before and after training; raises `InputError` without one."""
        region = self._sweep_region()
        if region is None:
            raise InputError("the run's folder has no sweep before and after training")
        compared = SweepComparison.load(self.folder / WORK / LOOK)
        return describe_sweep(
            dict(self._tests(OBJECTS.name))[region].frame(compared.frame), compared, self._first_stage
        )

    def error_sweep(self, region: str, row: int) -> dict[str, Json]:
        """Return the sweep in which the error in a row of a region's table was made, with that place marked.

        Both networks look at it anew. Raises `InputError` where the run does not have what that needs.
        """
        found, folder = self.errors_in(region, OBJECTS.name), self._where(region, "registry")
        if found is None or folder is None:
            raise InputError(f"{region}: the run's folder no longer has the sweeps of its errors")
        errors = load_errors(found)
        if row >= len(errors):
            raise InputError(f"row: {region} has {len(errors)} errors")
        split = Frames.open(folder)
        number = find_frame(split, errors[row])
        if number is None:
            raise InputError("the table of errors does not tell in which sweep this one was made")
        steps = [
            self.folder / WORK / self.run.steps.stage(self.arm, stage, region, OBJECTS.name)
            for stage in (PRETRAIN, self._first_stage)
        ]
        if not all((step / WEIGHTS).exists() for step in steps):
            raise InputError("the run's folder no longer has its networks")
        compared = detect_before_after(steps[0], steps[1], replace(split, vehicles=(number,)))
        place = np.array((errors[row].x, errors[row].y, errors[row].z))
        return describe_sweep(split.data.frame(number), compared, self._first_stage, place)

    def has_error_sweeps(self, region: str) -> bool:
        """Return whether the errors that the region's workspace shows are of objects, whose sweeps are still there."""
        path = self.errors_of(region)
        return (
            path is not None
            and path == self.errors_in(region, OBJECTS.name)
            and self._where(region, "registry") is not None
        )

    def errors_of(self, region: str) -> Path | None:
        """Return the table of a region's errors, of the first task that has one; None where none has."""
        paths = (self.errors_in(region, task) for task in self.run.recipe.placement.tasks or self.run.recipe.tasks)
        return next((path for path in paths if path is not None), None)

    def errors_in(self, region: str, task: str) -> Path | None:
        """Return the table of a task's errors in a region; None where the folder has none."""
        path = self.folder / WORK / self.run.steps.errors(self.arm, region, task) / ERRORS
        return path if path.exists() else None

    def picture(self, task: str) -> dict[str, Json]:
        """Return a test picture of a task with what is labelled, and what is found in it before and after training.

        It is the picture with most labels. Raises `InputError` where the run has none.
        """
        if task not in self._tasks_with_pictures():
            raise InputError(f"the run has no pictures of {shorten(task)}")
        region, data = next((each, data) for each, data in self._tests(task) if data.cameras(0))
        signs = task == SIGNS.name
        labels = [_labels(data.frame(i), data.cameras(i)[0], signs=signs) for i in range(min(len(data), MOST_FRAMES))]
        frame = int(np.argmax([len(each) for each in labels]))
        return {
            **_as_jpeg(np.asarray(data.plane(frame, data.cameras(frame)[0], "rgb"))),
            "region": region,
            "labels": labels[frame],
            "found": [*self._find(task, region, data, frame)],
        }

    @property
    def _placed(self) -> tuple[Placed, ...]:
        return self.run.arms[self.arm].placed

    def _recording(self, region: str, split: str) -> Dataset | None:
        folder = self._where(region, split)
        return None if folder is None else Frames.open(folder).data

    def _where(self, region: str, split: str) -> Path | None:
        """Return the folder of a split's first recording that is still there."""
        for task in (*self.run.recipe.placement.tasks, *self.run.recipe.tasks):
            folder = self.folder / WORK / self.run.steps.recording(region, split, task)
            if (folder / DATA / MANIFEST).exists():
                return folder
        return None

    def _errors(self, region: str) -> Sequence[PerceptionError]:
        path = self.errors_of(region)
        return () if path is None else load_errors(path)

    @property
    def _first_stage(self) -> str:
        """The stage after pretraining, whose network the run's sweep compares."""
        stages = (each.stage for each in self.run.arms[self.arm].stages)
        return next((stage for stage in stages if stage != PRETRAIN), PRETRAIN)

    def _sweep_region(self) -> str | None:
        """Return the region whose test has the sweep, the first that federates; None where the folder has none."""
        kept = (self.folder / WORK / LOOK / SweepComparison.file).exists()
        return next((region for region, _ in self._tests(OBJECTS.name)), None) if kept else None

    def _tests(self, task: str) -> Iterator[tuple[str, Dataset]]:
        for placed in self._placed:
            folder = self.folder / WORK / self.run.steps.recording(placed.region, "test", task)
            if (folder / DATA / MANIFEST).exists():
                yield placed.region, Frames.open(folder).data

    def _tasks_with_pictures(self) -> list[str]:
        return [task for task in self.run.recipe.tasks if any(data.cameras(0) for _, data in self._tests(task))]

    def _find(self, name: str, region: str, data: Dataset, frame: int) -> Iterator[Json]:
        """Yield the boxes, or else the caption, of the networks before and after the stages on a test frame."""
        task, stages = task_named(name), [stage.stage for stage in self.run.arms[self.arm].stages]
        for stage, title in ((PRETRAIN, "pretrained"), (stages[-1] if stages else PRETRAIN, "after the last stage")):
            folder = self.folder / WORK / self.run.steps.stage(self.arm, stage, region, name)
            try:
                network = load_network(task, folder / WEIGHTS)
            except InputError:
                continue
            for finding in task.infer(network, data.folder, THRESHOLD, [frame]):
                boxes = [mark for mark in finding.marks if isinstance(mark, PictureBoxes)]
                rows = [
                    [*map(_tenth, box), str(label), round(float(score), 2)]
                    for mark in boxes
                    for box, label, score in zip(mark.box.tolist(), mark.label, mark.score.tolist(), strict=True)
                ]
                yield {"title": title, "boxes": rows, "said": ", ".join(mark.caption for mark in finding.marks)}


def find_frame(split: Frames, error: PerceptionError) -> int | None:
    """Return the frame in which an error was made: the first whose vehicle is as far from it as the table says.

    A missed object is there, too. None where there is no such frame, as in tables without distances.
    """
    data, place = split.data, np.array((error.x, error.y))
    for number in split.vehicles:
        if data.keys[number].scene != error.scene:
            continue
        far = np.hypot(*(data.world_from_agent(number)[:2, 3] - place))
        if not abs(far - error.distance_m) <= SAME_M:  # nor is it where the distance is NaN
            continue
        truth = data.frame(number).annotations
        there = np.hypot(*(truth.boxes.center[truth.track == error.track, :2] - place).T) <= SAME_M
        if error.kind != MISS or there.any():
            return number
    return None


def _tenth(value: float) -> float:
    return round(float(value), 1)


def _scenes(data: Dataset, wrong: Sequence[str]) -> list[str]:
    """Return the scenes with most of the errors, `MOST_SCENES` at most, in the order in which they were recorded."""
    known = sorted({key.scene for key in data.keys})
    traced = [scene for scene in known if data.trace(scene) is not None]
    return sorted(sorted(traced, key=lambda scene: -wrong.count(scene))[:MOST_SCENES])


def _first_traces(data: Dataset) -> Iterator[tuple[str, Trace]]:
    for scene in sorted({key.scene for key in data.keys})[:MOST_SCENES]:
        if (trace := data.trace(scene)) is not None:
            yield scene, trace


def _when(trace: Trace, track: str, at: tuple[float, float]) -> float:
    """Return the time [s] from the start of a trace at which an error was made: its road user is nearest to it then."""
    instant = find_instant(trace, track, at)
    return 0.0 if instant is None else _tenth(trace.time_s[instant] - trace.time_s[0])


def _drive(trace: Trace) -> dict[str, Json]:
    """Return the poses of the road users of a trace, `APART_S` apart: x, y [m], yaw [rad], speed [m/s], or None."""
    kept = [0]
    for index, time in enumerate(trace.time_s.tolist()):
        if time - trace.time_s[kept[-1]] >= APART_S:
            kept.append(index)
    users: list[Json] = []
    for number, (name, category) in enumerate(zip(trace.actor.tolist(), trace.category.tolist(), strict=True)):
        speed = np.hypot(*trace.velocity[kept, number, :2].T)
        rows = np.column_stack((trace.position[kept, number, :2], trace.yaw[kept, number], speed)).round(2)
        there = trace.present[kept, number]
        if there.any():
            path: list[Json] = [row if here else None for row, here in zip(rows.tolist(), there.tolist(), strict=True)]
            size = trace.size[number, :2].round(1).tolist()
            users.append({"name": name, "walks": category == PEDESTRIAN, "size": size, "path": path})
    return {"times": (trace.time_s[kept] - trace.time_s[0]).round(2).tolist(), "users": users}


def _labels(frame: Frame, camera: str, *, signs: bool) -> list[Json]:
    """Return what is labelled in a picture: signs and signals, or the road users that are visible."""
    if signs:
        seen = frame.annotations.signs[camera]
        return [[*map(_tenth, box), str(kind)] for box, kind in zip(seen.box.tolist(), seen.kind, strict=True)]
    shown, labels = frame.annotations.views[camera].shown_box.tolist(), frame.annotations.boxes.label
    return [[*map(_tenth, box), str(label)] for box, label in zip(shown, labels, strict=True) if np.isfinite(box).all()]


def _as_jpeg(picture: NDArray[np.uint8]) -> dict[str, Json]:
    height, width = picture.shape[:2]
    image, content = Image.fromarray(picture[..., :3]), io.BytesIO()
    image.thumbnail((MOST_PX, MOST_PX))
    image.save(content, "JPEG", quality=85)
    shown = f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"
    return {"picture": shown, "width": width, "height": height}
