"""Put the spread of retraining into the package: `python tools/ship_spreads.py demo RETRAINING [FURTHER ...]`.

RETRAINING is the folder of a run with retrainings, each FURTHER that of a run of the same recipe on another kind of
processor, which is one more training. The table is `spreads/demo.csv`, which recipes name by `spread: demo`.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from flcav import runs
from flcav.runs.results.run import Run
from flcav.runs.running import RESULTS
from flcav.runs.spread import SpreadRow, list_spreads
from flcav.runs.tables import append_records

PACKAGE = Path(runs.__path__[0])
NAME = "seed1"  # of the run, in the table


def measure(folders: Sequence[Path]) -> list[SpreadRow]:
    """Return the rows of the table: of a run with retrainings, and of further ones."""
    run, *further = (Run.load(folder, RESULTS) for folder in folders)
    return list_spreads(run, NAME, further)


def main(name: str, *folders: str) -> None:
    """Write the table `name` of the package."""
    out = PACKAGE / "spreads" / f"{name}.csv"
    out.unlink(missing_ok=True)
    append_records(out, measure([Path(folder) for folder in folders]))
    print(f"{out}: {len(out.read_text(encoding='utf-8').splitlines()) - 1} figures")


if __name__ == "__main__":
    main(*sys.argv[1:])
