"""Mutated OpenDRIVE maps: 200 read, and a few imported and driven; `python tools/mutate_maps.py` does any number."""

from pathlib import Path

import numpy as np
import pytest
from mutated_maps import mutate_often, try_map

from flcav.config import InputError
from flcav.world.map.relief import Relief
from flcav.world.opendrive.document import describe_map, read_map
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.mending import mend_map
from flcav.world.opendrive.mirror import mirror_map

CROSS = Path(__file__).parents[1] / "data" / "cross.xodr"
READ, IMPORTED = 200, (6, 9)
SLOPE = '<elevationProfile><elevation s="0" a="1" b="0.05" c="0" d="0"/></elevationProfile><lanes>'


@pytest.fixture(scope="module")
def sloping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "map.xodr"
    path.write_text(CROSS.read_text().replace("<lanes>", SLOPE))
    return path


def test_mutated_maps_are_read_or_refused_in_a_sentence(sloping: Path, tmp_path: Path) -> None:
    sentences = []
    for number in range(READ):
        rng = np.random.default_rng(number)
        folder = tmp_path / str(number)
        folder.mkdir()
        path = folder / "map.xodr"
        path.write_bytes(sloping.read_bytes())
        done = "; ".join(mutate_often(path, rng, int(rng.integers(1, 4))))
        try:
            root = read_map(path)
            mend_map(root)
            describe_map(root)
            points = sample_heights(root, path).points
            assert np.isfinite(points).all(), done
            if len(points):
                Relief(points)
            mirror_map(root)
        except InputError as error:
            told = str(error)
            sentences.append(told.removeprefix(f"{path}: ") if told.startswith(f"{path}: ") else "")
    assert all(sentence and "\n" not in sentence for sentence in sentences)
    assert 10 < len(sentences) < READ - 10


@pytest.mark.parametrize("number", IMPORTED)
def test_mutated_maps_are_imported_and_driven(number: int, sloping: Path, tmp_path: Path) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo (the extra 'towns') is not installed")
    outcome = try_map([sloping], number, tmp_path / "case", limit_s=60, every=3)
    assert not outcome.broken, f"{outcome.done}\n{outcome.broken}"
