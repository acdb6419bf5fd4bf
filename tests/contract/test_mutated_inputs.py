"""Whatever its inputs are, a command is done with them, or says why not in one sentence: a case of most commands.

`python tools/mutate_inputs.py --cases N` runs any number of them, with the slowest calls too.
"""

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from mutated_commands import Call, calls, run_case, run_within
from mutations import link_tree
from valid_inputs import make_inputs

CASES = 100  # the first ones take each of `CALLS` once
LIMIT_S = 60.0  # of computing; not less: an interrupted compiler may fail the next case
CALLS = [call for call in calls() if call.seconds <= 2.0]  # the others are the tool's
QUICK = [call for call in CALLS if call.seconds <= 0.2]
OFTEN = [number for number, call in enumerate(CALLS) if call.seconds <= 0.7]  # numbers of cases; the others are slow


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs") / "inputs"
    make_inputs(folder)
    return folder


@pytest.mark.parametrize(
    "number", [pytest.param(each, marks=[] if each in OFTEN else [pytest.mark.slow]) for each in range(CASES)]
)
def test_a_mutated_input_is_used_or_refused_in_a_sentence(number: int, inputs: Path, tmp_path: Path) -> None:
    choices = [CALLS[number]] if number < len(CALLS) else QUICK
    outcome = run_case(inputs, number, tmp_path / "case", choices, LIMIT_S)
    assert not outcome.broken, f"flcav {outcome.words}\n{outcome.done}\n{outcome.said}"


def truncate(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 34)


SPECIAL: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a sparse file": truncate,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path),
}
WAITED_S = 2.0


def list_named() -> Iterator[tuple[Call, str]]:
    """Yield each command with each kind of file that its line names."""
    seen = set[tuple[str, str]]()
    for call in QUICK:
        for name in call.inputs:
            kind = call.words.split()[0], Path(name).suffix
            if name in call.words.split() and kind not in seen:
                seen.add(kind)
                yield call, name


def list_within(inputs: Path) -> Iterator[tuple[Call, str]]:
    """Yield commands that read a folder with a file of each of its folders."""
    read = [call for call in QUICK if call.words.split()[0] == "import" or call.words == "validate data/"]
    for call in read:
        found = sorted({path for glob in call.inputs for path in inputs.glob(glob) if path.is_file()})
        yield from ((call, str(path.relative_to(inputs))) for path in {path.parent: path for path in found}.values())


@pytest.mark.parametrize("kind", SPECIAL)
def test_a_file_that_is_no_regular_one_is_refused(kind: str, inputs: Path, tmp_path: Path) -> None:
    named = [*list_named()]
    assert len(named) > 10
    link_tree(inputs, tmp_path / "in")
    replace_each(named, kind, inputs, tmp_path / "in", codes=(2,))


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPECIAL)
def test_what_is_no_regular_file_in_a_folder_is_neither_waited_for_nor_read_without_end(
    kind: str, inputs: Path, tmp_path: Path
) -> None:
    link_tree(inputs, tmp_path / "in")
    replace_each([*list_within(inputs)], kind, inputs, tmp_path / "in", codes=(0, 1, 2))


def replace_each(
    cases: Sequence[tuple[Call, str]], kind: str, inputs: Path, folder: Path, codes: tuple[int, ...]
) -> None:
    """Run commands with a file of `folder`, whose files are those of `inputs`, in turn replaced by one of SPECIAL."""
    for call, name in cases:
        path, out = folder / name, folder.parent / "out"
        arguments = call.arguments(folder, out, np.random.default_rng(0))
        path.unlink()
        SPECIAL[kind](path)
        ran = run_within(arguments, WAITED_S)
        told = f"flcav {call.words}, {name} is {kind}: exit code {ran.code}, {ran.said}"
        assert not ran.slow, told
        assert not ran.trace, f"{told}\n{ran.trace}"
        assert ran.code in codes, told
        assert ran.code != 2 or len(ran.said.splitlines()) == 1, told
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink()
        path.hardlink_to(inputs / name)
        shutil.rmtree(out, ignore_errors=True)
