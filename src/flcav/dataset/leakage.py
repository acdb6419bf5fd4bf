"""Data that must not be shared by datasets of different splits."""

from collections.abc import Iterator, Mapping
from itertools import combinations

from flcav.dataset.layout import Manifest


def leaks(manifests: Mapping[str, Manifest]) -> list[str]:
    """Return a sentence for every two datasets (name -> manifest) of different splits that share traffic.

    Frames of one scene show the same cars at the same places, so a scene belongs to one split; and a traffic seed
    drives a town the same way in every recipe that uses it.
    """
    return [sentence for pair in combinations(manifests.items(), 2) for sentence in _shared(*pair)]


def _shared(one: tuple[str, Manifest], other: tuple[str, Manifest]) -> Iterator[str]:
    (name, manifest), (other_name, other_manifest) = one, other
    recipe, other_recipe = manifest.recipe, other_manifest.recipe
    split, other_split = recipe.get("split"), other_recipe.get("split")
    if split == other_split:
        return
    where = f"{name} (split '{split}') and {other_name} (split '{other_split}')"
    scenes = sorted(set(manifest.scenes) & set(other_manifest.scenes))
    if scenes:
        yield f"{where}: leakage, they share {len(scenes)} scenes, the first is '{scenes[0]}'"
    elif (recipe.get("town"), recipe.get("seed")) == (other_recipe.get("town"), other_recipe.get("seed")):
        yield f"{where}: leakage, they share the traffic seed {recipe.get('seed')} in '{recipe.get('town')}'"
