"""The object detector tuned twice to LiDARs of 16 to 128 beams, beside the network that it began with.

The network is the mean of the one that was begun with and of both tuned ones (Wortsman et al., "Model soups", ICML
2022): their weights are averaged, and scores are calibrated anew. It and the network that was begun with are evaluated
on the same simulated frames; real ones are evaluated by `flcav evaluate objects`, see the page.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import ConcatDataset

from flcav.config import InputError, Json, parse_config
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import open_split, record_split
from flcav.perception.agents import choose_frames
from flcav.perception.device import CPU, processor_of
from flcav.perception.objects.evaluate import ObjectsEvaluation
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS, TOWNS
from flcav.perception.study import read_recipe
from flcav.perception.training.loop import Checkpointing, Validation, train
from flcav.perception.training.run import CHECKPOINT, WEIGHTS
from flcav.perception.weights import Card, DataEntry, data_entry, load_network, read_card, save_network
from flcav.runs.engine import Step, Work, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.storage.files import sha256
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

Fields = Mapping[str, Json]
SEED, LEARNING_RATE = 1, 1e-3
THIN, ALIKE = 0.25, 1.6  # of `Augmentation`
DRAWN, STREETS, AUTHORED = "wide_streets", "streets", "objects"  # names of the recipes
FEW_BEAMS = 40  # most beams of a LiDAR with few
SHOWN = (("3d", 0.5), ("3d", 0.7))  # kinds of overlap and IoU of the tables
CAR = "Car AP 3d at 0.5"
RECORDED = ("town", "seed", "scenes", "cavs", "vehicle_rig", "randomise")  # fields that the LiDARs follow from

HELD = {"town": "suburb", "split": "validation", "scenes": 2}


@dataclass(frozen=True)
class Tuning:
    """A training that begins with a trained network: its recordings, epochs, and share of returns that objects lose."""

    train: tuple[Fields, ...]
    validation: tuple[Fields, ...]  # the first also calibrates scores
    epochs: int
    fade: float  # of `Augmentation`

    def recordings(self, name: str) -> dict[str, Fields]:
        """Return the recipes of the recordings by step of the tuning `name`: those to train on, then the others."""
        training = {f"{name}-train-{number}": fields for number, fields in enumerate(self.train)}
        return training | {f"{name}-validation-{number}": fields for number, fields in enumerate(self.validation)}


TUNINGS: Mapping[str, Tuning] = {
    "lidars": Tuning(
        train=(
            *(
                {**read_recipe(DRAWN), "randomise": "lidars", "town": t, "seed": s}
                for t in TOWNS
                for s in range(33, 43, 2)
            ),
            *({**read_recipe(STREETS), "town": town, "seed": 43, "scenes": 2} for town in TOWNS),
            *({**read_recipe(AUTHORED), "town": town, "seed": 22, "scenes": 3} for town in TOWNS),
        ),
        validation=(
            {**read_recipe(DRAWN), **HELD, "randomise": "lidars", "seed": 143},
            {**read_recipe(STREETS), **HELD, "seed": 145},
        ),
        epochs=5,
        fade=0.0,
    ),
    "wide": Tuning(
        train=(
            *({**read_recipe(DRAWN), "town": town, "seed": seed} for town in TOWNS for seed in range(33, 47, 2)),
            *({**read_recipe(STREETS), "town": t, "seed": s, "scenes": 2} for t in TOWNS for s in (43, 47)),
            *({**read_recipe(AUTHORED), "town": town, "seed": 22, "scenes": 3} for town in TOWNS),
        ),
        validation=({**read_recipe(DRAWN), **HELD, "seed": 143}, {**read_recipe(STREETS), **HELD, "seed": 145}),
        epochs=8,
        fade=0.7,
    ),
}
LAST = "wide"  # the tuning whose validation frames calibrate the scores of the mean
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
    """Evaluations of the network that was begun with and of the mean, and the cards of the trainings."""

    start: str  # SHA-256 of the weights that were begun with
    tuned: Mapping[str, Card]  # by name of the tuning
    tests: Mapping[str, Mapping[str, ObjectsEvaluation]]  # by test and network, `BEFORE` or `NOW`
    recipes: Mapping[str, Fields]  # of the tests, by name
    provenance: Provenance


def tune(work: Work, *, start: str, name: str) -> Json:
    """Train the network of the file `start` on, or resume its training; return the card of the best epoch as JSON."""
    tuning, network, known = TUNINGS[name], load_network(OBJECTS, Path(start)), read_card(start)
    every = [open_split(work.inputs[step]) for step in tuning.recordings(name)]
    data, held = every[: len(tuning.train)], every[len(tuning.train) :]
    how = replace(network.config.augmentation, fade=tuning.fade, thin=THIN, alike=ALIKE)
    network.config = replace(network.config, augmentation=how)
    samples: Any = ConcatDataset([OBJECTS.samples(each, network.config) for each in data])  # pyright: ignore
    per_epoch = len(samples) // OBJECTS.practice.batch

    def score(trained: nn.Module) -> float:
        assert isinstance(trained, Second)
        return sum(OBJECTS.evaluate(trained, each).score for each in held) / len(held)

    history = train(
        OBJECTS,
        network,
        samples,
        steps=tuning.epochs * per_epoch,
        learning_rate=LEARNING_RATE,
        seed=SEED,
        checkpointing=Checkpointing(work.folder / CHECKPOINT, of=sha256(Path(start))),
        validation=Validation(score, per_epoch, patience=tuning.epochs),
        progress=work.report,
    )
    OBJECTS.calibrate(network, held[0])
    entries = [data_entry(each, choose_frames(OBJECTS, network.config, each, "all")) for each in (*data, held[0])]
    training: dict[str, Json] = {
        "begun_with": sha256(Path(start)),
        "epochs": tuning.epochs,
        "batch": OBJECTS.practice.batch,
        "learning_rate": LEARNING_RATE,
        "schedule": OBJECTS.practice.schedule,
        "steps": len(history.losses),
        "loss": float(history.losses[-per_epoch:].mean()),
        "scores": [round(float(each), 4) for each in history.scores],
    }
    card = _write_card(known, len(samples), training, tuple(entries[:-1]), entries[-1], network, held[0])
    save_network(OBJECTS, network, work.folder / WEIGHTS, card)
    return card.model_dump(mode="json")


def average(work: Work, *, start: str) -> Json:
    """Save the mean of the network of the file `start` and of the tuned ones; return its card as JSON."""
    tuned = [work.inputs[_tuned(name)] / WEIGHTS for name in TUNINGS]
    networks = [load_network(OBJECTS, path) for path in (Path(start), *tuned)]
    cards, network = [read_card(path) for path in tuned], networks[-1]
    network.load_state_dict(average_weights([each.state_dict() for each in networks]))
    held = open_split(work.inputs[f"{LAST}-validation-0"])
    OBJECTS.calibrate(network, held)
    training: dict[str, Json] = {
        "begun_with": sha256(Path(start)),
        "averaged": 1 + len(tuned),
        "steps": sum(card.learning.steps for card in cards),
        "loss": cards[-1].learning.loss,
    }
    entries = tuple(entry for card in cards for entry in card.data)
    known = read_card(start)
    card = _write_card(
        known, sum(card.samples for card in cards), training, entries, cards[-1].validation, network, held
    )
    save_network(OBJECTS, network, work.folder / WEIGHTS, card)
    return card.model_dump(mode="json")


def average_weights(states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Return the means of the floating-point tensors of networks, and other tensors as the last network has them."""
    last = states[-1]
    return {
        name: torch.stack([state[name] for state in states]).mean(0) if last[name].is_floating_point() else last[name]
        for name in last
    }


