"""From a domain to where a network errs to where to look: coverage by recordings, errors by cell, poles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.odd.cells import CellErrors, Trial, cells_of, find_failures, full_name, measure_cells
from flcav.odd.coverage import Covered, Document, collect_runs, list_covered, merge_runs, write_matrix, write_runs
from flcav.odd.domain import Domain
from flcav.odd.measure import measure
from flcav.perception.agents import choose_frames
from flcav.perception.networks import resolve_network
from flcav.perception.objects.evaluate import join_outcomes
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import Outcomes
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
    grade: float  # mean over these attributes
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

    Covered are the attributes that the domain tests, and those of `by`. With `detect` the detector of objects runs on
    the vehicles' frames that fit it: AP, errors and failures by cell of the attributes `by`, over all recordings.
    """
    domain.require_bound()
    axes = [full_name(domain, name) for name in by]
    network = resolve_network(OBJECTS, weights, device) if detect else None
    documents: dict[str, Document] = {}
    tested: list[Trial] = []
    outcomes: list[Outcomes] = []
    for number, folder in enumerate(folders):
        data = Dataset.open(folder)
        measured = measure(data)
        failures = None
        if network is not None:
            cells = dict(zip(measured.frames, cells_of(domain, measured, axes), strict=True))
            found, own = _detect(network, data, cells, progress)
            tested.append(found)
            outcomes.append(own)
            failures = found.failures
        runs = collect_runs(domain, data, measured, failures)
        documents |= {f"{number}_{name}" if len(folders) > 1 else name: document for name, document in runs.items()}
    every = list_covered(merge_runs(list(documents.values())))
    covered = tuple(row for row in every if row.attribute in {*domain.tested, *axes})
    grade = float(np.mean([row.grade for row in covered])) if covered else 0.0
    cells = measure_cells(OBJECTS.measure, join_outcomes(outcomes), tested, range_m) if tested else []
    result = Coverage(
        domain.name, domain.definition.revision, len(documents), grade, covered, tuple(axes), tuple(cells)
    )
    write_runs(documents, out)
    write_matrix(list(documents.values()), axes[0], axes[1], f"{domain.name}: {' x '.join(by)}", out / MATRIX)
    write_json(out / CELL_REPORT, result.as_json(), sort=False)
    return result


def _detect(
    network: Second, data: Dataset, cells: Mapping[int, tuple[str, ...]], progress: Report
) -> tuple[Trial, Outcomes]:
    """Return a detector's errors on a recording's frames that fit it, and its outcomes there."""
    fitting = set(choose_frames(OBJECTS, network.config, data).frames)
    frames = [i for i in cells if i in fitting]
    total = 2 * len(frames)
    outcomes = OBJECTS.outcomes(network, data, frames, lambda done, _, note: progress(done, total, note))
    registry = OBJECTS.register_errors(
        network, data, frames, progress=lambda done, _, note: progress(len(frames) + done, total, note)
    )
    found = dict(registry.found or {})
    return Trial(data.town(), cells, found, find_failures(data, found)), outcomes
