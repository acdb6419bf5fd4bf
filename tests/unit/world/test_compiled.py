import os
import subprocess
import sys
from pathlib import Path

INNER = "from flcav.compiled import inlined\n@inlined\ndef inner(x):\n    return x + {}\n"
MIDDLE = """
from flcav.compiled import inlined
from inner import inner
@inlined
def middle(x):
    return inner(x)
"""
OUTER = """
from flcav.compiled import compiled
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


def test_what_is_kept_is_made_anew_when_an_inlined_function_of_another_file_changes(tmp_path: Path) -> None:
    for name, text in (("inner", INNER.format(1)), ("middle", MIDDLE), ("outer", OUTER)):
        (tmp_path / f"{name}.py").write_text(text)
    assert ran(tmp_path) == ["2", "0"]
    assert ran(tmp_path) == ["2", "1"]
    (tmp_path / "inner.py").write_text(INNER.format(2))
    assert ran(tmp_path) == ["3", "0"]
