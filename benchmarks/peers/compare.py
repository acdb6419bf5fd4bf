"""Seconds of a federated round: flcav beside a bare loop, pfl and Flower's simulation, on one core and on two.

`make bench-peers` builds the peers' environment, out/peers/federation, and runs this. Each peer does the task of
`work.py` in processes of its own, bound to the cores; rounds are taken in turns, so that load slows all alike, and the
first is not counted. All must end with the same weights. CPU time is of all processes of a peer.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
import venv
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
ENVIRONMENT = HERE.parents[1] / "out" / "peers" / "federation"
NAMES = {"bare": "bare loop", "flcav": "flcav", "pfl": "pfl 0.6", "flower": "Flower on Ray"}
AIMS = {"pfl": 1.05, "flower": 0.6}  # largest time of flcav / the peer's
NEAR = 1e-4  # relative: sums of absolute weights that count as the same


def prepare() -> Path:
    """Return the Python of the peers' environment, built where it is missing or its pins have changed."""
    pins, installed = HERE / "requirements.txt", ENVIRONMENT / "installed.txt"
    python = ENVIRONMENT / "bin" / "python"
    if not installed.is_file() or installed.read_text() != pins.read_text():
        venv.create(ENVIRONMENT, clear=True, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "--requirement", pins], check=True)
        installed.write_text(pins.read_text())
    return python


def spent(root: int) -> float:
    """Return the CPU time of a process and all below it, ended ones included [s]."""
    parents, ticks = {}, {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it ended
            continue
        parents[int(path.parent.name)] = int(fields[1])
        ticks[int(path.parent.name)] = sum(map(int, fields[11:15]))
    family = {root}
    while more := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= more
    return sum(ticks.get(pid, 0) for pid in family) / os.sysconf("SC_CLK_TCK")


@dataclass
class Peer:
    """A running peer, and what its rounds took."""

    process: "subprocess.Popen[str]"
    wall: list[float] = field(default_factory=list)  # [s]
    cpu: list[float] = field(default_factory=list)  # [s]
    weights: list[float] = field(default_factory=list)  # sum of absolute weights before the first round and after each

    def read(self) -> None:
        """Wait for the end of a round."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.process.args}: ended with {self.process.wait()}, see the logs in {ENVIRONMENT}")
        self.weights.append(float(line))

    def take_turn(self) -> None:
        """Let the peer do a round, and time it."""
        assert self.process.stdin is not None
        used, start = spent(self.process.pid), time.perf_counter()
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        self.read()
        self.wall.append(time.perf_counter() - start)
        self.cpu.append(spent(self.process.pid) - used)


def launch(name: str, python: Path, rounds: int, cores: list[int]) -> "subprocess.Popen[str]":
    """Start a peer, bound to these cores."""
    script = HERE / f"run_{name}.py"
    return subprocess.Popen(
        [python if name in ("pfl", "flower") else sys.executable, script, str(rounds), str(len(cores))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(ENVIRONMENT / f"{name}.log").open("w"),
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )


def compare(python: Path, cores: list[int], repeats: int) -> None:
    """Time the peers on these cores, and print medians and ratios."""
    peers: dict[str, Peer] = {}
    try:
        for name in NAMES:
            peers[name] = Peer(launch(name, python, repeats + 1, cores))
            peers[name].read()
        for _ in range(repeats + 1):
            for peer in peers.values():
                peer.take_turn()
        for peer in peers.values():
            peer.process.communicate()
    finally:
        for peer in peers.values():
            peer.process.kill()
    own = peers["flcav"]
    print(f"{len(cores)} core{'s' * (len(cores) > 1)}, a round of 50 users, median of {repeats}: wall s, CPU-s")
    for name, peer in peers.items():
        print(f"  {NAMES[name]:<14} {statistics.median(peer.wall[1:]):7.2f} {statistics.median(peer.cpu[1:]):7.2f}")
        apart = max(abs(one / other - 1) for one, other in zip(peer.weights, own.weights, strict=True))
        if apart > NEAR:
            raise SystemExit(f"{NAMES[name]}: other weights than flcav's, by {apart:.1e}")
    for name in [name for name in peers if name != "flcav"]:
        told = []
        for kind in ("wall", "cpu"):
            pairs = zip(getattr(own, kind)[1:], getattr(peers[name], kind)[1:], strict=True)
            told.append(f"{kind} {statistics.median(one / other for one, other in pairs):.3f}")
        aim = f" (aim <= {AIMS[name]})" if name in AIMS else ""
        print(f"  flcav / {NAMES[name]}: {', '.join(told)}{aim}", flush=True)


def main() -> None:
    """Compare on one core and on two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="rounds that are timed")
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2], help="numbers of cores")
    given = parser.parse_args()
    python, available = prepare(), sorted(os.sched_getaffinity(0))
    for count in given.cores:
        if count > len(available):
            print(f"{count} cores: there are {len(available)}")
            continue
        compare(python, available[:count], given.repeats)


if __name__ == "__main__":
    main()
