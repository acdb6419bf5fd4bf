"""The object detector tuned to LiDARs of 16 to 128 beams, beside the network that it began with.

Both are evaluated on the same simulated frames; real ones are evaluated by `flcav evaluate objects`, see the page.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import ConcatDataset

from flcav.config import InputError, Json, parse_config
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import open_split, record_split
from flcav.perception.agents import choose_frames
from flcav.perception.device import CPU, processor_of
from flcav.perception.objects.evaluate import ObjectsEvaluation
from flcav.perception.objects.model import Augmentation, Second, SecondConfig
from flcav.perception.objects.task import OBJECTS, TOWNS
from flcav.perception.study import read_recipe
from flcav.perception.training.loop import Checkpointing, Validation, train
from flcav.perception.training.run import CHECKPOINT, WEIGHTS
from flcav.perception.weights import Card, data_entry, load_network, read_card, save_network
from flcav.runs.engine import Step, Work, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import sha256
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

Fields = Mapping[str, Json]
SEED, EPOCHS, LEARNING_RATE = 1, 8, 1e-3
FADE, THIN, ALIKE = 0.7, 0.25, 1.6  # of `Augmentation`
DRAWN, STREETS, AUTHORED = "wide_streets", "streets", "objects"  # names of the recipes
FEW_BEAMS = 40  # most beams of a LiDAR with few
SHOWN = (("3d", 0.5), ("3d", 0.7))  # kinds of overlap and IoU of the tables
CAR = "Car AP 3d at 0.5"
RECORDED = ("town", "seed", "scenes", "cavs", "vehicle_rig", "randomise")  # fields that the LiDARs follow from

TRAINING: tuple[Fields, ...] = (
    *({**read_recipe(DRAWN), "town": town, "seed": seed} for town in TOWNS for seed in range(33, 47, 2)),
    *({**read_recipe(STREETS), "town": town, "seed": seed, "scenes": 2} for town in TOWNS for seed in (43, 47)),
    *({**read_recipe(AUTHORED), "town": town, "seed": 22, "scenes": 3} for town in TOWNS),
)
HELD = {"town": "suburb", "split": "validation", "scenes": 2}
VALIDATION: Mapping[str, Fields] = {
    "validation-wide": {**read_recipe(DRAWN), **HELD, "seed": 143},
    "validation-streets": {**read_recipe(STREETS), **HELD, "seed": 145},
}
TESTED = {"split": "test", "scenes": 6}
TESTS: Mapping[str, Fields] = {
    **{town: {**read_recipe(AUTHORED), **TESTED, "town": town, "seed": 471, "spins_per_scene": 4} for town in TOWNS},
    "streets": {**read_recipe(STREETS), **TESTED, "town": "suburb", "seed": 473},
    "wide": {**read_recipe(DRAWN), **TESTED, "town": "suburb", "seed": 475},
    "wide-arterial": {**read_recipe(DRAWN), **TESTED, "town": "arterial", "seed": 477},
}
FEW = {f"{name}, {FEW_BEAMS} beams and fewer": name for name in TESTS if name.startswith("wide")}
BEFORE, NOW = "before", "now"


@dataclass(frozen=True)
class BeamsResult(Record):
    """Evaluations of the network that was begun with and of the tuned one, and the card of the latter."""

    start: str  # SHA-256 of the weights that were begun with
    card: Card
    tests: Mapping[str, Mapping[str, ObjectsEvaluation]]  # by test and network, `BEFORE` or `NOW`
    recipes: Mapping[str, Fields]  # of the tests, by name
    provenance: Provenance


def tuning_config(begun: SecondConfig) -> SecondConfig:
    """Return the configuration of the training: that of the network begun with, and its sweeps lose returns."""
    how: Augmentation = replace(begun.augmentation, fade=FADE, thin=THIN, alike=ALIKE)
    return replace(begun, augmentation=how)


def tune(work: Work, *, start: str, epochs: int) -> Json:
    """Train the network of the file `start` on, or resume its training; return the card of the best epoch as JSON."""
    data = [open_split(work.inputs[f"train-{number}"]) for number in range(len(TRAINING))]
    held = [open_split(work.inputs[name]) for name in VALIDATION]
    network, known = load_network(OBJECTS, Path(start)), read_card(start)
    network.config = tuning_config(network.config)
    samples: Any = ConcatDataset([OBJECTS.samples(each, network.config) for each in data])  # pyright: ignore
    per_epoch = len(samples) // OBJECTS.practice.batch

    def score(trained: nn.Module) -> float:
        assert isinstance(trained, Second)
        return sum(OBJECTS.evaluate(trained, each).score for each in held) / len(held)

    history = train(
        OBJECTS,
        network,
        samples,
        steps=epochs * per_epoch,
        learning_rate=LEARNING_RATE,
        seed=SEED,
        checkpointing=Checkpointing(work.folder / CHECKPOINT, of=sha256(Path(start))),
        validation=Validation(score, per_epoch, patience=epochs),
        progress=work.report,
    )
    OBJECTS.calibrate(network, held[0])
    entries = [data_entry(each, choose_frames(OBJECTS, network.config, each, "all")) for each in (*data, held[0])]
    card = Card(
        task=OBJECTS.name,
        network=known.network,
        parameters=known.parameters,
        seed=SEED,
        samples=len(samples),
        training={
            "begun_with": sha256(Path(start)),
            "epochs": epochs,
            "batch": OBJECTS.practice.batch,
            "learning_rate": LEARNING_RATE,
            "schedule": OBJECTS.practice.schedule,
            "steps": len(history.losses),
            "loss": float(history.losses[-per_epoch:].mean()),
            "scores": [round(float(each), 4) for each in history.scores],
        },
        data=tuple(entries[:-1]),
        validation=entries[-1],
        metrics=OBJECTS.evaluate(network, held[0]).as_json(),
        torch=str(torch.__version__),
        threads=torch.get_num_threads(),
        processor=processor_of(CPU),
    )
    save_network(OBJECTS, network, work.folder / WEIGHTS, card)
    return card.model_dump(mode="json")


def test(work: Work, *, start: str) -> Json:
    """Return the evaluations of both networks on all tests as JSON, by test and network."""
    networks = {
        BEFORE: load_network(OBJECTS, Path(start)),
        NOW: load_network(OBJECTS, work.inputs["tuned"] / WEIGHTS),
    }
    found: dict[str, dict[str, Json]] = {}
    for name in (*TESTS, *FEW):
        data = open_split(work.inputs[f"test-{FEW.get(name, name)}"])
        frames = _few_beams(data) if name in FEW else None
        found[name] = {when: OBJECTS.evaluate(each, data, frames).as_json() for when, each in networks.items()}
    return found


def _few_beams(data: Dataset) -> Sequence[int]:
    """Return the numbers of the frames of vehicles whose LiDARs have `FEW_BEAMS` beams or fewer."""
    recipe = parse_config(Recipe, {name: data.manifest.recipe[name] for name in RECORDED}, data.folder.name)
    rigs = EmbeddedSource(recipe).vehicle_rigs
    beams = {f"cav{number}": next(iter(rig.lidars.values())).settings.channels for number, rig in enumerate(rigs)}
    return [number for number, key in enumerate(data.keys) if beams[key.agent] <= FEW_BEAMS]


def tables(results: BeamsResult) -> dict[str, str]:
    """Return Markdown by name: AP of both networks by test and class, counts of cars by distance, and the training."""
    heads = ("test", "class", "objects", *(f"{kind} at {iou}, {when}" for kind, iou in SHOWN for when in (BEFORE, NOW)))
    counts = ("test", "distance [m]", "cars", "found, before", "now", "false a frame, before", "now")
    scores = ", ".join(f"{score:.3f}" for score in results.card.learning.scores)
    training = (results.card.samples, results.card.learning.steps, scores)
    return {
        "classes": format_table(heads, _list_scores(results)),
        "cars": format_table(counts, _list_counts(results)),
        "training": format_table(("sweeps", "steps", "validation after each epoch; the best is kept"), [training]),
    }


def _list_scores(results: BeamsResult) -> list[list[str]]:
    rows = []
    for test, found in results.tests.items():
        known = {when: {(row.label, row.kind, row.iou): row for row in found[when].scores} for when in (BEFORE, NOW)}
        for label in dict.fromkeys(row.label for row in found[NOW].scores):
            cells = [known[when][label, kind, iou].ap for kind, iou in SHOWN for when in (BEFORE, NOW)]
            targets = known[NOW][label, *SHOWN[0]].targets
            rows.append([test, label, str(targets), *("-" if ap is None else f"{ap:.3f}" for ap in cells)])
    return rows


def _list_counts(results: BeamsResult) -> list[list[str]]:
    rows = []
    for test, found in results.tests.items():
        counted = {
            when: {row.distance_m: row for row in found[when].counts or () if row.label == "Car"}
            for when in (BEFORE, NOW)
        }
        for low, high in counted[NOW]:
            before, now = counted[BEFORE].get((low, high)), counted[NOW][low, high]
            cells = ("-", str(now.found), "-", f"{now.false_a_frame:.2f}")
            if before is not None:
                cells = (str(before.found), cells[1], f"{before.false_a_frame:.2f}", cells[3])
            rows.append([test, f"{low} to {high}", str(now.targets), *cells])
    return rows


def _run(out: Path, options: Options) -> Outcome[BeamsResult]:
    if options.weights is None:
        raise InputError("reproduce beams: needs --weights, those of a network of task-objects-streets to begin with")
    start = {"start": str(options.weights.resolve())}
    recorded = {f"train-{number}": fields for number, fields in enumerate(TRAINING)} | dict(VALIDATION)
    tested = {f"test-{name}": fields for name, fields in TESTS.items()}
    steps = [
        *(Step(name, record_split, {"recipe": fields}) for name, fields in (recorded | tested).items()),
        Step("tuned", tune, {**start, "epochs": EPOCHS}, tuple(recorded)),
        Step("tested", test, start, ("tuned", *tested)),
    ]
    with options.show_steps(options.title) as notify:
        values = run_steps(steps, out, **options.how(notify))
    tests = {
        name: {when: ObjectsEvaluation.from_json(each, name) for when, each in found.items()}
        for name, found in values["tested"].items()
    }
    card = Card.model_validate(values["tuned"])
    result = BeamsResult(sha256(options.weights), card, tests, TESTS, provenance())
    cars = [
        f"{name}: AP of cars in 3D at 0.5 {each[BEFORE].numbers()[CAR]:.3f} before, {each[NOW].numbers()[CAR]:.3f} now"
        for name, each in tests.items()
    ]
    return Outcome(result, {}, cars)


EXPERIMENT = Experiment(BeamsResult, _run, tables, takes=("jobs", "engine", "stale", "weights"))
