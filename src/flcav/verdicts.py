"""Verdicts on claims and targets from 95 % confidence intervals, and their wording."""

from flcav.intervals import MeanOverSeeds

HELD, NOT_HELD, UNDECIDED = "held", "did not hold", "undecided"


def verdict(low: float | None, high: float | None) -> str:
    """Return the verdict on the claim that a difference with the interval [low, high] is positive.

    HELD if the interval lies above 0, NOT_HELD if below 0, else UNDECIDED, also where there is no interval (None).
    """
    if low is None or high is None:
        return UNDECIDED
    if low > 0:
        return HELD
    return NOT_HELD if high < 0 else UNDECIDED


def explain_verdict(decided: str, runs: int = 1) -> str:
    """Return a clause that explains the verdict `decided` of `verdict`, for one run or several (`runs`)."""
    where = " in this run" if runs == 1 else ""
    who = "this run does" if runs == 1 else "these runs do"
    return {
        HELD: f"the interval lies above 0, so the claim held{where}",
        NOT_HELD: f"the interval lies below 0, so the claim did not hold{where}",
        UNDECIDED: f"the interval contains 0, so {who} not decide",
    }[decided]


def describe_aim(aim: str, wanted: float, reached: MeanOverSeeds, seeds: int, *, at_most: bool = False) -> str:
    """Return the sentence "*aim*: **verdict**, mean (low to high) over n seeds" in Markdown, without a full stop.

    The aim is a mean of at least `wanted`, or with `at_most` of at most `wanted`. The verdict is "reached" or "not
    reached" where the whole interval of `reached` lies on one side of `wanted`, else UNDECIDED.
    """
    low, high = reached.low, reached.high
    good, bad = (high <= wanted, low > wanted) if at_most else (low >= wanted, high < wanted)
    said = "reached" if good else "not reached" if bad else UNDECIDED
    over = f"{reached.describe()} over {seeds} seeds" if seeds > 1 else f"{reached.mean:.3f} of one seed"
    return f"*{aim}*: **{said}**, {over}"


def signed(value: float, digits: int = 3) -> str:
    """Return `value` with its sign and `digits` decimals; a minus is U+2212."""
    return f"{value:+.{digits}f}".replace("-", "−")
