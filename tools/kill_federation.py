"""Kill a federation at random moments, and see that it ends with the weights of an undisturbed one.

    python tools/kill_federation.py recipes/runs/demo.yaml --out out/kills --kills 100
    python tools/kill_federation.py recipes/runs/demo.yaml --out out/kills --kills 100 --jobs 2
    python tools/kill_federation.py recipes/runs/demo.yaml --out out/kills --kills 100 --jobs 2 --stage cloud

Stage II of the recipe's first federating region and task, or stage III of its first task (`--stage cloud`), is
federated once in one process, then again and again by processes that get SIGKILL after a random time; each goes on
where the last one stopped. Vehicles train in `--jobs` client processes, which end with the process that is killed.
Weights, ledger and result have to be the same files. Exits with 1 where they are not. What comes before the stage is
done first, as by `flcav run`. Noise of differential privacy has to be `seeded`: by secrets no two federations are the
same.
"""

import argparse
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from flcav.interface.progress import ignore_progress
from flcav.machine.threads import use_threads
from flcav.runs.edge_stage import WORK, list_needed
from flcav.runs.engine import Step, ignore_steps, run_steps
from flcav.runs.engine.step import StepRecord, read_record
from flcav.runs.engine.workers import perform
from flcav.runs.provenance import provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, load_run_recipe
from flcav.runs.results.saved import LEDGER, RESULT, WEIGHTS
from flcav.runs.stages.graph import Graph
from flcav.statistics.streams import stream
from flcav.storage.files import sha256

FILES = (LEDGER, RESULT)  # beside the weights
FORK = multiprocessing.get_context("fork")


def main() -> None:
    """Run the tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1, help="client processes; 1: vehicles train in the one killed")
    parser.add_argument("--stage", choices=(EDGE, CLOUD), default=EDGE, help="that is killed: II (edge) or III (cloud)")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    use_threads(1)
    graph, work = Graph(load_run_recipe(asked.recipe), asked.recipe.parent), asked.out / WORK
    privacy = graph.settings[MAIN].federation.privacy
    if privacy is not None and not privacy.seeded:
        parser.error("noise drawn by secrets differs from federation to federation; 'privacy.seeded' repeats it")
    step = find_step(graph, asked.stage)
    apart(lambda: run_steps([*list_needed(graph.steps, [step]), step], work, jobs=1, notify=ignore_steps, stale="redo"))
    record, whole, step = read_record(work / step.name), hashes(work / step.name), step.on(asked.jobs)
    assert record is not None
    shutil.rmtree(work / step.name)
    began = time.monotonic()
    apart(lambda: perform(step, work, record, provenance(), ignore_progress))
    whole_s, ends = time.monotonic() - began, [hashes(work / step.name)]
    ends += kill(step, work, record, whole_s, asked.kills, asked.seed)
    odd = sum(each != whole for each in ends)
    print(f"{asked.kills} kills, {len(ends)} federations ended, {odd} of them otherwise than an undisturbed one")
    sys.exit(bool(odd))


def find_step(graph: Graph, stage: str) -> Step:
    """Return the step of the first federation of a stage."""
    names, region, task = graph.names, graph.settings[MAIN].regions[0], next(iter(graph.recipe.tasks))
    wanted = names.cloud(MAIN, task) if stage == CLOUD else names.edge(MAIN, region, task)
    return next(step for step in graph.steps if step.name == wanted)


def apart(work: Callable[[], object]) -> None:
    """Do the work in a process of its own, so that this one has no fork server, which those to be killed start."""
    child = FORK.Process(target=work)
    child.start()
    child.join()
    if child.exitcode:
        sys.exit(1)  # it has said why


def kill(step: Step, work: Path, record: StepRecord, whole_s: float, kills: int, seed: int) -> list[dict[str, str]]:
    """Kill the step so many times, and return the hashes of its files at each end; the last one is let go."""
    rng, ends, done = stream(seed, "kills"), [], 0
    shutil.rmtree(work / step.name)
    while True:
        child = FORK.Process(target=perform, args=(step, work, record, provenance(), ignore_progress))
        child.start()
        child.join(float(rng.uniform(0, whole_s)) if done < kills else None)
        if child.is_alive():
            os.kill(child.pid or 0, signal.SIGKILL)
            child.join()
            done += 1
            continue
        assert child.exitcode == 0, f"the federation could not go on after {done} kills"
        ends.append(hashes(work / step.name))
        if done >= kills:
            return ends
        shutil.rmtree(work / step.name)


def hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that a federation leaves, by name; of all models, regions' own included."""
    weights = sorted(path.name for path in folder.glob(f"{Path(WEIGHTS).stem}*{Path(WEIGHTS).suffix}"))
    return {name: sha256(folder / name) for name in (*weights, *FILES)}


if __name__ == "__main__":
    main()
