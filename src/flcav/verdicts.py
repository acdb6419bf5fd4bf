"""What an interval decides, and the words for it on every page."""

from flcav.intervals import MeanOverSeeds

HELD, NOT_HELD, UNDECIDED = "held", "did not hold", "undecided"


def verdict(low: float | None, high: float | None) -> str:
    """Return what the interval [low, high] of a difference says of the claim that it is positive; None: no interval."""
    if low is None or high is None:
        return UNDECIDED
    if low > 0:
        return HELD
    return NOT_HELD if high < 0 else UNDECIDED


def verdict_words(decided: str, runs: int = 1) -> str:
    """Return a clause on where the interval lies and what that says of the claim, in one run or over several."""
    where = " in this run" if runs == 1 else ""
    who = "this run does" if runs == 1 else "these runs do"
    return {
        HELD: f"the interval lies above 0, so the claim held{where}",
        NOT_HELD: f"the interval lies below 0, so the claim did not hold{where}",
        UNDECIDED: f"the interval contains 0, so {who} not decide",
    }[decided]


def aim_sentence(aim: str, wanted: float, reached: MeanOverSeeds, seeds: int, *, at_most: bool = False) -> str:
    """Return "*aim*: **verdict**, mean (low to high) over so many seeds", without a full stop.

    Reached, or not, where the whole interval of `reached` says so; else undecided. The aim is to come
    to `wanted` or above, or where `at_most`, to it or below.
    """
    low, high = reached.low, reached.high
    good, bad = (high <= wanted, low > wanted) if at_most else (low >= wanted, high < wanted)
    said = "reached" if good else "not reached" if bad else UNDECIDED
    over = f"{reached.told()} over {seeds} seeds" if seeds > 1 else f"{reached.mean:.3f} of one seed"
    return f"*{aim}*: **{said}**, {over}"


def signed(value: float, digits: int = 3) -> str:
    """Return the number with its sign, a minus as long as the plus."""
    return f"{value:+.{digits}f}".replace("-", "−")
