"""Verdicts on claims and targets from 95 % confidence intervals and corrected p-values, and their wording.

The p-values of all claims of a page are corrected together, so that the probability of any false verdict on a page is
at most 5 % (Holm, "A Simple Sequentially Rejective Multiple Test Procedure", Scandinavian Journal of Statistics 6,
1979).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from flcav.statistics.estimates import Estimate
from flcav.statistics.power import MOST_SEEDS, SampleSize, plan_sample, seeds_to_tell
from flcav.statistics.seeds import LARGEST_SPREAD, LEVEL, MeanOverSeeds, p_value_of_loss
from flcav.storage.markdown import format_table
from flcav.storage.records import LEFT_OUT

HELD, NOT_HELD, UNDECIDED = "held", "did not hold", "undecided"
ESTIMATE = "estimate"  # instead of a verdict, for a difference without a claim
REACHED = {HELD: "reached", NOT_HELD: "not reached", UNDECIDED: UNDECIDED}  # wording for an aim


def verdict(low: float | None, high: float | None) -> str:
    """Return the verdict on the claim that a difference with the interval [low, high] is positive.

    HELD if the interval lies above 0, NOT_HELD if below 0, else UNDECIDED, as without an interval (None).
    """
    if low is None or high is None:
        return UNDECIDED
    if low > 0:
        return HELD
    return NOT_HELD if high < 0 else UNDECIDED


def explain_verdict(decided: str) -> str:
    """Return a clause with the verdict `decided` on a claim of one run."""
    return {
        HELD: "the claim held in this run",
        NOT_HELD: "the claim did not hold in this run",
        UNDECIDED: "the result is inconclusive",
    }[decided]


@dataclass(frozen=True)
class Claim:
    """The claim that a mean over seeds is above `than`, or, if `at_most`, below it."""

    mean: MeanOverSeeds
    than: float = 0.0
    at_most: bool = False


@dataclass(frozen=True)
class Alone:
    """A claim that is decided by its uncorrected p-value, but not by the corrected one."""

    p: float  # not corrected
    ends: tuple[float, float]  # of its simultaneous interval: at `LEVEL` divided by the number of claims


@dataclass(frozen=True)
class Judged:
    """The verdict on one claim of a family that is tested together."""

    verdict: str  # HELD, NOT_HELD or UNDECIDED
    p: float | None  # corrected for the claims of the family; None where the spread over seeds or scenes is not known
    family: int  # number of claims that are tested together
    seeds: int | None  # number that decides an effect as large as observed; None: unknown, or too many
    size: Annotated[SampleSize | None, LEFT_OUT] = None  # the same with test scenes, where seeds share them
    alone: Annotated[Alone | None, LEFT_OUT] = None

    def describe(self, word: str = "seeds") -> str:
        """Return p and the number of claims as text, and for an undecided claim the number of seeds that decides it.

        `word`: the plural of a seed, or of a training.
        """
        if self.p is None:
            return "the spread over seeds is not known"
        corrected = f", corrected for {self.family} claims" if self.family > 1 else ""
        text = f"p {format_p(self.p)}{corrected}{self._tell_alone()}"
        if self.verdict != UNDECIDED:
            return text
        takes = f"about {self.seeds} {word}" if self.seeds else f"more than {MOST_SEEDS} {word}"
        return f"{text}; detecting an effect of this size takes {self.size.describe(word) if self.size else takes}"

    def tell_needs(self, word: str = "seeds") -> str:
        """Return what would decide an undecided claim, as text such as "needs about 7 trainings on 37 scenes"."""
        if self.verdict != UNDECIDED or self.p is None:
            return ""
        if self.size is not None:
            return f"needs {self.size.tell(word)}"
        return f"needs about {self.seeds} {word}" if self.seeds else f"needs more than {MOST_SEEDS} {word}"

    @property
    def p_cell(self) -> str:
        """Return the corrected p for a table, and the uncorrected one of `alone`; empty where p is not known."""
        return "" if self.p is None else f"{format_p(self.p)}{self._tell_alone()}"

    @property
    def takes_cell(self) -> str:
        """Return for a table the number of seeds that decides; empty where the claim is decided, or p is not known."""
        if self.verdict != UNDECIDED or self.p is None:
            return ""
        return self.size.describe("seeds") if self.size else str(self.seeds or f"more than {MOST_SEEDS}")

    def _tell_alone(self) -> str:
        if self.alone is None:
            return ""
        low, high = self.alone.ends
        ends = f"{signed(low)} to {signed(high)}" if low < 0 else f"{low:.3f} to {high:.3f}"
        return f" ({format_p(self.alone.p)} alone; simultaneous interval {ends})"


def correct_p_values(p_values: Sequence[float]) -> list[float]:
    """Return Holm's corrected p-values: those of at most a level are of the hypotheses that are rejected at it."""
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[i]))
        corrected[i] = largest
    return corrected


