"""Coverage of a domain by recordings, with a detector's errors by cell: openodd-py's documents, report and HTML matrix.

A run is the drive of one vehicle through one scene. A COD (current operational domain) is OpenODD's table of observed
attributes (ASAM OpenODD 1.0, section 8.3).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np
from openodd import CoverageCollector, CoverageReport, CoverageView, export_cods, merge_coverage, view

from flcav.config import InputError, Json, read_json
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.odd.cells import CellErrors, Trial, cells_of, find_failures, full_name, measure_cells
from flcav.odd.domain import Domain, Value
from flcav.odd.measure import Measurements, measure_domain
from flcav.perception.agents import choose_frames
from flcav.perception.objects.evaluate import join_outcomes
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes
from flcav.storage.files import write_bytes, write_json
from flcav.storage.records import Record
from flcav.world.geodesy import convert_to_geodetic

BEGINNING = "1970-01-01T00:00:00.000+00:00"  # start of every run, since recordings have no date

Document = dict[str, Json]  # coverage document of openodd-py


@dataclass(frozen=True)
class Covered(Record):
    """Coverage of one attribute by buckets."""

    attribute: str
    buckets: tuple[str, ...]  # all
    covered: tuple[str, ...]  # by a run
    holes: tuple[str, ...]  # inside the domain, but not covered
    outside: tuple[str, ...]  # outside the domain
    grade: float  # share of the buckets inside the domain that are covered


def collect_runs(
    domain: Domain,
    data: Dataset,
    measured: Measurements,
    failures: Mapping[int, bool] | None = None,
) -> dict[str, Document]:
    """Return the coverage documents of the runs of a recording, by name ("SCENE_AGENT").

    `failures` maps tested frames to whether they fail; a run fails at its first failing frame. Raises `InputError`
    where the domain tests an attribute that nothing measures.
    """
    domain.require_bound()
    place = _positions(data, measured.frames)
    runs: dict[str, list[int]] = {}
    for row, i in enumerate(measured.frames):
        runs.setdefault(f"{data.keys[i].scene}_{data.keys[i].agent}", []).append(row)
    values = measured.rows()
    documents = dict[str, Document]()
    for name, rows in runs.items():
        rows = sorted(rows, key=lambda row: data.keys[measured.frames[row]].time_s)
        times = [data.keys[measured.frames[row]].time_s for row in rows]
        collector = CoverageCollector([], odd=domain.definition, backend=domain.backend)
        steps = np.diff(times, prepend=times[0] - (times[1] - times[0] if len(times) > 1 else 0.0))
        collector.start(values[rows[0]] | place[rows[0]], times[0] - float(steps[0]))
        for row, time_s in zip(rows, times, strict=True):
            collector.tick(values[row] | place[row], time_s)
        collector.end(values[rows[-1]] | place[rows[-1]], times[-1])
        if failures is not None:
            failed = [time_s for row, time_s in zip(rows, times, strict=True) if failures.get(measured.frames[row])]
            collector.record_outcome(not failed, failed_at=failed[0] if failed else None)
        document = collector.to_dict(data.keys[measured.frames[rows[0]]].scene)
        document["odd"]["started_at"] = BEGINNING
        for item in document["items"]:
            item["outside_odd"] = list_outside(domain, item)
        documents[name] = document
    return documents


def list_outside(domain: Domain, item: Mapping[str, Json]) -> list[str]:
    """Return the buckets of an item of a coverage document that are outside a domain.

    openodd-py counts a bucket as inside if its lower edge is, so that a limit of "<= 50 km/h" leaves the bucket
    [50, 70) as a hole. Here a bucket of numbers, except the first, is outside if no value between its edges is inside.
    Buckets of counts are those of the library.
    """
    known = [str(bucket) for bucket in _list(item["outside_odd"])]
    name = str(item["attribute"])
    definition = next((other.item for other in domain.definition.attributes if other.name == name), None)
    if definition is None or not definition.numeric or item["unit"] == "count" or name not in domain.tested:
        return known
    limits = domain.limits.get(name, ())

    def is_outside(low: float, high: float) -> bool:
        # No condition changes between two cuts: one value in each interval decides.
        cuts = [low, *(limit for limit in limits if low < limit < high), high]
        return not any(domain.can_hold({name: (a + b) / 2}) for a, b in pairwise(cuts))

    spans = zip(definition.labels, definition.edges, definition.edges[1:], strict=False)
    beyond = {label for number, (label, *edges) in enumerate(spans) if number and is_outside(*edges)}
    return [label for label in definition.labels if label in beyond or label in known]


def _list(value: Json) -> Sequence[Json]:
    return value if isinstance(value, list) else []


def count_cells(documents: Sequence[Document], x: str, y: str) -> tuple[int, int]:
    """Return the numbers of covered cells and of all cells inside the domain, in the matrix of two attributes."""
    cells = [cell for row in CoverageView(list(documents)).matrix(x=x, y=y)["cells"] for cell in row]
    inside = [cell for cell in cells if not cell["outside_odd"]]
    return sum(cell["state"] != "unsampled" for cell in inside), len(inside)


def merge_runs(documents: Sequence[Document]) -> CoverageReport:
    """Return openodd-py's coverage report of several runs."""
    return merge_coverage(list(documents))


