"""Whether an aim was reached, said the same way on every page."""

from collections.abc import Mapping

from flcav.markdown import interval


def aim_sentence(aim: str, wanted: float, reached: Mapping[str, float], seeds: int, *, at_most: bool = False) -> str:
    """Return "*aim*: **verdict**, mean (low to high) over so many seeds", without a full stop.

    Reached, or not, where the whole interval of `reached` (mean, low, high) says so; else undecided. The aim is to come
    to `wanted` or above, or where `at_most`, to it or below.
    """
    low, high = reached["low"], reached["high"]
    good, bad = (high <= wanted, low > wanted) if at_most else (low >= wanted, high < wanted)
    verdict = "reached" if good else "not reached" if bad else "undecided"
    over = f"{interval(reached)} over {seeds} seeds" if seeds > 1 else f"{reached['mean']:.3f} of one seed"
    return f"*{aim}*: **{verdict}**, {over}"
