"""What labels by tracks cost in a run: CPU time and memory of tracking, and its share of bare detection.

RUN is the folder of a finished run, such as that of `flcav demo --out demo`. Each of its tracking steps is performed
again on the same sweeps, in a process of its own; it detects objects in every sweep around a training frame and links
them. The reference is detection alone, in each of these sweeps once. The bounds are those of the demo, over both towns:
120 CPU-s and 1 GB.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

from flcav.fusion.tracks import LEAST_SCORE
from flcav.interface.progress import ignore_progress
from flcav.machine.threads import use_threads
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.runs.engine import Work
from flcav.runs.frames import Frames, list_window
from flcav.runs.labels.tracks import WINDOW_S, load_tracks
from flcav.runs.results.run import Run
from flcav.runs.stages.graph import Graph
from flcav.runs.stages.tracking import TrackSettings, track_step
from flcav.runs.training.learning import load_stage_network

BOUND_S, BOUND_MB = 120, 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    run = parser.parse_args().run
    graph, total_s, most_mb = Graph(Run.load(run).recipe, run), 0.0, 0.0
    context = multiprocessing.get_context("spawn")
    for step in graph.steps:
        if step.run is track_step:
            inputs = {need: run / "work" / need for need in step.needs}
            with context.Pool(1) as pool:
                spent_s, peak_mb = pool.apply(track_again, (step.arguments["settings"], inputs))
            with context.Pool(1) as pool:
                bare_s, sweeps = pool.apply(
                    detect_again, (step.arguments["settings"], inputs, run / "work" / step.name)
                )
            total_s, most_mb = total_s + spent_s, max(most_mb, peak_mb)
            told = (
                f"{spent_s:.0f} CPU-s, {peak_mb:.0f} MB, {spent_s / bare_s:.2f} of detection in {sweeps} sweeps alone"
            )
            print(f"{step.name}: {told}")
    print(f"together {total_s:.0f} CPU-s (bound {BOUND_S}), at most {most_mb:.0f} MB (bound {BOUND_MB})")


def track_again(settings: TrackSettings, inputs: dict[str, Path]) -> tuple[float, float]:
    """Return the CPU time [s] of a tracking step, and the memory of its process at most [MB]."""
    use_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.process_time()
        track_step(Work(Path(folder), inputs, ignore_progress), settings)
        return time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def detect_again(settings: TrackSettings, inputs: dict[str, Path], made: Path) -> tuple[float, int]:
    """Return the CPU time [s] of detecting in each sweep that the step in the folder `made` tracked through once."""
    use_threads(1)
    network = load_stage_network(OBJECTS, inputs[settings.inputs.pretrain])
    split = Frames.open(inputs[settings.inputs.frames])
    sweeps = list_window(split, tuple(load_tracks(made)), WINDOW_S)
    begun = time.process_time()
    for number in sweeps:
        detect_in(network, [split.data.frame(number)], score_threshold=LEAST_SCORE)
    return time.process_time() - begun, len(sweeps)


if __name__ == "__main__":
    main()