def judge(claims: Sequence[Claim]) -> list[Judged]:
    """Return the verdicts on all claims of a page, by p-values that are corrected for their number.

    Claims whose spread over seeds is not known are undecided and do not count. The number of seeds is for the level of
    a single claim in the worst case, `LEVEL` divided by the number of claims, and a power of 0.8.
    """
    p_values = [claim.mean.p_value(claim.than) for claim in claims]
    known = [p for p in p_values if p is not None]
    corrected = iter(correct_p_values(known))
    return [
        Judged(UNDECIDED, None, len(known), None) if p is None else _judged(claim, next(corrected), len(known))
        for claim, p in zip(claims, p_values, strict=True)
    ]


def judge_known(claims: Sequence[Claim | None]) -> list[Judged | None]:
    """Return `judge` of the claims that are not None, which alone count; None in the place of the others."""
    verdicts = iter(judge([claim for claim in claims if claim is not None]))
    return [None if claim is None else next(verdicts) for claim in claims]


def judge_means(means: Mapping[str, MeanOverSeeds]) -> dict[str, Judged]:
    """Return `judge` of the claims that the means are above 0, by name."""
    return dict(zip(means, judge([Claim(mean) for mean in means.values()]), strict=True))


def describe_means(means: Mapping[str, MeanOverSeeds]) -> list[str]:
    """Return each mean with the verdict on the claim that it is above 0, as text."""
    return [
        f"{name}: {means[name].describe(sign=True)}, {judged.verdict}: {judged.describe()}"
        for name, judged in judge_means(means).items()
    ]


def tabulate_means(title: str, means: Mapping[str, MeanOverSeeds]) -> str:
    """Return a Markdown table of the means, of the `title`, with the verdicts on the claims that they are above 0."""
    rows = [
        [name, means[name].describe(sign=True), judged.p_cell, judged.verdict]
        for name, judged in judge_means(means).items()
    ]
    return format_table((title, "mean over seeds", "p, corrected", "claim that it is positive"), rows)


def _judged(claim: Claim, p: float, family: int) -> Judged:
    above = claim.mean.mean > claim.than
    level = LEVEL / family
    decided = UNDECIDED if p > LEVEL else HELD if above != claim.at_most else NOT_HELD
    uncorrected = claim.mean.p_value(claim.than)
    alone = None
    if decided == UNDECIDED and uncorrected is not None and uncorrected <= LEVEL:
        alone = Alone(uncorrected, claim.mean.ends(level))
    size = plan_sample(claim.mean, claim.than, level) if decided == UNDECIDED else None
    return Judged(decided, p, family, seeds_to_tell(claim.mean, claim.than, level), size, alone)


def tell_loss(over_scenes: Estimate, scenes: int, family: int, spread: float = LARGEST_SPREAD) -> str | None:
    """Return the reason why a claim of one training of unknown spread did not hold, as text; None where undecided.

    A large enough loss is significant whatever the spread: its p-value with the largest spread that is assumed, times
    the number of claims `family` (Bonferroni), is at most `LEVEL`. A gain is never decided in this way.
    """
    p = p_value_of_loss(over_scenes, scenes, spread)
    if p is None or p * family > LEVEL:
        return None
    corrected = f", corrected for {family} claims" if family > 1 else ""
    corrected_p = f"p {format_p(p * family)}{corrected}"
    return f"a spread of {spread:.2g}, above any measured, would not explain such a loss ({corrected_p})"


def describe_aims(aims: Mapping[str, Claim]) -> list[str]:
    """Return the sentence "*aim*: **verdict**, mean (low to high) over n seeds; p." of each aim, in Markdown.

    All aims of the page are tested together. The verdict is "reached", "not reached" or UNDECIDED.
    """
    judged = judge(list(aims.values()))
    return [_describe_aim(aim, claim.mean, result) for (aim, claim), result in zip(aims.items(), judged, strict=True)]


def _describe_aim(aim: str, mean: MeanOverSeeds, judged: Judged) -> str:
    over = f"{mean.describe()} over {mean.seeds} seeds of standard deviation {mean.sd:.3f}"
    if mean.seeds == 1:
        over = f"{mean.mean:.3f} of one seed"
    return f"*{aim}*: **{REACHED[judged.verdict]}**, {over}; {judged.describe()}."


def format_p(p: float) -> str:
    """Return a p-value with three decimals, or "< 0.001"."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def signed(value: float, digits: int = 3) -> str:
    """Return `value` with its sign and `digits` decimals; a minus is U+2212."""
    return f"{value:+.{digits}f}".replace("-", "−")
