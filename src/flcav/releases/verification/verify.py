"""Verification of a candidate: its files, overall non-inferiority, and guards against large losses in slices."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.config import InputError, read_json
from flcav.dataset.store import Dataset
from flcav.geometry import Boxes
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.odd.cells import cells_of, full_name
from flcav.odd.coverage import Document, collect_runs, list_covered, merge_runs
from flcav.odd.domain import Domain, read_domain
from flcav.odd.judge import INSIDE, OUTSIDE, UNKNOWN, judge_frames
from flcav.odd.measure import measure_domain
from flcav.perception.errors import THRESHOLD
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth
from flcav.perception.weights import load_network
from flcav.releases.candidate import VERIFICATION, WEIGHTS, Candidate, read_candidate
from flcav.releases.verification.comparison import (
    KEPT,
    LEAST_SCENES,
    LEAST_TARGETS,
    LEVEL,
    MeasuredNetwork,
    compare_pair,
    draw_scenes,
    list_frame_slices,
    measure_results,
    pair_slices,
    pair_whole,
)
from flcav.releases.verification.files import describe_data, find_faults
from flcav.releases.verification.guards import pair_classes
from flcav.releases.verification.records import (
    LEAST_MEASURE,
    CandidateVerification,
    Comparison,
    OddCoverage,
    VerificationData,
    VerifiedDomain,
)
from flcav.releases.verification.testing import (
    CONDITIONS,
    PLAIN,
    ConditionResults,
    VerificationFrame,
    choose_test_frames,
    run_tests,
)
from flcav.statistics.power import plan_scenes
from flcav.storage.files import sha256, write_json

ODD, BY = "urban", ("junction", "visibility")


def describe_domain(
    frames: Sequence[VerificationFrame], truths: Sequence[FrameTruth], classes: Sequence[str], odd: OddCoverage
) -> VerifiedDomain:
    """Return the domain covered by frames, for a network with `classes`."""
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
    """Return the frames' cells by two attributes of a domain, and the frames' coverage of the domain.

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


MARGIN, MOST_MARGIN = 0.05, 0.5  # of AP50
LEAST_SEEN = 3  # detections of the driving network in a frame from which on the candidate must detect something
GUARD_REDRAWS = 200  # bootstrap samples per guard
Results = Mapping[str, ConditionResults]  # by condition


def verify(
    folder: Path,
    driving: Path,
    data: Sequence[Path],
    *,
    margin: float = MARGIN,
    most: int | None = None,
    odd: str | Path = ODD,
    by: Sequence[str] = BY,
    jobs: int = 1,
    known: Results | None = None,
    progress: Report = ignore_progress,
) -> CandidateVerification:
    """Return the verification of a candidate against the driving network.

    Args:
        folder: the candidate.
        driving: weights of the driving network.
        data: datasets with scenes on which no network was trained.
        margin: largest acceptable loss of AP50 over all frames.
        most: limit of frames per dataset; None: all.
        odd: operational design domain, by name or as an OpenODD file, whose coverage is reported.
        by: two of its attributes: pairs of their buckets are cells, which are slices.
        jobs: worker processes.
        known: results of the driving network on the same frames, from an earlier verification.
        progress: callback with the tests done and in total.

    Raises:
        InputError: for no candidate, another task than objects, no frames, and datasets that do not fit.
    """
    candidate = read_candidate(folder)
    if candidate.task != OBJECTS.name:
        raise InputError(f"{folder}: a network of '{candidate.task}', and those of '{OBJECTS.name}' are verified")
    network = load_network(OBJECTS, driving)
    allowed = read_domain(odd)
    frames = choose_test_frames(data, network, most)
    if not frames:
        raise InputError(f"no frame to verify with in {', '.join(map(str, data))}")
    cells, coverage = find_cells(frames, allowed, by)
    frames = tuple(replace(frame, cell=cell) for frame, cell in zip(frames, cells, strict=True))
    tested = [_describe(path, frames) for path in data]
    faults = list(find_faults(folder, candidate, driving, tested))
    if faults:
        return decide_on_candidate(candidate, None, None, tested, None, margin, faults)
    missing = [] if known is not None else [driving]
    results = run_tests([*missing, folder / WEIGHTS], frames, jobs=jobs, progress=progress)
    old, new = known if known is not None else results[0], results[-1]
    if not any(len(truth.targets) for truth in new[PLAIN].truths):
        raise InputError(f"no object to be found in {', '.join(map(str, data))}")
    domain = describe_domain(frames, new[PLAIN].truths, network.config.classes, coverage)
    return decide_on_candidate(candidate, old, new, tested, domain, margin)


