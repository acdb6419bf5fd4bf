"""The operational design domain that a candidate is tested in: ranges of the test frames, and cells of ASAM OpenODD."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flcav.dataset.store import Dataset
from flcav.odd.cells import cells_of, full_name
from flcav.odd.coverage import Document, collect_runs, list_covered, merge_runs
from flcav.odd.domain import Domain
from flcav.odd.judge import INSIDE, OUTSIDE, UNKNOWN, judge_frames
from flcav.odd.measure import measure_domain
from flcav.perception.objects.truth import FrameTruth
from flcav.releases.verification.records import OddCoverage, VerifiedDomain
from flcav.releases.verification.testing import VerificationFrame

ODD, BY = "urban", ("junction", "visibility")


def describe_domain(
    frames: Sequence[VerificationFrame], truths: Sequence[FrameTruth], classes: Sequence[str], odd: OddCoverage
) -> VerifiedDomain:
    """Return the domain that frames cover, for a network of `classes`."""
    opened = {folder: Dataset.open(folder, checked=False) for folder in {each.data for each in frames}}
    read = [opened[each.data].frame(each.number) for each in frames]
    weather = [frame.weather for frame in read if frame.weather is not None]
    speeds = [np.linalg.norm(np.nan_to_num(frame.annotations.velocity), axis=1) for frame in read]
    far = [np.hypot(truth.targets.center[:, 0], truth.targets.center[:, 1]) for truth in truths]
    return VerifiedDomain(
        towns=tuple(sorted({each.town for each in frames})),
        scenarios=tuple(sorted({each.scenario for each in frames})),
        weathers=tuple(sorted({truth.weather for truth in truths if truth.weather is not None})),
        visibility_m=_span([each.visibility_m for each in weather]),
        rain_mm_h=_span([each.rain_mm_h for each in weather]),
        sun_elevation_deg=_span([each.sun_elevation_deg for each in weather]),
        speed_m_s=_span(np.concatenate(speeds).tolist()) or (0.0, 0.0),
        distance_m=_span(np.concatenate(far).tolist()) or (0.0, 0.0),
        objects={label: int(sum((truth.targets.label == label).sum() for truth in truths)) for label in classes},
        lidars=tuple(sorted({str(name) for frame in read for name in frame.lidar})),
        odd=odd,
    )


def find_cells(
    frames: Sequence[VerificationFrame], domain: Domain, by: Sequence[str]
) -> tuple[tuple[str, ...], OddCoverage]:
    """Return the cell of each frame by two attributes of a domain, and how much of the domain the frames cover.

    Raises `InputError` for an attribute without buckets, and where nothing measures what the domain tests.
    """
    axes = [full_name(domain, name) for name in by]
    folders = dict.fromkeys(each.data for each in frames)
    cells: dict[tuple[Path, int], str] = {}
    counts: dict[str, int] = {INSIDE: 0, OUTSIDE: 0, UNKNOWN: 0}
    documents: dict[str, Document] = {}
    for number, folder in enumerate(folders):
        data = Dataset.open(folder, checked=False)
        measured = measure_domain(data, [each.number for each in frames if each.data == folder])
        names = (" x ".join(cell) for cell in cells_of(domain, measured, axes))
        cells |= {(folder, frame): name for frame, name in zip(measured.frames, names, strict=True)}
        verdicts = judge_frames(domain, measured)
        for verdict in counts:
            counts[verdict] += verdicts.count(verdict)
        documents |= {f"{number}_{name}": run for name, run in collect_runs(domain, data, measured).items()}
    wanted = {*domain.tested, *axes}
    rows = [row for row in list_covered(merge_runs([*documents.values()])) if row.attribute in wanted]
    coverage = OddCoverage(
        domain=domain.name,
        revision=domain.definition.revision,
        by=tuple(by),
        frames=counts,
        grade=float(np.mean([row.grade for row in rows])) if rows else 0.0,
        holes={row.attribute.rpartition(".")[2]: row.holes for row in rows if row.holes},
    )
    return tuple(cells[each.data, each.number] for each in frames), coverage


def _span(values: Sequence[float]) -> tuple[float, float] | None:
    return (round(min(values), 3), round(max(values), 3)) if len(values) else None
