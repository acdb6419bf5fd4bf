"""From a domain to where a network errs to where to look: coverage by recordings, errors by cell, poles."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.odd.cells import CellErrors, cells_of, find_failures, full_name, measure_cells
from flcav.odd.coverage import Covered, Document, collect_runs, list_covered, merge_runs, write_matrix, write_runs
from flcav.odd.domain import Domain
from flcav.odd.measure import measure, scenery_of
from flcav.perception.agents import choose_frames
from flcav.perception.errors import PerceptionError
from flcav.perception.networks import resolve_network
from flcav.perception.objects.task import OBJECTS
from flcav.storage.files import write_json
from flcav.storage.records import Record

CELL_REPORT = "coverage.json"  # in the folder of a report
MATRIX = "matrix.html"


@dataclass(frozen=True)
class Coverage(Record):
    """Coverage of a domain by recordings, and a detector's errors by cell."""

    domain: str
    revision: str | None  # digest of the domain's files
    runs: int
    grade: float  # mean over attributes with buckets
    attributes: tuple[Covered, ...]
    by: tuple[str, ...]  # the attributes of cells
    cells: tuple[CellErrors, ...]  # empty where no detector ran


def cover_domain(
    domain: Domain,
    folders: Sequence[Path],
    out: Path,
    by: tuple[str, str],
    *,
    detect: bool = False,
    weights: Path | None = None,
    range_m: float = 40.0,
    device: str = "auto",
    progress: Report = ignore_progress,
) -> Coverage:
    """Return how much of a domain recordings cover; writes coverage.json, matrix.html and runs/*.json to `out`.

    With `detect` the detector of objects runs on the vehicles' frames that fit it: AP, errors and failures by cell of
    the attributes `by`. Poles are those of each recording's own town, so that rows are by cell and recording.
    """
    domain.require_bound()
    axes = [full_name(domain, name) for name in by]
    documents: dict[str, Document] = {}
    cells: list[CellErrors] = []
    for number, folder in enumerate(folders):
        data = Dataset.open(folder)
        measured = measure(data, scenery=scenery_of(data))
        failures = None
        if detect:
            of_frame = dict(zip(measured.frames, cells_of(domain, measured, axes), strict=True))
            rows, failures = _detect(data, of_frame, weights, device, range_m, progress)
            cells += rows
        own = collect_runs(domain, data, measured, failures)
        documents |= {f"{number}_{name}" if len(folders) > 1 else name: document for name, document in own.items()}
    covered = list_covered(merge_runs(list(documents.values())))
    grade = float(np.mean([row.grade for row in covered])) if covered else 0.0
    result = Coverage(
        domain.name, domain.definition.revision, len(documents), grade, covered, tuple(axes), tuple(cells)
    )
    write_runs(documents, out)
    write_matrix(list(documents.values()), axes[0], axes[1], f"{domain.name}: {' x '.join(by)}", out / MATRIX)
    write_json(out / CELL_REPORT, result.as_json(), sort=False)
    return result


def _detect(
    data: Dataset,
    cells: dict[int, tuple[str, ...]],
    weights: Path | None,
    device: str,
    range_m: float,
    progress: Report,
) -> tuple[list[CellErrors], dict[int, bool]]:
    """Return a detector's errors by cell, and whether each of the frames that fit it has a failure."""
    network = resolve_network(OBJECTS, weights, device)
    fitting = set(choose_frames(OBJECTS, network.config, data).frames)
    frames = [i for i in cells if i in fitting]
    total = 2 * len(frames)
    outcomes = OBJECTS.outcomes(network, data, frames, lambda done, _, note: progress(done, total, note))
    registry = OBJECTS.register_errors(
        network, data, frames, progress=lambda done, _, note: progress(len(frames) + done, total, note)
    )
    found: dict[int, Sequence[PerceptionError]] = dict(registry.found or {})
    failures = find_failures(data, found)
    return measure_cells(OBJECTS, outcomes, found, failures, cells, data.town(), range_m), failures
