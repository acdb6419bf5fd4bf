"""Kill a federation at random moments, and see that it ends with the weights of an undisturbed one.

    python tools/kill_federation.py recipes/runs/demo.yaml --out out/kills --kills 100

Stage II of the recipe's first federating region and task is federated once, then again and again by processes that get
SIGKILL after a random time; each goes on where the last one stopped. Weights, ledger and result have to be the same
files. Exits with 1 where they are not. What comes before stage II is done first, as by `flcav federate`.
"""

import argparse
import multiprocessing
import os
import shutil
import signal
import sys
import time
from pathlib import Path

from flcav.files import sha256
from flcav.pipeline.federations.alone import WORK, federate_regions, list_federations
from flcav.pipeline.graph.graph import Graph
from flcav.pipeline.provenance import provenance
from flcav.pipeline.recipe import MAIN, load_run_recipe
from flcav.pipeline.results.saved import LEDGER, RESULT, WEIGHTS
from flcav.pipeline.steps import Step
from flcav.pipeline.steps.engines import perform
from flcav.pipeline.steps.step import Record, read_record
from flcav.progress import ignore_progress
from flcav.seeds import stream
from flcav.threads import use_threads

FILES = (WEIGHTS, LEDGER, RESULT)


def main() -> None:
    """Run the tool."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    use_threads(1)
    recipe, beside = load_run_recipe(asked.recipe), asked.recipe.parent
    federate_regions(recipe, asked.out, beside=beside, jobs=1, stale="redo")
    graph = Graph(recipe, beside)
    name, (arm, region, task) = next(iter(list_federations(graph, MAIN).items()))
    step = next(each for each in graph.steps if each.name == graph.names.edge(arm, region, task))
    work, record = asked.out / WORK, read_record(asked.out / WORK / name)
    assert record is not None
    shutil.rmtree(work / step.name, ignore_errors=True)
    began = time.monotonic()
    perform(step, work, record, provenance(), ignore_progress)
    whole_s, whole = time.monotonic() - began, hashes(work / step.name)
    ends = kill(step, work, record, whole_s, asked.kills, asked.seed)
    odd = sum(each != whole for each in ends)
    print(f"{asked.kills} kills, {len(ends)} federations ended, {odd} of them otherwise than an undisturbed one")
    sys.exit(bool(odd))


def kill(step: Step, work: Path, record: Record, whole_s: float, kills: int, seed: int) -> list[dict[str, str]]:
    """Kill the step so many times, and return the hashes of its files at each end; the last one is let go."""
    rng, context, ends, done = stream(seed, "kills"), multiprocessing.get_context("fork"), [], 0
    shutil.rmtree(work / step.name)
    while True:
        child = context.Process(target=perform, args=(step, work, record, provenance(), ignore_progress))
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
    """Return the SHA-256 of the files that a federation leaves, by name."""
    return {name: sha256(folder / name) for name in FILES}


if __name__ == "__main__":
    main()
