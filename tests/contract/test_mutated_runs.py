"""Mutated run recipes: what cannot be run is one sentence, before anything is done."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from mutations import mutate

from flcav.config import InputError
from flcav.runs.recipe import load_run_recipe
from flcav.runs.stages.graph import Graph

TOY = Path(__file__).parents[1] / "integration" / "toy.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(4))
def test_a_mutated_run_recipe_is_refused_in_a_sentence_or_has_steps(batch: int, tmp_path: Path) -> None:
    refused = 0
    for number in range(75 * batch, 75 * (batch + 1)):
        rng = np.random.default_rng([number, 11])
        path = tmp_path / "run.yaml"
        path.write_bytes(TOY.read_bytes())
        told = mutate(path, rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                assert Graph(load_run_recipe(path), tmp_path).steps
        except InputError:
            refused += 1
        except (IsADirectoryError, FileNotFoundError):
            pass
        except BaseException as error:
            raise AssertionError(f"case {number}: {told}") from error
        if path.is_dir():
            path.rmdir()
    assert refused > 20
