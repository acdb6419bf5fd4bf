"""Records of a verification: overall comparison, guards of slices, tested domain, and decision."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from flcav.interface.wording import plural
from flcav.storage.records import Record

LEAST_MEASURE = 0.05  # least measure of the driving network in a judged slice
Judgement = Literal["kept", "lost", "open"]


@dataclass(frozen=True)
class Comparison:
    """A measure of driving network and candidate on the same frames, with the interval of the difference."""

    by: str  # whole, class, distance, occlusion, weather, scenario, town, cell, condition, measure; those of `guards`
    name: str
    targets: int
    scenes: int
    driving: float
    candidate: float
    candidate_low: float  # ends of the candidate's 95 % interval over scenes; NaN: undefined
    candidate_high: float
    low: float  # ends of the 90 % interval of candidate minus driving, one-sided bounds at .05
    high: float
    spare: float | None  # of a guard: upper bound of the candidate's distance to the limit; None: not judged
    judgement: Judgement  # of a guard: lost (refused) if `spare` is below 0; kept; or open: too few frames to decide


@dataclass(frozen=True)
class OddCoverage:
    """The coverage of an operational design domain (ASAM OpenODD) by the test frames."""

    domain: str
    revision: str | None  # digest of the domain's files
    by: tuple[str, ...]  # the two attributes of cells
    frames: Mapping[str, int]  # inside, outside, unknown
    grade: float  # share of the buckets inside the domain that are covered, mean over its attributes
    holes: Mapping[str, tuple[str, ...]]  # buckets inside the domain without a frame, by attribute

    def describe(self) -> str:
        """Return the coverage in words."""
        frames = ", ".join(f"{count} {verdict}" for verdict, count in self.frames.items())
        missing = "; ".join(f"{name} {', '.join(buckets)}" for name, buckets in self.holes.items())
        return f"{self.domain}: frames {frames}; {self.grade:.0%} of its buckets, not {missing or '-'}"


@dataclass(frozen=True)
class VerifiedDomain:
    """The tested operational design domain of a candidate: ranges of conditions in the test frames."""

    towns: tuple[str, ...]
    scenarios: tuple[str, ...]
    weathers: tuple[str, ...]
    visibility_m: tuple[float, float] | None  # least and most, as in the following [m]
    rain_mm_h: tuple[float, float] | None  # [mm/h]
    sun_elevation_deg: tuple[float, float] | None  # [degrees]
    speed_m_s: tuple[float, float]  # of the objects [m/s]
    distance_m: tuple[float, float]  # of the targets from the LiDAR [m]
    objects: Mapping[str, int]  # targets by class
    lidars: tuple[str, ...]  # names of the rigs or sensors
    odd: OddCoverage


@dataclass(frozen=True)
class VerificationData:
    """A test dataset."""

    name: str
    manifest: str  # SHA-256
    town: str | None
    seed: int | None
    frames: int
    scenes: int


@dataclass(frozen=True)
class CandidateVerification(Record):
    """The verification of a candidate against the driving network: accepted, or refused with reasons."""

    candidate: str  # SHA-256 of the weights
    driving: str
    accepted: bool
    reasons: tuple[str, ...]  # of the refusal; () where accepted
    undecided: bool  # refused because there are too few frames to decide
    margin: float  # largest acceptable loss of AP50
    kept_share: float  # of the driving network's measure that a slice must keep
    frames: int
    scenes: int
    frames_to_decide: int | None  # None if decided, or if no number suffices
    whole: Comparison | None  # None if refused because of its files
    guards: tuple[Comparison, ...]
    data: tuple[VerificationData, ...]
    domain: VerifiedDomain | None

    def lines(self) -> list[str]:
        """Return the verification in words."""
        lines = []
        if self.whole is not None:
            each = self.whole
            lines.append(
                f"AP50 {each.driving:.3f} -> {each.candidate:.3f}, {each.candidate - each.driving:+.3f} "
                f"({each.low:+.3f} to {each.high:+.3f}) over {plural(self.frames, 'frame')} of "
                f"{plural(self.scenes, 'scene')}; margin {self.margin:g}"
            )
            kept = [guard for guard in self.guards if guard.judgement == "kept"]
            lines.append(f"guards kept: {len(kept)} of {len(self.guards)}; the others:")
            for guard in self.guards:
                if guard.judgement == "kept":
                    continue
                lines.append(
                    f"{guard.by:<10}{guard.name:<44}{guard.driving:.3f} -> {guard.candidate:.3f}  "
                    f"({guard.low:+.3f} to {guard.high:+.3f})  {guard.judgement}  (objects: {guard.targets})"
                )
        if self.domain is not None:
            lists = ("; ".join(each) for each in (self.domain.towns, self.domain.scenarios, self.domain.weathers))
            lines.append(f"tested in {' | '.join(lists)} | {self.domain.odd.describe()}")
        more = (
            f"; about {self.frames_to_decide} frames would decide" if self.undecided and self.frames_to_decide else ""
        )
        verdict = "accepted" if self.accepted else "undecided, so refused" if self.undecided else "refused"
        return [*lines, verdict if self.accepted else f"{verdict}: {'; '.join(self.reasons)}{more}"]