def decide_on_candidate(
    candidate: Candidate,
    driving: Results | None,
    new: Results | None,
    data: Sequence[VerificationData],
    domain: VerifiedDomain | None,
    margin: float = MARGIN,
    faults: Sequence[str] = (),
) -> CandidateVerification:
    """Return the decision on a candidate by the results of both networks, or by the faults of its files."""
    frames, scenes = sum(each.frames for each in data), sum(each.scenes for each in data)
    reasons, open_reasons, wanted = list(faults), [], 0
    whole: Comparison | None = None
    guards: list[Comparison] = []
    if driving is not None and new is not None:
        plain = measure_results(driving[PLAIN]), measure_results(new[PLAIN])
        pair = pair_whole(*plain)
        whole, error = compare_pair(pair, draw_scenes(pair.scene))
        for guard in _guard(*plain, driving, new):
            guards.append(guard)
            if guard.judgement == "lost":
                reasons.append(f"{guard.by} {guard.name} lost: {guard.driving:.3f} -> {guard.candidate:.3f}")
        broken = (_find_broken(driving[name], tested, name) for name, tested in new.items())
        reasons += next(filter(None, broken), [])
        for label, count in domain.objects.items() if domain is not None else ():
            if count < LEAST_TARGETS:
                open_reasons.append(f"{plural(count, 'object')} of the class {label}, and {LEAST_TARGETS} are wanted")
                wanted = max(wanted, -(-frames * LEAST_TARGETS // max(count, 1)))
        if whole.driving < LEAST_MEASURE:
            reasons.append(f"AP50 {whole.driving:.3f} of the network that drives: nothing that could be kept")
        if whole.scenes < LEAST_SCENES:
            open_reasons.append(f"{plural(whole.scenes, 'scene')}, and {LEAST_SCENES} are wanted")
            wanted = max(wanted, -(-frames * LEAST_SCENES // whole.scenes))
        change = whole.candidate - whole.driving
        said = f"AP50 on the whole {change:+.3f} ({whole.low:+.3f} to {whole.high:+.3f}), margin {margin:g}"
        if not whole.high >= -margin:
            reasons.append(said)
        elif not whole.low > -margin:
            enough = _frames(change + margin, error, frames, scenes)
            wanted = max(wanted, enough)
            open_reasons.append(said if enough else f"{said}: no number of frames would accept this")
    return CandidateVerification(
        candidate=candidate.weights,
        driving=candidate.driving,
        accepted=not (reasons or open_reasons),
        reasons=(*reasons, *open_reasons),
        undecided=bool(open_reasons) and not reasons,
        margin=margin,
        kept_share=KEPT,
        frames=frames,
        scenes=scenes,
        frames_to_decide=(wanted or None) if not reasons else None,
        whole=whole,
        guards=tuple(guards),
        data=tuple(data),
        domain=domain,
    )


def write_verification(folder: Path, verification: CandidateVerification) -> None:
    """Write the verification into the candidate's folder."""
    write_json(folder / VERIFICATION, verification.as_json(), sort=False)


def read_verification(folder: Path) -> CandidateVerification:
    """Return the verification in a candidate's folder.

    Raises `InputError` if there is none, it is of other weights, or its numbers contradict its acceptance.
    """
    path = folder / VERIFICATION
    if not path.is_file():
        raise InputError(f"{folder}: was not verified")
    found = CandidateVerification.from_json(read_json(path), str(path))
    described = read_candidate(folder)
    if found.candidate != described.weights or sha256(folder / WEIGHTS) != found.candidate:
        raise InputError(f"{path}: is the verification of other weights")
    if found.accepted and found.driving != described.driving and described.rolls_back is None:
        raise InputError(f"{path}: is a verification beside another network than the candidate replaces")
    if found.accepted and not _supports_acceptance(found):
        raise InputError(f"{path}: says that the candidate is accepted, and its own numbers say that it is not")
    return found


def _supports_acceptance(found: CandidateVerification) -> bool:
    """Return whether the numbers of a verification allow its acceptance."""
    # the file only claims acceptance, so its numbers are judged again
    whole = found.whole
    if whole is None or found.reasons or found.undecided or found.kept_share != KEPT:
        return False
    objects = {} if found.domain is None else found.domain.objects
    return (
        0 < found.margin <= MOST_MARGIN
        and -found.margin < whole.low <= whole.high
        and -found.margin < whole.candidate - whole.driving
        and whole.driving >= LEAST_MEASURE
        and min(found.scenes, whole.scenes) >= LEAST_SCENES
        and all(count >= LEAST_TARGETS for count in objects.values())
        and all(map(_is_kept, found.guards))
    )


def _is_kept(guard: Comparison) -> bool:
    return guard.judgement in ("kept", "open") and not (guard.spare is not None and guard.spare < 0)


def _guard(old: MeasuredNetwork, new: MeasuredNetwork, driving: Results, candidate: Results) -> list[Comparison]:
    """Return the comparisons of all guards, judged together."""
    groups = [(name, frames) for by, name, frames in list_frame_slices(new.tested) if by != "cell"]
    pairs = [*pair_slices(old, new), *pair_classes(old, new, groups=groups)]
    for name in CONDITIONS:
        if name in candidate:
            both = measure_results(driving[name]), measure_results(candidate[name])
            pairs += [pair_whole(*both, "condition", name), *pair_classes(*both, name)]
    pairs = [pair for pair in pairs if pair.targets >= LEAST_TARGETS]
    drawn = {len(pair.scene): pair.scene for pair in pairs}  # conditions share a smaller set of frames
    times = {frames: draw_scenes(scene, GUARD_REDRAWS) for frames, scene in drawn.items()}
    found = [compare_pair(pair, times[len(pair.scene)], len(pairs))[0] for pair in pairs]
    return [each for each in found if np.isfinite([each.driving, each.candidate]).all()]


def _find_broken(driving: ConditionResults, candidate: ConditionResults, condition: str) -> list[str]:
    """Return reasons to refuse boxes with NaN, and classes and frames in which nothing is detected any more.

    A class counts if the driving network detects it, rightly or wrongly, and a frame if it detects enough at the score
    threshold in use; all detections of the candidate count, whatever their score.
    """
    where = "" if condition == PLAIN else f" ({condition})"
    reasons = []
    if spoilt := sum(not _is_finite(boxes) for boxes in candidate.detections):
        reasons.append(f"boxes that are no numbers in {plural(spoilt, 'frame')}{where}")
    before, after = (
        Counter(str(label) for boxes in tested.detections for label in boxes.label) for tested in (driving, candidate)
    )
    reasons += [
        f"class {label} is never found{where}: {plural(count, 'detection')} before, none now"
        for label, count in sorted(before.items())
        if not after[label]
    ]
    used = [0 if boxes.score is None else int((boxes.score >= THRESHOLD).sum()) for boxes in driving.detections]
    pairs = zip(used, candidate.detections, strict=True)
    if silent := sum(count >= LEAST_SEEN and not len(boxes) for count, boxes in pairs):
        reasons.append(
            f"nothing at all is found in {plural(silent, 'frame')}{where} in which the driving network finds"
        )
    return reasons


def _is_finite(boxes: Boxes) -> bool:
    known = (boxes.array(), boxes.score, boxes.variance)
    return all(np.isfinite(each).all() for each in known if each is not None)


def _frames(effect: float, error: float, frames: int, scenes: int) -> int:
    """Return the number of frames with which an effect is significant at `LEVEL`; 0 if no number is enough."""
    enough = plan_scenes(effect, error, scenes, LEVEL)
    return 0 if enough is None else int(np.ceil(enough * frames / scenes))


def _describe(path: Path, frames: Sequence[VerificationFrame]) -> VerificationData:
    selected = [each for each in frames if each.data == path]
    data = Dataset.open(path, checked=False)
    return describe_data(data, len(selected), len({data.keys[each.number].scene for each in selected}))
