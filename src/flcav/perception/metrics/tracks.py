"""CLEAR MOT metrics of multi-object tracking (MOTA, MOTP), and AMOTA.

MOTA is one minus misses, false positives and identity switches per object to be tracked (Bernardin and Stiefelhagen,
"Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics", 2008). AMOTA is the mean of scaled MOTA over
40 recalls, each reached by leaving out the tracks of lowest score (Weng et al., "3D Multi-Object Tracking: A Baseline
and New Evaluation Metrics", IROS 2020, eqs. 4-5).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from flcav.arrays import Array, Ints, Mask, Words
from flcav.interface.wording import plural
from flcav.perception.task import Result
from flcav.storage.records import Class

RECALLS = np.arange(1, 41) / 40
APART_M = 2.0  # largest distance in the plane between the centres of an object and its track, as in nuScenes


@dataclass(frozen=True)
class TrackingFrame:
    """Ground truth and tracks of a class in one frame of a sequence; positions in one coordinate frame [m]."""

    objects: Words  # (M,) identity of each object to be tracked
    places: Array  # (M, 2) position x, y of each object
    tracks: Ints  # (N,) identity of each track
    found: Array  # (N, 2) position x, y of each track
    score: Array  # (N,) score of the whole track
    neutral: Mask  # (N,) whether the track lies on a neutral object: no false positive


@dataclass(frozen=True)
class ClearMot:
    """CLEAR MOT counts, summed over all frames."""

    objects: int  # objects to be tracked
    misses: int
    false_positives: int
    switches: int  # identity switches
    distance_m: float  # sum of the distances of objects from their tracks

    @property
    def hits(self) -> int:
        """Return the number of pairs of an object and its track."""
        return self.objects - self.misses

    @property
    def mota(self) -> float:
        """Return the multiple object tracking accuracy (MOTA), at most 1; NaN without objects."""
        wrong = self.misses + self.false_positives + self.switches
        return 1 - wrong / self.objects if self.objects else float("nan")

    @property
    def motp_m(self) -> float:
        """Return the multiple object tracking precision (MOTP): mean distance of the pairs [m]; NaN without pairs."""
        return self.distance_m / self.hits if self.hits else float("nan")


@dataclass(frozen=True)
class TrackScore:
    """Tracking metrics of one class; None where there are no objects, pairs or velocities to compute one from."""

    label: Class
    objects: int  # to be tracked, summed over frames
    mota: float | None
    amota: float | None
    motp_m: float | None  # mean distance of an object from its track [m]
    misses: int
    false_positives: int
    id_switches: int
    velocity_error_mps: float | None  # mean over tracks within 1 m of an object, in the plane [m/s]


@dataclass(frozen=True)
class TracksEvaluation(Result):
    """Evaluation of tracking on sequences of frames."""

    sequences: int  # one per scene and agent
    frames: int
    scores: tuple[TrackScore, ...]  # one per class

    def lines(self) -> list[str]:
        """Return the evaluation in words: frames and sequences, then a line per class."""
        lines = [f"tracks in {plural(self.frames, 'frame')} of {plural(self.sequences, 'sequence')}"]
        for row in self.scores:
            if row.mota is None:
                lines.append(f"{row.label:<12}nothing to follow")
                continue
            wrong = f"{row.misses} misses, {row.false_positives} false positives, {row.id_switches} id switches"
            speed = "" if row.velocity_error_mps is None else f", velocity off by {row.velocity_error_mps:.2f} m/s"
            lines.append(f"{row.label:<12}MOTA {row.mota:.3f}  AMOTA {row.amota:.3f}  {wrong}{speed}")
        return lines


def count_clear_mot(
    sequences: Sequence[Sequence[TrackingFrame]], threshold: float = -np.inf, apart_m: float = APART_M
) -> ClearMot:
    """Return the CLEAR MOT counts of the tracks that score at least `threshold`.

    `sequences` holds the frames of each sequence, in time order. A pair of the preceding frame is kept while it is
    within `apart_m` [m]; other objects and tracks are paired by the Hungarian method with least total distance.
    """
    counts = np.zeros(4, dtype=np.int64)
    distance = 0.0
    for moments in sequences:
        last: dict[str, int] = {}  # object -> its latest track
        for moment in moments:
            kept = np.flatnonzero(moment.score >= threshold)
            apart = np.linalg.norm(moment.places[:, None] - moment.found[None, kept], axis=2)
            pairs = _pairs(moment, kept, apart, last, apart_m)
            switched = 0
            for o, t in pairs:
                identity, track = str(moment.objects[o]), int(moment.tracks[kept[t]])
                switched += last.get(identity, track) != track
                last[identity] = track
                distance += float(apart[o, t])
            taken = [t for _, t in pairs]
            idle = np.delete(moment.neutral[kept], taken)
            counts += (len(moment.objects), len(moment.objects) - len(pairs), int((~idle).sum()), switched)
    objects, misses, wrong, switches = counts.tolist()
    return ClearMot(objects, misses, wrong, switches, distance)


def amota(sequences: Sequence[Sequence[TrackingFrame]], apart_m: float = APART_M) -> float:
    """Return AMOTA in [0, 1], the mean of scaled MOTA over 40 recalls; NaN without objects.

    A recall that is not reached counts 0. Thresholds are the scores of the tracks, at most 200 quantiles of them.
    """
    everything = count_clear_mot(sequences, apart_m=apart_m)
    if not everything.objects:
        return float("nan")
    scores = sorted({float(s) for moments in sequences for moment in moments for s in moment.score}, reverse=True)
    scores = scores if len(scores) <= 200 else list(np.quantile(scores, np.linspace(1, 0, 200)))
    reached = [count_clear_mot(sequences, score, apart_m) for score in scores]
    values = []
    for recall in RECALLS:
        enough = [counts for counts in reached if counts.hits >= recall * counts.objects - 1e-9]
        values.append(_scaled_mota(enough[0], recall) if enough else 0.0)
    return float(np.mean(values))


def _scaled_mota(counts: ClearMot, recall: float) -> float:
    wanted = recall * counts.objects
    wrong = counts.switches + counts.false_positives + counts.misses - (1 - recall) * counts.objects
    return float(np.clip(1 - wrong / wanted, 0, 1))


def _pairs(
    moment: TrackingFrame, kept: Ints, apart: Array, last: dict[str, int], apart_m: float
) -> list[tuple[int, int]]:
    """Return the pairs (index of an object, index into `kept`) of one frame; apart (M, K): their distances [m]."""
    place = {int(track): t for t, track in enumerate(moment.tracks[kept])}
    pairs = []
    for o, identity in enumerate(moment.objects):
        t = place.get(last.get(str(identity), -1))
        if t is not None and apart[o, t] <= apart_m and t not in (taken for _, taken in pairs):
            pairs.append((o, t))
    left = np.where(apart <= apart_m, apart, 1e6)
    left[[o for o, _ in pairs]] = 1e6
    left[:, [t for _, t in pairs]] = 1e6
    more = zip(*linear_sum_assignment(left), strict=True)
    return pairs + [(int(o), int(t)) for o, t in more if left[o, t] <= apart_m]
