"""Histories in files, as Python reads them."""

from pathlib import Path

import pytest

from flcav.config import InputError
from flcav.optimization.curves.fitting import fit
from flcav.optimization.curves.history import load_history


def test_a_curve_is_fitted_to_a_file(tmp_path: Path):
    path = tmp_path / "history.csv"
    path.write_text("samples,edge_rounds,cloud_rounds,accuracy\n10,0,0,0.3\n100,0,0,0.5\n1000,0,0,0.7\n")
    assert fit(str(path)).curve == fit(path).curve == fit(load_history(path)).curve
    path.write_text("task,samples,edge_rounds,cloud_rounds,accuracy\na,10,0,0,0.3\nb,100,0,0,0.5\n")
    with pytest.raises(InputError, match="a history of one task is wanted, and it has those of a, b"):
        fit(path)
    with pytest.raises(InputError, match="no such file"):
        fit("none.csv")
