"""Mutated OpenDRIVE maps: 200 read, and a few imported and driven; `python tools/mutate_maps.py` does any number."""

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mutated_maps import mutate_often, try_map
from time_limits import within

from flcav.config import InputError
from flcav.world.map.relief import Relief
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.opendrive.document import describe_map, read_map
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.importing import import_town
from flcav.world.opendrive.mending import mend_map, mend_roads
from flcav.world.opendrive.netconvert import mirror_map
from flcav.world.opendrive.objects.crossings import find_crosswalks
from flcav.world.opendrive.objects.signal_heads import find_heads
from flcav.world.opendrive.objects.signs import find_map_poles, find_signs
from flcav.world.opendrive.objects.standing import find_parking, find_standing_objects
from flcav.world.opendrive.objects.stop_lines import find_stop_lines

DATA = Path(__file__).parents[1] / "data"
MAPS = ("cross", "cross_with_objects")
READ, IMPORTED = 200, ((6, "cross"), (9, "cross"), (30, "cross_with_objects"))
LIMIT_S = 10  # of computing, for reading one map; it takes some 5 ms
SLOPE = '<elevationProfile><elevation s="0" a="1" b="0.05" c="0" d="0"/></elevationProfile><lanes>'


@pytest.fixture(scope="module")
def sloping(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("maps")
    for name in MAPS:
        (folder / f"{name}.xodr").write_text((DATA / f"{name}.xodr").read_text().replace("<lanes>", SLOPE))
    return {name: folder / f"{name}.xodr" for name in MAPS}


class Place(NamedTuple):
    """Where the objects of a map are sought."""

    offset_m: tuple[float, float] = (0.0, 0.0)  # town - map
    net: RoadNet | None = None  # beside whose lanes they are; None: only those are sought that need none


@pytest.fixture(scope="module")
def place(sloping: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Place:
    if importlib.util.find_spec("sumo") is None:
        return Place()
    town = import_town(sloping["cross_with_objects"], tmp_path_factory.mktemp("nets") / "town").town
    assert town.parameters.source is not None
    return Place(town.parameters.source.offset_m, read_net(town.net))


def _read_whole(path: Path, place: Place) -> None:
    root = read_map(path)
    mend_roads(root)
    mend_map(root)
    describe_map(root)
    points = sample_heights(root, path).points
    assert np.isfinite(points).all()
    if len(points):
        Relief(points)
    _read_objects(root, place)
    mirror_map(root)


def _read_objects(root: ElementTree.Element, place: Place) -> None:
    for find in (find_signs, find_map_poles, find_crosswalks):
        find(root, place.offset_m)
    if place.net is not None:
        for find in (find_heads, find_parking, find_standing_objects, find_stop_lines):
            find(root, place.offset_m, place.net)


@pytest.mark.slow
def test_mutated_maps_are_read_or_refused_in_a_sentence(sloping: dict[str, Path], place: Place, tmp_path: Path) -> None:
    sentences = []
    for number in range(READ):
        rng, name = np.random.default_rng(number), MAPS[number % len(MAPS)]
        folder = tmp_path / str(number)
        folder.mkdir()
        path = folder / "map.xodr"
        path.write_bytes(sloping[name].read_bytes())
        done = "; ".join(mutate_often(path, rng, int(rng.integers(1, 4))))
        try:
            with within(LIMIT_S):
                _read_whole(path, place if name == "cross_with_objects" else Place())
        except InputError as error:
            told = str(error)
            sentences.append(told.removeprefix(f"{path}: ") if told.startswith(f"{path}: ") else "")
        except BaseException as error:
            raise AssertionError(f"case {number}: {done}") from error
    assert all(sentence and "\n" not in sentence for sentence in sentences)
    assert 10 < len(sentences) < READ - 10


@pytest.mark.parametrize(("number", "name"), IMPORTED)
def test_mutated_maps_are_imported_and_driven(number: int, name: str, sloping: dict[str, Path], tmp_path: Path) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    outcome = try_map([sloping[name]], number, tmp_path / "case", limit_s=60, every=3)
    assert not outcome.broken, f"{outcome.done}\n{outcome.broken}"
