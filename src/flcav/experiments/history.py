"""History for the planner: what other seeds reached after so many samples, edge rounds and cloud rounds.

`python -m flcav.experiments.history --out DIR` makes `data/history.csv` anew, with plans chosen by hand.
"""

import argparse
import csv
import sys
from pathlib import Path

from flcav.experiments.demo import demo_protocol
from flcav.experiments.pipeline import cloud_step, edge_step, rounds_step, shared_steps, test_step
from flcav.experiments.planning import HISTORY, fixed_plan
from flcav.experiments.protocol import REGIONS
from flcav.experiments.steps import Step, run_side_by_side
from flcav.files import atomic_path

PLANS = ((101, 320, 6, 3), (102, 80, 6, 3), (101, 80, 0, 0), (102, 320, 0, 0))  # seed, samples, edge, cloud rounds
COLUMNS = ("seed", "samples", "edge_rounds", "cloud_rounds", "accuracy")
FRAMES = 10_000  # every test frame, so that all points are on the same ones


def steps_for(seed: int, samples: int, edge_rounds: int, cloud_rounds: int) -> list[Step]:
    """Return the steps of one run of the history."""
    update = {"wireless_mb": 1e4, "wireline_mb": 1e4}  # by hand: nothing binds
    protocol = demo_protocol(seed).model_copy(update=update)
    chosen = {"samples": samples, "edge_rounds": edge_rounds, "cloud_rounds": cloud_rounds}
    steps = shared_steps(protocol, Step("plan", fixed_plan, chosen))
    if not edge_rounds:
        used = ("plan", "pretrain", "suburb-pool", "suburb-validation", "grid-test")
        return [*(step for step in steps if step.name in used), test_step("pretrain", "grid")]
    steps += [edge_step(protocol, town, "chosen") for town in REGIONS] + [cloud_step(protocol)]
    return [
        *steps,
        test_step("pretrain", "grid"),
        rounds_step("grid-edge-chosen", "grid", FRAMES),
        rounds_step("cloud", "grid", FRAMES),
    ]


def main(arguments: list[str]) -> None:
    """Run the plans, each in its own folder below --out, and write the history."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)
    runs = {options.out / f"{plan[0]}-{plan[1]}": steps_for(*plan) for plan in PLANS}
    results = run_side_by_side(runs, jobs=options.jobs, notify=_print)
    rows: list[tuple[float, ...]] = []
    for (seed, samples, edge_rounds, _), values in zip(PLANS, results.values(), strict=True):
        rows.append((seed, samples, 0, 0, values["test-pretrain-grid"]["ap50"]))
        for row in values.get("rounds-grid-edge-chosen-grid", []):
            rows.append((seed, samples, row["round"], 0, row["ap50"]))
        for row in values.get("rounds-cloud-grid", []):
            rows.append((seed, samples, edge_rounds, row["round"], row["ap50"]))
    with atomic_path(Path(str(HISTORY))) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows([*row[:4], f"{row[4]:.4f}"] for row in rows)


def _print(step: str, done: int, total: int, note: str) -> None:
    print(f"{step} {done}/{total} {note}", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
