"""OpenDRIVE maps changed at random: each is imported and driven, or refused in one sentence.

A case is named by its number: the map, one to three mutations of it, and whether it is driven follow from it.
"""

import traceback
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bombs import bomb
from mutations import MUTATIONS, mutate
from time_limits import Slow, within

from flcav.config import InputError
from flcav.world.map.lanes import map_layers
from flcav.world.opendrive.importing import import_town
from flcav.world.static import build_town_mesh
from flcav.world.traffic.traffic import simulate

BYTES, REVERSED = 0.1, 0.1  # shares of mutations that do not know XML, and of those that reverse children
BOMBS = 0.02  # share of maps that unfold without end, or are links
DRIVEN_S = np.array([5.0, 10.0])  # times at which traffic is read


@dataclass(frozen=True)
class MapOutcome:
    """What came of one mutated map."""

    number: int
    map: str
    done: str  # to the map
    said: str  # "town", or the sentence that refuses it
    broken: str  # traceback, or in what way the sentence is none; "" where all is well


def mutate_often(path: Path, rng: np.random.Generator, times: int) -> Iterator[str]:
    """Damage the file's bytes, or change its elements `times` times; yield what was done."""
    if rng.random() < BYTES:
        yield mutate(path, rng)
        return
    for _ in range(times):
        yield _reverse(path, rng) if rng.random() < REVERSED else MUTATIONS[".xodr"](path, path.read_bytes(), rng)
    if rng.random() < BOMBS:  # last, so that all other cases are what they are without
        yield bomb(path, rng)


def _reverse(path: Path, rng: np.random.Generator) -> str:
    """Reverse the children of an element."""
    tree = ElementTree.parse(path)
    parents = [element for element in tree.getroot().iter() if len(element) > 1]
    parent = parents[int(rng.integers(len(parents)))]
    parent[:] = parent[::-1]
    tree.write(path)
    return f"<{parent.tag}> reversed"


def try_map(maps: list[Path], number: int, folder: Path, *, limit_s: int, every: int) -> MapOutcome:
    """Mutate a map, import it into the new `folder`, and drive every `every`-th that can be imported."""
    rng = np.random.default_rng(number)
    source = maps[int(rng.integers(len(maps)))]
    folder.mkdir(parents=True)
    path = folder / "map.xodr"
    path.write_bytes(source.read_bytes())
    done = "; ".join(mutate_often(path, rng, int(rng.integers(1, 4))))

    said, broken = "town", ""
    try:
        with within(limit_s):
            town = import_town(path, folder / "town").town
            if number % every == 0:
                build_town_mesh(town)
                map_layers(town)
                simulate(town, seed=number, cavs=0, times_s=DRIVEN_S)
    except InputError as error:
        said = str(error)
        broken = said if "\n" in said or not said.startswith(str(path)) else ""
    except Slow:
        broken = f"not done in {limit_s} s\n{traceback.format_exc()}"
    except Exception:
        broken = traceback.format_exc()
    return MapOutcome(number, source.name, done, said, broken)
