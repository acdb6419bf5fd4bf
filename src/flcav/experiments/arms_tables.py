"""The tables on the page of the comparison of arms, from its numbers."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

from flcav.experiments.demo_arms import ARMS
from flcav.markdown import interval, table
from flcav.verdicts import HELD, NOT_HELD, UNDECIDED, verdict


def tables(results: Mapping[str, Any]) -> dict[str, str]:
    """Return Markdown by name: grid, ring, differences, seeds."""
    return {
        "grid": _town(results, "grid"),
        "ring": _town(results, "ring"),
        "differences": _differences(results),
        "seeds": _seeds(results),
    }


def _town(results: Mapping[str, Any], town: str) -> str:
    """Return AP by arm; in grid, which has an oracle, also how much of the gap to it each arm closes."""
    summary = results["summary"]
    closed = summary["gap_closed"] if town == "grid" else {}
    rows = [
        [arm, interval(summary["ap50"][town][arm]), interval(summary["ap70"][town][arm])]
        + ([interval(closed[arm]) if arm in closed else ""] if closed else [])
        for arm in ARMS[town]
    ]
    return table((f"arm on `{town}`", "AP50", "AP70", *(["gap closed"] if closed else [])), rows)


def _differences(results: Mapping[str, Any]) -> str:
    rows = []
    for name, mean in results["summary"]["differences"].items():
        own = [seed["differences"][name] for seed in results["seeds"]]
        times = Counter(verdict(each["low"], each["high"]) for each in own)
        counted = " / ".join(str(times[each]) for each in (HELD, UNDECIDED, NOT_HELD))
        rows.append([name, interval(mean, sign=True), counted])
    header = (
        "difference in AP50",
        "mean over seeds",
        "seeds whose own 95 % scene interval is above 0 / contains 0 / below 0",
    )
    return table(header, rows)


def _seeds(results: Mapping[str, Any]) -> str:
    rows = []
    for seed in results["seeds"]:
        placed = seed["placement"]["grid"]
        covered = {row["pole"]: row["covered"] for row in placed["coverage"]}
        used = seed["used_mb"]["edge + cloud FL"]
        rows.append(
            [
                seed["seed"],
                ", ".join(str(seed["plan"][count]) for count in ("samples", "edge_rounds", "cloud_rounds")),
                placed["errors"],
                *(f"{placed[pole]}: {covered[placed[pole]]}" for pole in ("chosen", "densest")),
                *(f"{used[link]:.1f} MB" for link in ("wireless", "wireline")),
            ]
        )
    header = (
        "seed",
        "plan: samples, edge, cloud rounds",
        "errors",
        "VRCSP pole covers",
        "densest pole covers",
        "wireless used",
        "wireline used",
    )
    return table(header, rows)
