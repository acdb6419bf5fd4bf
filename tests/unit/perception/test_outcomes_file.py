"""Outcomes of a test as a file: read as they were written, or refused in a sentence."""

from pathlib import Path

import numpy as np
import pytest

from flcav.config import InputError
from flcav.perception.outcomes import Outcomes


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Outcomes(np.array(["a", "b"]), {"hits": np.arange(2000)}).save(tmp_path / "outcomes.npz")
    return tmp_path / "outcomes.npz"


def test_outcomes_come_back(path: Path) -> None:
    found = Outcomes.load(path)
    assert found.scene.tolist() == ["a", "b"]
    np.testing.assert_array_equal(found.arrays["hits"], np.arange(2000))


@pytest.mark.parametrize("place", [2, 100, 700, -30])
def test_a_damaged_file_is_refused(path: Path, place: int) -> None:
    whole = path.read_bytes()
    for changed in (whole[:place], whole[:place] + b"\xff" * 20 + whole[place:][20:], b""):
        path.write_bytes(changed)
        with pytest.raises(InputError, match="no outcomes of a test"):
            Outcomes.load(path)
