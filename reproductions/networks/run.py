"""Accuracy of detectors against the CPU time of their training, for a vehicle without a GPU.

Every candidate is trained as the demo pretrains its network: in `suburb`, with the same numbers of sweeps and steps.
Accuracy is AP on frames of that town and of `arterial`, in which the demo neither trains nor tests. Each seed draws its
own sweeps from one recording, and its own initial weights. CPU time is that of the training process, one thread, on
this machine; only its ratio to that of `tiny`, from the same command, carries over to other machines.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import open_split, record_split
from flcav.perception.objects.config import SecondConfig, pillars_config, tiny_config
from flcav.perception.objects.task import OBJECTS
from flcav.perception.study import read_recipe
from flcav.perception.task import build_network
from flcav.perception.training.loop import train
from flcav.report import style
from flcav.report.charts.studies import costs
from flcav.runs.engine import Notify, Step, Work, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import stream
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

REFERENCE, CHOSEN = "tiny", "pillars"
NETWORKS: Mapping[str, Callable[[], SecondConfig]] = {
    REFERENCE: tiny_config,
    "tiny, narrow": lambda: replace(tiny_config(), sparse_channels=(8, 16, 24, 24), bev_channels=(32, 48)),
    CHOSEN: pillars_config,
    "pillars, wide": lambda: replace(pillars_config(), pillar_channels=(32, 48), bev_channels=(64, 64)),
    "pillars of 20 cm": lambda: replace(
        pillars_config(), voxel_m=(0.2, 0.2, 4), pillar_channels=(32, 48), bev_channels=(64, 64)
    ),
    "pillars of 32 cm, one scale less": lambda: replace(
        pillars_config(), voxel_m=(0.32, 0.32, 4), pillar_channels=(32,), bev_channels=(48, 64)
    ),
}
TRAINED, SAMPLES, STEPS = "suburb", 48, 1000  # as in recipes/runs/demo.yaml
TOWNS = (TRAINED, "arterial")  # of the validation frames
RECORDING: Mapping[str, Mapping[str, Json]] = {  # fields of recordings that replace those of recipes/suburb.yaml
    "train": {"town": TRAINED, "seed": 3301, "scenes": 16},
    **{f"validation-{town}": {"town": town, "seed": 3302, "scenes": 10, "split": "validation"} for town in TOWNS},
}


@dataclass(frozen=True)
class TrainedNetwork:
    """A candidate in one seed: the CPU time of its training, and its accuracy by town."""

    seconds: float  # CPU time of training [s]
    ap50: Mapping[str, float]
    ap70: Mapping[str, float]


@dataclass(frozen=True)
class NetworkCost(Record):
    """Cost and accuracy of a candidate over seeds."""

    parameters: int
    seconds: float  # CPU time of training [s], median over seeds
    share: float  # median over seeds of its CPU time as a share of the reference's
    ap50: Mapping[str, MeanOverSeeds]  # by town
    ap70: Mapping[str, MeanOverSeeds]


@dataclass(frozen=True)
class NetworksResult(Record):
    """Results of the search: candidates by name, and those that no other beats in both time and accuracy."""

    networks: Mapping[str, NetworkCost]
    front: tuple[str, ...]  # Pareto front of time and mean AP50 over towns
    seeds: Mapping[str, Mapping[str, TrainedNetwork]]  # by seed and name
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return time and accuracy of every candidate, and the front, in words."""
        lines = [
            f"{name}: {cost.share:.2f} of the CPU time of {REFERENCE}; "
            + ", ".join(f"AP50 {mean.describe()} in {town}" for town, mean in cost.ap50.items())
            for name, cost in self.networks.items()
        ]
        return [*lines, f"Nothing is both faster and more accurate than {' and '.join(self.front)}."]


def search_networks(
    out: Path, *, seeds: Sequence[int], quick: bool, jobs: int, notify: Notify, stale: str, engine: str
) -> NetworksResult:
    """Run or finish the search in the folder `out`; `quick` is a smoke test of few frames and steps."""
    steps = list_steps(seeds, quick)
    values = run_steps(steps, out, jobs=jobs, notify=notify, stale=stale, engine=engine)
    by_seed = {
        str(seed): {name: TrainedNetwork(**values[_name_step(name, seed)]) for name in NETWORKS} for seed in seeds
    }
    networks = {name: _summarise(name, [*by_seed.values()]) for name in NETWORKS}
    return NetworksResult(networks, find_front(networks), by_seed, provenance())


