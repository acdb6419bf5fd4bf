"""Whether a fleet grows with its rounds: memory, open files and files on disk, of 16 vehicles for 20 rounds.

`python benchmarks/bench_fleet_growth.py [VEHICLES [ROUNDS]]`. Memory is what the processes do not share with others
(private pages of smaps_rollup), in all and by kind of process.
"""

import os
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from flcav.federation.links.flower import start_fleet
from flcav.federation.loop import Schedule, federate
from flcav.fleet.supervisor import LOGS, read_processes
from flcav.storage.markdown import format_table

WEIGHTS = 250_000  # numbers of the model, of 4 bytes
HEADS = ("round", "s", "memory MB", "superlink", "proxy", "nodes", "executors", "forwarders", "open", "files", "MB")
KINDS = ("superlink", "proxy", "supernode", "executor", "forwarder")


def read_private_mb(pid: int) -> float:
    """Return the memory that a process shares with no other [MB]."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    sizes = {name: int(size) for name, size, *_ in (line.replace(":", "").split() for line in lines)}
    return (sizes["Private_Clean"] + sizes["Private_Dirty"]) * 1024 / 1e6


def measure(folder: Path) -> list[float]:
    """Return private memory [MB] of all processes and by kind, open files, files on disk, and their MB without logs."""
    memory, opened = defaultdict[str, float](float), 0
    for name, pid in read_processes(folder).items():
        memory[name.rpartition("-")[2]] += read_private_mb(pid)
        opened += sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    files = [path for path in folder.rglob("*") if path.is_file()]
    kept = sum(path.stat().st_size for path in files if LOGS not in path.parts) / 1e6
    return [sum(memory.values()), *(memory[kind] for kind in KINDS), opened, len(files), kept]


def main(vehicles: int = 16, rounds: int = 20) -> None:
    """Print the table, and what the whole run took."""
    from bench_fleet import Still  # by the name that vehicles import it by, too

    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]).rstrip(
        ":"
    )
    clients = {f"town/cav{number:02d}": Still() for number in range(vehicles)}
    begun = time.perf_counter()
    with start_fleet(vehicles) as deployment:
        print(f"{vehicles} vehicles are starting", flush=True)
        rows, last = [], [time.perf_counter()]

        def look(number: int, *_: object) -> None:
            found, now = measure(deployment.folder), time.perf_counter()
            rows.append(
                [str(number), f"{now - last[0]:.1f}", *(f"{each:.0f}" for each in found[:-1]), f"{found[-1]:.1f}"]
            )
            print(" ".join(rows[-1]), flush=True)
            last[0] = time.perf_counter()

        weights = {"w": np.zeros(WEIGHTS, np.float32)}
        federate(clients, weights, Schedule(rounds, 1, 0.1, 0.1, 3), runtime=deployment, on_round=look)
    print(format_table(HEADS, rows))
    print(f"{vehicles} vehicles, {rounds} rounds: {time.perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
