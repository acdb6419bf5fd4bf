"""Judgement of frames by a domain, three-valued: inside, outside, or unknown where the verdict rests on missing values.

OpenODD 1.0 counts what rests on missing values as inside; here it never is.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.odd.domain import Domain, Value
from flcav.odd.measure import Measurements
from flcav.statistics.estimates import Estimate, score_interval

INSIDE, OUTSIDE, UNKNOWN = "inside", "outside", "unknown"


@dataclass(frozen=True)
class Verdicts:
    """The verdict of a domain on each of F frames."""

    frames: tuple[int, ...]
    verdict: NDArray[np.str_]  # (F,) inside, outside or unknown
    failed: Mapping[str, int]  # module -> frames that it puts outside; those that only join others are left out

    def count(self, verdict: str) -> int:
        """Return how many frames have that verdict."""
        return int((self.verdict == verdict).sum())


@dataclass(frozen=True)
class Agreement:
    """How often perceived verdicts are right, with intervals: of frames, and not independent within a scene."""

    frames: int  # that truth decides
    inside: tuple[Estimate | None, Estimate | None]  # precision and recall of "inside"
    outside: tuple[Estimate | None, Estimate | None]  # of "outside"
    undecided: int  # frames that perception leaves unknown


def judge_values(domain: Domain, measured: Mapping[str, Value]) -> str:
    """Return the verdict on one row of measured columns."""
    verdict = domain.definition.evaluate(domain.definition.complete(domain.values(measured)))
    return OUTSIDE if not verdict.inside else UNKNOWN if verdict.assumed else INSIDE


def judge(domain: Domain, measured: Measurements) -> Verdicts:
    """Return the verdict on each frame, and which modules put frames outside.

    Raises `InputError` where the domain tests an attribute that nothing measures.
    """
    domain.require_bound()
    odd = domain.definition
    leaves = {module.name for module in odd.modules
              if any(each.attributes() for each in module.conditions())}  # fmt: skip
    verdicts, failed = [], Counter[str]()
    for row in measured.rows():
        found = odd.evaluate(odd.complete(domain.values(row)))
        verdicts.append(OUTSIDE if not found.inside else UNKNOWN if found.assumed else INSIDE)
        failed.update(name for name, holds in found.modules.items() if holds is False and name in leaves)
    return Verdicts(measured.frames, np.array(verdicts, dtype=np.str_), dict(failed.most_common()))


def compare_verdicts(truth: Sequence[str], perceived: Sequence[str]) -> Agreement:
    """Return how well perceived verdicts match those of truth, on the frames that truth decides."""
    wanted, found = np.asarray(truth), np.asarray(perceived)
    decided = wanted != UNKNOWN
    wanted, found = wanted[decided], found[decided]

    def rate(of: str) -> tuple[Estimate | None, Estimate | None]:
        said, is_so = found == of, wanted == of
        return tuple(
            score_interval(float((said & is_so).sum() / all_of.sum()), int(all_of.sum())) if all_of.any() else None
            for all_of in (said, is_so)
        )  # type: ignore[return-value]

    return Agreement(int(decided.sum()), rate(INSIDE), rate(OUTSIDE), int((found == UNKNOWN).sum()))