def list_steps(seeds: Sequence[int], quick: bool) -> list[Step]:
    """Return the steps: recordings, and a training of each candidate per seed."""
    recorded = {name: {**read_recipe(TRAINED), **fields} for name, fields in RECORDING.items()}
    if quick:
        recorded = {name: {**fields, "scenes": 2, "spins_per_scene": 2} for name, fields in recorded.items()}
    steps = [Step(name, record_split, {"recipe": fields}) for name, fields in recorded.items()]
    size = {"samples": 4, "steps": 2} if quick else {"samples": SAMPLES, "steps": STEPS}
    for seed in seeds:
        for name in NETWORKS:
            steps.append(
                Step(_name_step(name, seed), train_candidate, {"name": name, "seed": seed, **size}, (*recorded,))
            )
    return steps


def _name_step(name: str, seed: int) -> str:
    return f"{name.replace(' ', '-').replace(',', '')}-seed{seed}"


def train_candidate(work: Work, *, name: str, seed: int, samples: int, steps: int) -> Json:
    """Train a candidate on a seed's draw of sweeps; return the fields of its `TrainedNetwork`."""
    config, data = NETWORKS[name](), open_split(work.inputs["train"])
    sweeps = np.sort(stream(seed, "sweeps").choice(len(data), min(samples, len(data)), replace=False)).tolist()
    dataset = OBJECTS.samples(data, config, sweeps)
    in_memory = [dataset[number] for number in range(len(dataset))]
    network = build_network(OBJECTS, config, seed)
    began = time.process_time()
    train(OBJECTS, network, in_memory, steps=steps, batch=2, seed=seed, progress=work.report)
    seconds = time.process_time() - began
    precision = {}
    for town in TOWNS:
        frames = open_split(work.inputs[f"validation-{town}"])
        outcomes = OBJECTS.outcomes(network, frames, range(len(frames)), work.report)
        once = np.ones((1, len(outcomes.scene)), dtype=np.int64)
        precision[town] = (
            float(OBJECTS.measure(outcomes, once)[0]),
            float(OBJECTS.further_measures["AP70"](outcomes, once)[0]),
        )
    ap50, ap70 = ({town: pair[number] for town, pair in precision.items()} for number in range(2))
    return {"seconds": seconds, "ap50": ap50, "ap70": ap70}


def _summarise(name: str, seeds: Sequence[Mapping[str, TrainedNetwork]]) -> NetworkCost:
    trained, reference = [seed[name] for seed in seeds], [seed[REFERENCE] for seed in seeds]
    return NetworkCost(
        parameters=sum(network.numel() for network in OBJECTS.build(NETWORKS[name]()).parameters()),
        seconds=float(np.median([network.seconds for network in trained])),
        share=float(np.median([a.seconds / b.seconds for a, b in zip(trained, reference, strict=True)])),
        ap50={town: mean_over_seeds([network.ap50[town] for network in trained], share=True) for town in TOWNS},
        ap70={town: mean_over_seeds([network.ap70[town] for network in trained], share=True) for town in TOWNS},
    )


def find_front(networks: Mapping[str, NetworkCost]) -> tuple[str, ...]:
    """Return the names of the candidates on the Pareto front of CPU time and mean AP50 over towns."""
    at = {name: (cost.seconds, np.mean([mean.mean for mean in cost.ap50.values()])) for name, cost in networks.items()}
    return tuple(
        name
        for name, (seconds, ap) in at.items()
        if not any(s <= seconds and a >= ap and (s, a) != (seconds, ap) for s, a in at.values())
    )


def draw_networks(results: NetworksResult) -> bytes:
    """Return a PNG of AP50 against CPU time for each town."""
    return style.png(
        costs(
            {town: {name: (cost.share, cost.ap50[town]) for name, cost in results.networks.items()} for town in TOWNS},
            f"CPU time of training, share of that of {REFERENCE}",
            "AP50",
            results.front,
        )
    )


def networks_tables(results: NetworksResult) -> dict[str, str]:
    """Return Markdown by name: networks."""
    rows = []
    for name, candidate in results.networks.items():
        ap50, ap70 = ([ap[town].describe() for town in TOWNS] for ap in (candidate.ap50, candidate.ap70))
        cost = (f"{candidate.parameters / 1e6:.2f} M", f"{candidate.share:.2f}", f"{candidate.seconds:.0f}")
        rows.append([name, *cost, *ap50, *ap70, "yes" if name in results.front else ""])
    titles = [f"{measure}, {town}" for measure in ("AP50", "AP70") for town in TOWNS]
    head = ("network", "parameters", "CPU time of training, share", "in seconds", *titles, "on the front")
    return {"networks": format_table(head, rows)}


def _run(out: Path, options: Options) -> Outcome[NetworksResult]:
    with options.show_steps(options.title) as notify:
        numbers = range(1, options.seeds + 1)
        results = search_networks(out, seeds=numbers, quick=options.quick, **options.how(notify))
    return Outcome(results, {"networks.png": draw_networks(results)}, results.sentences())


EXPERIMENT = Experiment(NetworksResult, _run, networks_tables)
