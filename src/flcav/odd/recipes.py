"""Recipes of sampled scenarios: a recording of each, with its corner case where and when it is to happen."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml

from flcav.config import InputError, Json
from flcav.odd.sampling import Sample, Sampled
from flcav.odd.scenery import Scenery
from flcav.sources.recipe import Recipe, parse_recipe
from flcav.storage.files import flush_all, write_json
from flcav.world.map.town import PACKAGED

WARMUP_S, BEGINS_S = 30.0, 31.0  # of the traffic; from then on the corner case may begin
SPINS, EVERY_S = 20, 2.0
CAVS = 6  # the case waits for one of them to come within 50 m of its place
POLE_M = 40.0  # a pole this near to the place records, too
INDEX = "samples.json"


def make_recipe(sample: Sample, scenery: Scenery, seed: int, split: str = "train") -> dict[str, Json]:
    """Return the fields of the recipe of a sample, which `parse_recipe` takes."""
    town, place = scenery.town, sample.place
    away = np.linalg.norm(town.poles.position[:, :2] - (place.x, place.y), axis=1)
    near = town.poles.id[np.flatnonzero(away <= POLE_M)[np.argsort(away[away <= POLE_M])][:1]]
    lasts = {"lasts_s": 10.0} if sample.case == "stalled_vehicle" else {}
    position = [round(place.x, 1), round(place.y, 1)]
    return {
        "town": town.name if town.name in PACKAGED else str(town.net.parent.absolute()),
        "seed": seed,
        "split": split,
        "scenes": 1,
        "warmup_s": WARMUP_S,
        "spins_per_scene": SPINS,
        "every_s": EVERY_S,
        "cavs": CAVS,
        "poles": near.tolist(),
        "vehicle_rig": sample.rig,
        "weather": {name: round(float(value), 4) for name, value in sample.weather.model_dump().items()},
        "scenarios": [{"kind": sample.case, "at_s": BEGINS_S, "position": position, **lasts}],
    }


def write_recipes(
    drawn: Sampled,
    sceneries: Sequence[Scenery],
    out: Path,
    seed: int,
    also: Callable[[Sample, Recipe, Path], None],
    told: Sequence[Mapping[str, Json]] = (),
) -> list[Path]:
    """Write the recipe of each sample as OUT/NUMBER.yaml, and OUT/samples.json last; return the recipes' paths.

    also: called for each sample with its recipe and path; told: further values of each sample in samples.json. Every
    recipe has been read before it is written. Raises `InputError` where the folder has recipes already.
    """
    if out.exists() and any(out.glob("*.yaml")):
        raise InputError(f"{out}: has recipes already; name another folder")
    by_name = {scenery.town.name: scenery for scenery in sceneries}
    values = [make_recipe(each, by_name[each.place.town], seed + number) for number, each in enumerate(drawn.samples)]
    recipes = [parse_recipe(each, f"sample {number}") for number, each in enumerate(values, start=1)]
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"{number:0{len(str(len(values)))}}.yaml" for number in range(1, len(values) + 1)]
    for sample, each, recipe, path in zip(drawn.samples, values, recipes, paths, strict=True):
        path.write_text(yaml.safe_dump(each, sort_keys=False, default_flow_style=None))
        also(sample, recipe, path)
    flush_all([*paths, out])
    summary: dict[str, Json] = {
        "pairwise": drawn.pairwise,
        "pairs": drawn.pairs,
        "possible_pairs": drawn.possible,
        "refused": drawn.refused,
        "samples": [
            {"recipe": path.name, **each.as_json(), **more}
            for path, each, more in zip(paths, drawn.samples, told or [{}] * len(paths), strict=True)
        ],
    }
    write_json(out / INDEX, summary, sort=False)
    return paths
