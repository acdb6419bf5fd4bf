"""Markdown tables of the test of placement."""

import numpy as np

from flcav.reproductions.placement.records import (
    EXPECTED,
    FRAMES,
    HALF_WIDTH,
    PREDICTORS,
    RULES,
    Means,
    PlacementProof,
    RegionProof,
    list_claims,
)
from flcav.statistics.power import MOST_SEEDS
from flcav.statistics.verdicts import judge_means
from flcav.storage.markdown import format_table

POOLED = "mean over regions"


def tables(results: PlacementProof) -> dict[str, str]:
    """Return Markdown by name: claims, correlation, rules, spread, and of each region poles, seeds and overlaps."""
    means = {name: proof.means for name, proof in results.regions.items()}
    if len(means) > 1:
        means[POOLED] = results.pooled
    markdown = {
        "claims": _claims(results),
        "correlation": _correlation(means),
        "rules": _rules(means),
        "spread": _spread(results),
    }
    for name, proof in results.regions.items():
        markdown |= {
            f"poles {name}": _poles(proof),
            f"seeds {name}": _seeds(proof),
            f"overlaps {name}": _overlaps(proof),
        }
    return markdown


def _claims(results: PlacementProof) -> str:
    claims = list_claims(results)
    rows = [
        [
            name,
            claims[name].describe(sign=True),
            one.p_cell,
            one.verdict,
            one.takes_cell,
        ]
        for name, one in judge_means(claims).items()
    ]
    return format_table(
        ("claim, of the mean over regions", "mean over seeds", "p, corrected", "verdict", "if undecided: seeds"), rows
    )


def _correlation(regions: dict[str, Means]) -> str:
    rows = [
        [region, name, *(means.correlation[name][frames].describe(sign=True) for frames in FRAMES)]
        for region, means in regions.items()
        for name in PREDICTORS
    ]
    return format_table(("region", "rank correlation of a pole's gain with its", *FRAMES), rows)


def _rules(regions: dict[str, Means]) -> str:
    rows = []
    for region, means in regions.items():
        for count, rule in sorted((name.split(", ") for name in means.gain), key=_order):
            name = f"{count}, {rule}"
            gain = means.gain[name]
            beaten = means.advantage.get(name)
            advantages = [beaten[frames].describe(sign=True) if beaten else "" for frames in FRAMES]
            rows.append([region, count, rule, *(gain[frames].describe(sign=True) for frames in FRAMES), *advantages])
    header = ("sensors", "rule", *(f"gain in AP50 {f}" for f in FRAMES), *(f"VRCSP gains more {f}" for f in FRAMES))
    return format_table(("region", *header), rows)


def _order(choice: list[str]) -> tuple[int, int]:
    """Return the sort key of [count, rule]: by number, and in the order of `RULES`, as JSON files sort by letters."""
    count, rule = choice
    return int(count), (*RULES.values(), EXPECTED).index(rule)


def _poles(region: RegionProof) -> str:
    """Return each pole's means over the seeds in which it sees road users, in descending order of errors covered."""
    rows = []
    for pole in sorted({row.pole for seed in region.seeds for row in seed.poles}):
        by_seed = [row for seed in region.seeds for row in seed.poles if row.pole == pole]
        means = [float(np.mean([row.predictors[name] for row in by_seed])) for name in PREDICTORS]
        rows.append(
            (
                pole,
                len(by_seed),
                means,
                [float(np.mean([row.gain[frames] for row in by_seed])) for frames in FRAMES],
            )
        )
    rows.sort(key=lambda row: -row[2][0])
    return format_table(
        ("pole", "seeds", *PREDICTORS, *(f"mean gain in AP50 {frames}" for frames in FRAMES)),
        [
            [pole, seeds, *(f"{mean:.1f}" for mean in means), *(f"{gain:+.3f}" for gain in gains)]
            for pole, seeds, means, gains in rows
        ],
    )


def _seeds(region: RegionProof) -> str:
    rows = [
        [
            seed.seed,
            seed.errors,
            *(f"{values[frames]:.3f}" for frames in FRAMES for values in (seed.pretrained, seed.without)),
        ]
        for seed in region.seeds
    ]
    header = ("seed", "errors", *(f"AP50 {stage}, {f}" for f in FRAMES for stage in ("pretrained", "without sensors")))
    return format_table(header, rows)


def _spread(results: PlacementProof) -> str:
    """Return the standard deviations of the difference of two poles' gains, and the number of seeds needed."""
    rows, known = [], all(proof.scene_sd is not None for proof in results.regions.values())
    for name, proof in results.regions.items():
        several = len(proof.seeds) > 1
        for frames in FRAMES:
            wanted = proof.seeds_wanted[frames] or (f"more than {MOST_SEEDS}" if several else "")
            spread = [proof.pair_sd[frames], *([proof.scene_sd[frames]] if known and proof.scene_sd else [])]
            rows.append([name, frames, *(f"{sd:.3f}" if several else "" for sd in spread), wanted])
    header = (
        "standard deviation over seeds of the difference of two poles' gains",
        *(["by the draw of the test scenes alone"] if known else []),
        f"seeds for a half-width of {HALF_WIDTH}",
    )
    return format_table(("region", "test frames", *header), rows)


def _overlaps(region: RegionProof) -> str:
    rows = [[f"{e.poles[0]} and {e.poles[1]}", f"{e.apart_m:.0f}", f"{e.overlap:.0%}"] for e in region.overlaps]
    return format_table(("poles", "apart [m]", "share of each circle in the other"), rows)
