"""Whatever its inputs are, a command is done with them, or says why not in one sentence: a case of most commands.

`python tools/mutate_inputs.py --cases N` runs any number of them, with the slowest calls too.
"""

from pathlib import Path

import pytest
from mutated_commands import calls, run_case
from valid_inputs import make_inputs

CASES = 100  # the first ones take each of `CALLS` once
LIMIT_S = 60.0  # of computing; not less: an interrupted compiler may fail the next case
CALLS = [call for call in calls() if call.seconds <= 2.0]  # the others are the tool's
QUICK = [call for call in CALLS if call.seconds <= 0.2]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs") / "inputs"
    make_inputs(folder)
    return folder


@pytest.mark.parametrize("number", range(CASES))
def test_a_mutated_input_is_used_or_refused_in_a_sentence(number: int, inputs: Path, tmp_path: Path) -> None:
    choices = [CALLS[number]] if number < len(CALLS) else QUICK
    outcome = run_case(inputs, number, tmp_path / "case", choices, LIMIT_S)
    assert not outcome.broken, f"flcav {outcome.words}\n{outcome.done}\n{outcome.said}"
