"""Edge FL of the road task where the paint is worn: the packaged network, taught by the vehicles of a region.

A region has its town, light and wear. Its vehicles train on the map's labels and send their weights, an edge server
averages them. F1 of lane lines is measured in the region before and after, and at home: in a town of the network's
training, with fresh paint. Seeds differ in order and augmentation; they share recordings and the first network, so that
intervals over seeds cover local training alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.experiments.study import describe_limits, open_split, record_split
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.interface.progress import ignore_progress
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient
from flcav.perception.networks import resolve_network
from flcav.perception.road.evaluate import RoadEvaluation
from flcav.perception.road.task import ROAD
from flcav.perception.study import RecipeFields, read_recipe
from flcav.perception.weights import from_arrays, to_arrays
from flcav.report import style
from flcav.report.charts.studies import Bar, precisions
from flcav.runs.engine import Step, Work, run_steps
from flcav.runs.provenance import Provenance, provenance
from flcav.statistics.seeds import mean_over_seeds
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_bullets, format_table

HOME = "home"
GAIN = 0.05  # aim: least gain of F1 in a region
EFFECT = 0.02  # deviation from the aim that the experiment should detect
WORN = 0.9
VEHICLES, SCENES, TEST_SCENES = 4, 2, 3
ROUNDS, STEPS, RATES = 3, 10, (1e-3, 3e-4)
BUDGET_MB = 10_000.0  # of no effect: what is sent is counted


@dataclass(frozen=True)
class Region:
    """Recording settings of a region."""

    town: str
    seed: int
    weather: tuple[str, ...]
    worn: float


REGIONS: Mapping[str, Region] = {
    "worn, by day": Region("grid", 671, ("clear", "cloudy", "overcast"), WORN),
    "worn, at night": Region("ring", 681, ("night",), WORN),
    HOME: Region("arterial", 691, ("clear", "cloudy", "overcast"), 0.0),
}
FEDERATED = tuple(name for name in REGIONS if name != HOME)


@dataclass(frozen=True)
class Taught:
    """A network after edge FL: its evaluations in the region and at home, and what the radio carried."""

    region: RoadEvaluation
    home: RoadEvaluation
    wireless_mb: float


@dataclass(frozen=True)
class RegionsResult:
    """The results of the experiment."""

    before: Mapping[str, RoadEvaluation]  # of the packaged network, by region, home included
    after: Mapping[str, tuple[Taught, ...]]  # by region, then by seed
    provenance: Provenance


def recording(region: str, split: str) -> RecipeFields:
    """Return the recipe of a region's recording to train on or to test on."""
    about = REGIONS[region]
    fields: dict[str, Json] = {
        **read_recipe("road"),
        "town": about.town,
        "seed": about.seed + (split == "test"),
        "split": split,
        "scenes": SCENES if split == "train" else TEST_SCENES,
        "cavs": VEHICLES,
        "weather": {"classes": list(about.weather)},
    }
    return fields | ({"worn_paint": about.worn} if about.worn else {})


def test_packaged(work: Work, *, region: str) -> Json:
    """Return the evaluation of the packaged network in a region, as JSON."""
    network = resolve_network(ROAD, None)
    return ROAD.evaluate(network, open_split(work.inputs[_step(region, "test")]), progress=work.report).as_json()


def teach(work: Work, *, region: str, seed: int) -> Json:
    """Federate the vehicles of a region, and return the evaluations of the averaged network, as JSON."""
    network, data = resolve_network(ROAD, None), open_split(work.inputs[_step(region, "train")])
    agents = sorted({key.agent for key in data.keys})
    clients = {
        agent: TaskClient(ROAD, network.config, ROAD.samples(data, network.config, data.select(agents=[agent])))
        for agent in agents
    }
    ledger = Ledger(LinkMegabytes(wireless_mb=BUDGET_MB, wireline_mb=0.0))
    schedule = Schedule(ROUNDS, STEPS, *RATES, seed)
    result = federate(clients, to_arrays(network), schedule, Account(ledger, "edge", ROAD.name, "wireless"))
    from_arrays(network, result.weights)
    tests = {name: open_split(work.inputs[_step(name, "test")]) for name in (region, HOME)}
    found = {name: ROAD.evaluate(network, test, progress=ignore_progress).as_json() for name, test in tests.items()}
    return {"region": found[region], "home": found[HOME], "wireless_mb": ledger.used_mb("wireless")}


