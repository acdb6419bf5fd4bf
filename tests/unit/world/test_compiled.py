import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

from flcav.machine.compiled import kernel
from flcav.machine.threads import share_among_threads

INNER = "from flcav.machine.compiled import inlined\n@inlined\ndef inner(x):\n    return x + {}\n"
MIDDLE = """
from flcav.machine.compiled import inlined
from inner import inner
@inlined
def middle(x):
    return inner(x)
"""
OUTER = """
from flcav.machine.compiled import compiled
from middle import middle
@compiled
def outer(x):
    return middle(x)
print(outer(1), sum(outer.stats.cache_hits.values()))
"""


def ran(folder: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "outer.py"],
        cwd=folder,
        env=os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.slow
def test_what_is_kept_is_made_anew_when_an_inlined_function_of_another_file_changes(tmp_path: Path) -> None:
    for name, text in (("inner", INNER.format(1)), ("middle", MIDDLE), ("outer", OUTER)):
        (tmp_path / f"{name}.py").write_text(text)
    assert ran(tmp_path) == ["2", "0"]
    assert ran(tmp_path) == ["2", "1"]
    (tmp_path / "inner.py").write_text(INNER.format(2))
    assert ran(tmp_path) == ["3", "0"]


RECORD = """
from typing import NamedTuple
from flcav.machine.compiled import compiled
class {0}(NamedTuple):
    x: int
@compiled
def outer(record):
    return record.x
print(outer({0}(1)), sum(outer.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_what_is_kept_of_a_class_that_is_called_otherwise_now_is_made_anew(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text("from records import *\n")
    for name in ("Before", "After"):
        (tmp_path / "records.py").write_text(RECORD.format(name))
        assert ran(tmp_path) == ["1", "0"]
        assert ran(tmp_path) == ["1", "1"]


@kernel
def double(values):
    for i in range(len(values)):
        values[i] *= 2


@kernel
def make(count):
    return np.zeros(count)


def test_a_kernel_keeps_no_reference_to_its_arrays_and_makes_none() -> None:
    values = np.arange(4.0)
    before = sys.getrefcount(values)
    for _ in range(3):
        double(values)
    assert values.tolist() == [0, 8, 16, 24]
    assert sys.getrefcount(values) == before
    with pytest.raises(NumbaError, match="array"):
        make(3)


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [0, 1, 7, 64])
def test_threads_share_all_items_once_in_ranges_of_whole_packets(count: int, threads: int) -> None:
    ranges: list[tuple[int, int]] = []
    share_among_threads(lambda first, last: ranges.append((first, last)), count, threads, whole=4)
    assert [item for first, last in sorted(ranges) for item in range(first, last)] == list(range(count))
    assert all((last - first) % 4 == 0 for first, last in sorted(ranges)[:-1])
    assert len(ranges) <= threads
