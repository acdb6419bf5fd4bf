"""Run every command on mutated inputs: `python tools/mutate_inputs.py --cases 100000 --jobs 2`.

Prints each case that breaks the contract of the command line (exit code 0 or 2; on 2 one sentence on stderr, and
nothing half-written), then a summary; exit code 1 where there was one. A case is named by its number: `--first N
--cases 1` repeats it. The inputs, mutations and commands are those of `tests/contract/test_mutated_inputs.py`.
"""

import argparse
import dataclasses
import json
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "contract"))

MEMORY_B = 12 << 30  # address space of a worker [bytes]
HANGS_S = 1800.0  # without an outcome, after which a worker is killed
BATCH = 1000  # cases of one worker process


def main() -> None:
    """Run the cases in worker processes and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--limit-s", type=float, default=20.0, help="of computing; a case that takes longer is left, and counted"
    )
    parser.add_argument("--command", default="", help="only commands that begin so")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.worker:
        work(asked)
        return
    with tempfile.TemporaryDirectory() as folder:
        from valid_inputs import make_inputs

        make_inputs(Path(folder) / "inputs")
        numbers = range(asked.first, asked.first + asked.cases)
        batches = [numbers[start : start + BATCH] for start in range(0, len(numbers), BATCH)]
        tally = Tally(asked.cases)
        hands = [threading.Thread(target=supervise, args=(batches, tally, asked, folder)) for _ in range(asked.jobs)]
        for hand in hands:
            hand.start()
        for hand in hands:
            hand.join()
    print(tally.summary(), flush=True)
    sys.exit(1 if tally.broken else 0)


class Tally:
    """Counts of the outcomes of all cases so far."""

    def __init__(self, cases: int) -> None:
        self.cases, self.codes, self.broken, self.slow = cases, Counter[str](), Counter[str](), 0
        self._lock, self._start = threading.Lock(), time.monotonic()

    def add(self, outcome: dict[str, Any]) -> None:
        """Count an outcome, and print it where the contract is broken."""
        with self._lock:
            self.slow += outcome["slow"]
            self.codes["slow" if outcome["slow"] else f"exit {outcome['code']}"] += 1
            if outcome["slow"]:
                print(f"slow: {outcome['number']}: flcav {outcome['words']} | {outcome['done']}", flush=True)
            if outcome["broken"]:
                reason = outcome["broken"].strip().splitlines()[-1][:200]
                self.broken[reason] += 1
                print(f"case {outcome['number']}: flcav {outcome['words']}\n  {outcome['done']}", flush=True)
                print("  " + outcome["broken"].strip()[-1500:].replace("\n", "\n  "), flush=True)
                if outcome["said"]:
                    print("  stderr: " + outcome["said"].strip()[:1500].replace("\n", "\n  "), flush=True)
            if (done := self.codes.total()) % 500 == 0:
                print(self.summary() + f" ({done / (time.monotonic() - self._start):.1f} cases/s)", flush=True)

    def summary(self) -> str:
        """Return the counts in words."""
        counts = ", ".join(f"{count} {code}" for code, count in sorted(self.codes.items()))
        return f"{self.codes.total()} of {self.cases} cases: {counts}; {self.broken.total()} broke the contract"


def supervise(batches: list[range], tally: Tally, asked: argparse.Namespace, folder: str) -> None:
    """Run batches in one worker process after another; a worker that dies or hangs breaks the contract."""
    while batches:
        left = batches.pop(0)
        while left:
            command = [sys.executable, __file__, "--worker", folder, "--limit-s", str(asked.limit_s)]
            command += ["--first", str(left[0]), "--cases", str(len(left)), "--command", asked.command]
            with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as worker:
                assert worker.stdout is not None
                assert worker.stderr is not None
                done = 0
                hangs = threading.Timer(HANGS_S, worker.kill)
                hangs.start()
                for line in worker.stdout:
                    hangs.cancel()
                    hangs = threading.Timer(HANGS_S, worker.kill)
                    hangs.start()
                    tally.add(json.loads(line))
                    done += 1
                hangs.cancel()
                last = worker.stderr.read()[-1500:]
            if done < len(left):
                died = {"number": left[done], "words": "?", "done": "?", "code": worker.returncode, "slow": False}
                tally.add({**died, "said": "", "broken": f"{last}\nthe process died: {worker.returncode}"})
                done += 1
            left = left[done:]


def work(asked: argparse.Namespace) -> None:
    """Run cases, and print the outcome of each as JSON."""
    from mutated_commands import calls, run_case

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_B, MEMORY_B))
    choices = [call for call in calls() if call.words.startswith(asked.command)]
    answers = sys.stdout
    with tempfile.TemporaryDirectory(dir=asked.worker) as folder:
        for number in range(asked.first, asked.first + asked.cases):
            outcome = run_case(asked.worker / "inputs", number, Path(folder) / "case", choices, asked.limit_s)
            print(json.dumps(dataclasses.asdict(outcome)), file=answers, flush=True)


if __name__ == "__main__":
    main()