def run(out: Path, options: Options) -> Outcome[RegionsResult]:
    """Run or finish the experiment in the folder `out`."""
    seeds = range(1, options.seeds + 1)
    with options.show_steps(options.title) as notify:
        values = run_steps(steps_of(seeds), out, **options.how(notify))
    before = {region: RoadEvaluation.from_json(values[_step(region, "before")], region) for region in REGIONS}
    after = {region: tuple(_taught(values[_step(region, f"seed-{seed}")]) for seed in seeds) for region in FEDERATED}
    results = RegionsResult(before, after, provenance())
    return Outcome(results, {"regions.png": draw(results)}, _findings(results))


def steps_of(seeds: Sequence[int]) -> list[Step]:
    """Return the steps: recordings, the packaged network's tests, and a federation per region and seed."""
    steps = []
    for region in REGIONS:
        splits = ("test",) if region == HOME else ("train", "test")
        steps += [Step(_step(region, s), record_split, {"recipe": recording(region, s)}) for s in splits]
        steps.append(Step(_step(region, "before"), test_packaged, {"region": region}, (_step(region, "test"),)))
    for region in FEDERATED:
        needs = (_step(region, "train"), _step(region, "test"), _step(HOME, "test"))
        steps += [Step(_step(region, f"seed-{n}"), teach, {"region": region, "seed": n}, needs) for n in seeds]
    return steps


def _step(region: str, what: str) -> str:
    return f"{region.replace(', ', '-').replace(' ', '-')}-{what}"


def _taught(value: Mapping[str, Json]) -> Taught:
    region, home = (RoadEvaluation.from_json(value[name], name) for name in ("region", HOME))
    sent = value["wireless_mb"]
    assert isinstance(sent, float)
    return Taught(region, home, sent)


def tables(results: RegionsResult) -> dict[str, str]:
    """Return Markdown by name: findings (a list), regions, sent."""
    rows = []
    for region, taught in results.after.items():
        gained = mean_over_seeds([one.region.score - results.before[region].score for one in taught])
        lost = mean_over_seeds([one.home.score - results.before[HOME].score for one in taught])
        after = mean_over_seeds([one.region.score for one in taught], share=True)
        start, counts = results.before[region], (results.before[region].pictures, results.before[region].wanted)
        cells = (f"{start.score:.3f}", after.describe(), gained.describe(sign=True), lost.describe(sign=True))
        rows.append([region, *counts, *cells, f"{taught[0].wireless_mb:.1f}"])
    heads = ("region", "pictures", "lane lines", "F1 before", "F1 after", "gain", "change at home", "MB of radio")
    classes = [
        [
            row.label.replace("_", " "),
            *(
                f"{_iou(results.before[region], row.label)} → {_iou(taught[0].region, row.label)}"
                for region, taught in results.after.items()
            ),
        ]
        for row in results.before[HOME].classes
    ]
    return {
        "findings": format_bullets(_findings(results)),
        "regions": format_table(heads, rows),
        "classes": format_table(("IoU of a class, before → after, seed 1", *results.after), classes),
    }


def _iou(found: RoadEvaluation, label: str) -> str:
    (iou,) = (row.iou for row in found.classes if row.label == label)
    return "" if iou is None else f"{iou:.3f}"


def _findings(results: RegionsResult) -> list[str]:
    aims = {}
    for region, taught in results.after.items():
        gained = [one.region.score - results.before[region].score for one in taught]
        aims[f"A gain of {GAIN} in lane F1 by edge FL, region {region}"] = Claim(mean_over_seeds(gained), GAIN)
    return [*describe_aims(aims), *describe_limits(aims.values(), EFFECT)]


def draw(results: RegionsResult) -> bytes:
    """Return a PNG with a panel per region: F1 before, after, and at home before and after."""
    panels = {}
    home = results.before[HOME].score
    for region, taught in results.after.items():
        here, there = ([getattr(one, place).score for one in taught] for place in ("region", "home"))
        panels[region] = [
            Bar("before", results.before[region].score, ()),
            Bar("after edge FL", sum(here) / len(here), tuple(here)),
            Bar("home, before", home, ()),
            Bar("home, after", sum(there) / len(there), tuple(there)),
        ]
    return style.png(precisions(panels, label="F1 of lane lines"))


EXPERIMENT = Experiment(
    results=RegionsResult, run=run, tables=tables, seeds=5, takes=("seeds", "jobs", "engine", "stale")
)
