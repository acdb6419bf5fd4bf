"""Judgement of frames by a domain, three-valued: inside, outside, or unknown where the verdict rests on missing values.

OpenODD 1.0 counts what rests on missing values as inside; here it never is.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.interface.wording import plural
from flcav.odd.domain import Domain, Value
from flcav.odd.measure import Measurements
from flcav.statistics.estimates import Estimate, score_interval
from flcav.storage.records import Record, write_any_table

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

    @property
    def sentence(self) -> str:
        """Return the counts in words."""
        counts = ", ".join(f"{self.count(word)} {word}" for word in (INSIDE, OUTSIDE, UNKNOWN))
        return f"{plural(len(self.frames), 'frame')}: {counts}"

    def as_json(self) -> dict[str, Json]:
        """Return the counts as a JSON object."""
        counts = {word: self.count(word) for word in (INSIDE, OUTSIDE, UNKNOWN)}
        return {"frames": len(self.frames), **counts, "modules": dict(self.failed)}


@dataclass(frozen=True)
class Rates(Record):
    """Precision and recall of one verdict, with Wilson's intervals; None if it was never given, or never true."""

    precision: Estimate | None
    recall: Estimate | None


@dataclass(frozen=True)
class Agreement(Record):
    """How often perceived verdicts are right, on the frames that truth decides, dependent as those of a scene are."""

    frames: int
    inside: Rates
    outside: Rates
    undecided: int  # frames that perception leaves unknown


def describe_agreement(agreement: Agreement) -> list[str]:
    """Return the agreement in words."""
    rows = []
    for name, rates in ((INSIDE, agreement.inside), (OUTSIDE, agreement.outside)):
        words = ["-" if each is None else each.describe() for each in (rates.precision, rates.recall)]
        rows.append(f"{name}: precision {words[0]}, recall {words[1]}")
    return [*rows, f"{plural(agreement.undecided, 'frame')} left unknown of {agreement.frames} that truth decides"]


def write_verdicts(data: Dataset, truth: Verdicts, seen: Verdicts | None, path: Path) -> None:
    """Write a table, CSV or Parquet: frame, verdict, and the perceived verdict where there is one."""
    columns = {"frame": [data.name(i) for i in truth.frames], "verdict": truth.verdict.tolist()}
    write_any_table(pa.table(columns if seen is None else columns | {"perceived": seen.verdict.tolist()}), path)


def judge_values(domain: Domain, measured: Mapping[str, Value]) -> str:
    """Return the verdict on one row of measured columns; a column that is not there is missing."""
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

    def rate(of: str) -> Rates:
        said, is_so = found == of, wanted == of
        shares = (
            score_interval(float((said & is_so).sum() / every.sum()), int(every.sum())) if every.any() else None
            for every in (said, is_so)
        )
        return Rates(*shares)

    return Agreement(int(decided.sum()), rate(INSIDE), rate(OUTSIDE), int((found == UNKNOWN).sum()))
