"""Over the rounds neither the processes' memory nor the files of a fleet grow."""

import os
from pathlib import Path

import numpy as np
from fleet_clients import Walker

from flcav.federation.links.flower import start_fleet
from flcav.federation.loop import Schedule, federate
from flcav.fleet.supervisor import LOGS, read_processes

COUNT, ROUNDS, SETTLED = 4, 10, 4  # from the last on, everything that is kept is there


def measure(folder: Path) -> tuple[float, int, float]:
    """Return the memory of all processes [MB], the number of files of the fleet, and their size without logs [MB]."""
    page = os.sysconf("SC_PAGE_SIZE")
    pids = read_processes(folder).values()
    memory = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * page for pid in pids)
    files = [path for path in folder.rglob("*") if path.is_file()]
    kept = [path for path in files if LOGS not in path.parts]
    return memory / 1e6, len(files), sum(path.stat().st_size for path in kept) / 1e6


def test_nothing_grows():
    clients = {f"town/cav{number:02d}": Walker(number + 1) for number in range(COUNT)}
    weights = {"w": np.arange(100_000, dtype=np.float32)}
    schedule, found = Schedule(ROUNDS, 1, 0.1, 0.05, 3), {}
    expected = federate(clients, weights, schedule)
    with start_fleet(COUNT) as deployment:

        def look(number, *_):
            found[number] = measure(deployment.folder)

        ended = federate(clients, weights, schedule, runtime=deployment, on_round=look)
    np.testing.assert_array_equal(expected.weights["w"], ended.weights["w"])
    print({number: tuple(round(each, 1) for each in found[number]) for number in (1, SETTLED, ROUNDS)})
    for before, after, slack in zip(found[SETTLED], found[ROUNDS], (1.05, 1.0, 1.1), strict=True):
        assert after <= before * slack
