"""Markdown tables of the proof of placement."""

import numpy as np

from flcav.experiments.placement.run import HALF_WIDTH, NEAR, TOWN, PlacementProof
from flcav.intervals import MOST_SEEDS
from flcav.markdown import format_table

FRAMES = (TOWN, NEAR)


def tables(results: PlacementProof) -> dict[str, str]:
    """Return Markdown by name: correlation, rules, poles, seeds, overlaps."""
    return {
        "correlation": _correlation(results),
        "rules": _rules(results),
        "poles": _poles(results),
        "seeds": _seeds(results),
        "overlaps": _overlaps(results),
    }


def _correlation(results: PlacementProof) -> str:
    rows = [
        [predictor, *(own[frames].describe(sign=True) for frames in FRAMES)]
        for predictor, own in results.correlation.items()
    ]
    return format_table(("rank correlation of a pole's gain with its", *FRAMES), rows)


def _rules(results: PlacementProof) -> str:
    rows = []
    for name, gain in results.gain.items():
        count, rule = name.split(", ")
        beaten = results.advantage.get(name)
        told = [beaten[frames].describe(sign=True) if beaten else "" for frames in FRAMES]
        rows.append([count, rule, *(gain[frames].describe(sign=True) for frames in FRAMES), *told])
    header = ("sensors", "rule", *(f"gain in AP50 {f}" for f in FRAMES), *(f"VRCSP gains more {f}" for f in FRAMES))
    return format_table(header, rows)


def _poles(results: PlacementProof) -> str:
    """Return each pole's means over the seeds in which it sees road users, most errors first."""
    rows = []
    for pole in sorted({each.pole for seed in results.seeds for each in seed.poles}):
        own = [each for seed in results.seeds for each in seed.poles if each.pole == pole]
        means = [float(np.mean(values)) for values in ([e.covered for e in own], [e.actors for e in own])]
        rows.append([pole, len(own), means, [float(np.mean([e.gain[frames] for e in own])) for frames in FRAMES]])
    rows.sort(key=lambda row: -row[2][0])
    return format_table(
        ("pole", "seeds", "errors covered", "actors in range", *(f"mean gain in AP50 {frames}" for frames in FRAMES)),
        [
            [pole, seeds, f"{c:.1f}", f"{a:.1f}", *(f"{gain:+.3f}" for gain in gains)]
            for pole, seeds, (c, a), gains in rows
        ],
    )


def _seeds(results: PlacementProof) -> str:
    rows = [
        [
            seed.seed,
            seed.errors,
            *(f"{values[frames]:.3f}" for frames in FRAMES for values in (seed.pretrained, seed.without)),
        ]
        for seed in results.seeds
    ]
    spread = [f"{results.pair_sd[frames]:.3f}" for frames in FRAMES] if len(results.seeds) > 1 else ["", ""]
    wanted = [_told(results, frames) for frames in FRAMES]
    header = ("seed", "errors", *(f"AP50 {stage}, {f}" for f in FRAMES for stage in ("pretrained", "without sensors")))
    own = format_table(header, rows)
    pairs = format_table(
        (
            "two poles' gains",
            "standard deviation over seeds of their difference",
            f"seeds for a half-width of {HALF_WIDTH}",
        ),
        [[frames, sd, seeds] for frames, sd, seeds in zip(FRAMES, spread, wanted, strict=True)],
    )
    return f"{own}\n\n{pairs}"


def _told(results: PlacementProof, frames: str) -> str:
    wanted = results.seeds_wanted[frames]
    if wanted is not None:
        return str(wanted)
    return f"more than {MOST_SEEDS}" if len(results.seeds) > 1 else ""


def _overlaps(results: PlacementProof) -> str:
    rows = [[f"{e.poles[0]} and {e.poles[1]}", f"{e.apart_m:.0f}", f"{e.overlap:.0%}"] for e in results.overlaps]
    return format_table(("poles", "apart [m]", "share of each circle in the other"), rows)
