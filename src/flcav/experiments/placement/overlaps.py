"""Overlaps of the circles that sensors on candidate poles cover."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from flcav.experiments.placement.records import Pair
from flcav.runs.recipe import RunRecipe
from flcav.world.map.town import load_town


def overlap_of_circles(apart: float, radius: float) -> float:
    """Return the share of a circle's area that lies in another one of the same radius, `apart` between the centres."""
    half = apart / (2 * radius)
    if half >= 1:
        return 0.0
    return float(2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2)))


def list_overlaps(recipe: RunRecipe, region: str, beside: Path | None = None) -> tuple[Pair, ...]:
    """Return the pairs of candidate poles of a region whose circles overlap, the most first.

    Its town is looked for in the folder `beside`.
    """
    poles, radius = load_town(recipe.regions[region].town or region, beside).poles, recipe.placement.range_m
    pairs = []
    for (one, here), (other, there) in combinations(zip(poles.id.tolist(), poles.position, strict=True), 2):
        apart = float(np.linalg.norm(here[:2] - there[:2]))
        if (share := overlap_of_circles(apart, radius)) > 0:
            pairs.append(Pair((one, other), apart, share))
    return tuple(sorted(pairs, key=lambda pair: -pair.overlap))


def describe_overlaps(pairs: Mapping[str, Sequence[Pair]], range_m: float) -> list[str]:
    """Return in words, a sentence for each region, how much the circles of candidate poles overlap."""
    told = {
        region: ", ".join(f"{pair.poles[0]} and {pair.poles[1]} by {pair.overlap:.0%}" for pair in own)
        for region, own in pairs.items()
    }
    return [
        f"{region}: circles of {range_m:g} m around candidate poles that overlap: {each}"
        if each
        else f"{region}: no two circles of {range_m:g} m around candidate poles overlap"
        for region, each in told.items()
    ]