def load_report(folder: Path) -> CoverageReport:
    """Return openodd-py's report of the runs that `write_runs` wrote to a folder.

    Raises `InputError` where there are none, or a document is damaged.
    """
    paths = sorted((folder / "runs").glob("*_coverage.json"))
    if not paths:
        raise InputError(f"{folder}: no runs of flcav odd cover")
    try:
        return merge_runs([_document(path) for path in paths])
    except (ValueError, TypeError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{folder / 'runs'}: no coverage that openodd-py reads ({error})") from None


def _document(path: Path) -> Document:
    document = read_json(path)
    if not isinstance(document, dict) or not isinstance(document.get("odd"), dict):
        raise InputError(f"{path}: no coverage of a run")
    return document


def list_covered(report: CoverageReport) -> tuple[Covered, ...]:
    """Return the coverage of all attributes with buckets."""
    return tuple(
        Covered(
            entry.name.removeprefix("odd."),
            tuple(entry.buckets),
            tuple(entry.covered),
            tuple(entry.holes),
            tuple(entry.outside),
            float(entry.grade),
        )
        for entry in report.entries
    )


def write_runs(documents: Mapping[str, Document], out: Path) -> None:
    """Write the runs' documents as OUT/runs/NAME_coverage.json, in the format that openodd-py's commands read."""
    for name, document in documents.items():
        write_json(out / "runs" / f"{name}_coverage.json", document, sort=False)


def write_matrix(documents: Sequence[Document], x: str, y: str, title: str, said: Sequence[str], path: Path) -> None:
    """Write the HTML page of the matrix of two attributes, with the runs of each cell, below the sentences `said`."""
    lead = "".join(f"<p>{escape(line)}</p>" for line in said)
    page = view.page(title, lead + CoverageView(list(documents)).explorer_html(x=x, y=y, depth=1))
    write_bytes(path, page.encode())


def write_cod(documents: Mapping[str, Document], out: Path) -> int:
    """Write the COD of each run to `out` (table, manifest and taxonomy), and return the total number of rows.

    Frames without latitude and longitude are left out, since OpenODD's tables require them.
    """
    given = [(Path(f"{name}_coverage.json"), document) for name, document in documents.items()]
    return sum(cod.rows for cod in export_cods(given, out))


def _positions(data: Dataset, frames: Sequence[int]) -> list[dict[str, Value]]:
    """Return the agent's position [m] in each frame, with latitude and longitude [deg] where the town is known."""
    place = np.array([data.world_from_agent(i)[:3, 3] for i in frames]).reshape(-1, 3)
    town = data.town()
    earth = np.full((len(frames), 2), np.nan) if town is None else convert_to_geodetic(town.geo, place)[:, :2]
    names = ("x", "y", "z", "latitude", "longitude")
    rows = np.column_stack((place, earth)).tolist()
    return [dict(zip(names, [None if value != value else value for value in row], strict=True)) for row in rows]


CELL_REPORT = "coverage.json"  # in the folder of a report
MATRIX = "matrix.html"


@dataclass(frozen=True)
class DomainCoverage(Record):
    """Coverage of a domain by recordings, and a detector's errors by cell."""

    domain: str
    revision: str | None  # digest of the domain's files
    runs: int
    grade: float  # mean over `attributes`
    attributes: tuple[Covered, ...]
    by: tuple[str, ...]  # attributes that define the cells
    cells: tuple[CellErrors, ...]  # empty without a detector
    covered_cells: int  # in the matrix of the first two attributes of `by`
    inside_cells: int  # cells of the matrix inside the domain

    @property
    def sentences(self) -> tuple[str, str]:
        """Return the coverage of buckets and of cells of the matrix in words."""
        leaves = " x ".join(name.rpartition(".")[2] for name in self.by[:2])
        share = f"{self.covered_cells / self.inside_cells:.0%}, " if self.inside_cells else ""
        return (
            f"{self.domain}: {plural(self.runs, 'run')}, mean coverage {self.grade:.0%} of buckets inside, over "
            f"{plural(len(self.attributes), 'attribute')}",
            f"{leaves}: {share}{self.covered_cells} of {plural(self.inside_cells, 'cell')} inside",
        )


def cover_domain(
    domain: Domain,
    folders: Sequence[Path],
    out: Path,
    by: tuple[str, str],
    *,
    network: Second | None = None,
    range_m: float = 40.0,
    progress: Report = ignore_progress,
) -> DomainCoverage:
    """Return the coverage of a domain by recordings, and write coverage.json, matrix.html and runs/*.json to `out`.

    It is over the attributes that the domain tests and those of `by`. An object detector `network` is tested on the
    vehicles' frames with its sensors: AP, errors and failures by cell of the attributes `by` over all recordings, and
    the pole whose sensor of range `range_m` [m] covers the most errors. Raises `InputError` where the domain tests an
    attribute that nothing measures, and for an attribute of `by` without buckets.
    """
    domain.require_bound()
    axes = [full_name(domain, name) for name in by]
    documents: dict[str, Document] = {}
    tested: list[Trial] = []
    outcomes: list[Outcomes] = []
    for number, folder in enumerate(folders):
        data = Dataset.open(folder)
        measured = measure_domain(data)
        failures = None
        if network is not None:
            cells = dict(zip(measured.frames, cells_of(domain, measured, axes), strict=True))
            trial, of_trial = _detect(network, data, cells, progress)
            tested.append(trial)
            outcomes.append(of_trial)
            failures = trial.failures
        runs = collect_runs(domain, data, measured, failures)
        documents |= {f"{number}_{name}" if len(folders) > 1 else name: document for name, document in runs.items()}
    every_run = list(documents.values())
    covered = tuple(row for row in list_covered(merge_runs(every_run)) if row.attribute in {*domain.tested, *axes})
    grade = float(np.mean([row.grade for row in covered])) if covered else 0.0
    cells = measure_cells(OBJECTS.measure, join_outcomes(outcomes), tested, range_m) if tested else []
    revision = domain.definition.revision
    counts = count_cells(every_run, axes[0], axes[1])
    result = DomainCoverage(domain.name, revision, len(documents), grade, covered, tuple(axes), tuple(cells), *counts)
    write_runs(documents, out)
    write_matrix(every_run, axes[0], axes[1], f"{domain.name}: {' x '.join(by)}", result.sentences, out / MATRIX)
    write_json(out / CELL_REPORT, result.as_json(), sort=False)
    return result


def _detect(
    network: Second, data: Dataset, cells: Mapping[int, tuple[str, ...]], progress: Report
) -> tuple[Trial, Outcomes]:
    """Return a detector's errors and outcomes on the frames of a recording that have its sensors."""
    fitting = set(choose_frames(OBJECTS, network.config, data).frames)
    frames = [i for i in cells if i in fitting]
    total = 2 * len(frames)
    outcomes = OBJECTS.outcomes(network, data, frames, lambda done, _, note: progress(done, total, note))
    registry = OBJECTS.register_errors(
        network, data, frames, progress=lambda done, _, note: progress(len(frames) + done, total, note)
    )
    found = dict(registry.found or {})
    return Trial(data.town(), cells, found, find_failures(data, found)), outcomes