def _write_card(
    known: Card,
    samples: int,
    training: Mapping[str, Json],
    data: tuple[DataEntry, ...],
    validation: DataEntry | None,
    network: Second,
    held: Dataset,
) -> Card:
    """Return the card of a network like that of the card `known`, evaluated on the validation data `held`."""
    return Card(
        task=OBJECTS.name,
        network=known.network,
        parameters=known.parameters,
        seed=SEED,
        samples=samples,
        training=training,
        data=data,
        validation=validation,
        metrics=OBJECTS.evaluate(network, held).as_json(),
        torch=str(torch.__version__),
        threads=torch.get_num_threads(),
        processor=processor_of(CPU),
    )


def _tuned(name: str) -> str:
    return f"{name}-tuned"


def test(work: Work, *, start: str) -> Json:
    """Return the evaluations of both networks on all tests as JSON, by test and network."""
    networks = {
        BEFORE: load_network(OBJECTS, Path(start)),
        NOW: load_network(OBJECTS, work.inputs["averaged"] / WEIGHTS),
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
    training = [
        (name, card.samples, card.learning.steps, ", ".join(f"{score:.3f}" for score in card.learning.scores))
        for name, card in results.tuned.items()
    ]
    return {
        "classes": format_table(heads, _list_scores(results)),
        "cars": format_table(counts, _list_counts(results)),
        "training": format_table(
            ("training", "sweeps", "steps", "validation after each epoch; the best is kept"), training
        ),
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


def make_result(start: Path, values: Mapping[str, Any]) -> BeamsResult:
    """Return the result by the values of the steps, by name."""
    tests = {
        name: {when: ObjectsEvaluation.from_json(each, name) for when, each in found.items()}
        for name, found in values["tested"].items()
    }
    tuned = {name: Card.model_validate(values[_tuned(name)]) for name in TUNINGS}
    return BeamsResult(sha256(start), tuned, tests, TESTS, provenance())


def _run(out: Path, options: Options) -> Outcome[BeamsResult]:
    if options.weights is None:
        raise InputError("reproduce beams: needs --weights, those of a network of task-objects-streets to begin with")
    start = {"start": str(options.weights.resolve())}
    tested = {f"test-{name}": fields for name, fields in TESTS.items()}
    recorded = {name: tuning.recordings(name) for name, tuning in TUNINGS.items()}
    held = f"{LAST}-validation-0"
    everything = {step: fields for steps in (*recorded.values(), tested) for step, fields in steps.items()}
    steps = [
        *(Step(step, record_split, {"recipe": fields}) for step, fields in everything.items()),
        *(Step(_tuned(name), tune, {**start, "name": name}, tuple(known)) for name, known in recorded.items()),
        Step("averaged", average, start, (*map(_tuned, TUNINGS), held)),
        Step("tested", test, start, ("averaged", *tested)),
    ]
    with options.show_steps(options.title) as notify:
        values = run_steps(steps, out, **options.how(notify))
    result = make_result(options.weights, values)
    cars = [
        f"{name}: AP of cars in 3D at 0.5 {each[BEFORE].numbers()[CAR]:.3f} before, {each[NOW].numbers()[CAR]:.3f} now"
        for name, each in result.tests.items()
    ]
    return Outcome(result, {}, cars)


EXPERIMENT = Experiment(BeamsResult, _run, tables, takes=("jobs", "engine", "stale", "weights"))
