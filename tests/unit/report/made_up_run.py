"""Made-up inputs with the shape of a real run's."""

import numpy as np

from flcav.geometry import Boxes
from flcav.report.pictures.changes import ErrorChanges
from flcav.report.pictures.clouds import ComparedSweep, MatchedDetections
from flcav.report.pictures.maps import DENSEST, ErrorMap, poles_of
from flcav.runs.provenance import Provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.plans import Placed, Plan, Pole, TaskPlan
from flcav.runs.results.run import ArmResult, LinkUse, Run, Spent
from flcav.runs.results.table import Row, tabulate
from flcav.runs.results.tests import Difference, RunFinding, Test, Tested
from flcav.runs.results.training import Pretrained, Validated
from flcav.statistics.estimates import Estimate, Spread
from flcav.storage.records import select
from flcav.world.line_of_sight import Viewshed
from flcav.world.map.town import load_town

MEANS = {"grid": (0.412, 0.503, 0.511), "ring": (0.381, 0.447, 0.468)}
BUDGETS = {"wireless": 230.0, "wireline": 135.0}
SENT = (
    ("pretrain", "wireless", 118.4),
    ("pretrain", "wireline", 118.4),
    ("edge", "wireless", 64.2),
    ("edge", "wireline", 0.0),
    ("cloud", "wireless", 32.1),
    ("cloud", "wireline", 9.2),
)


def run() -> Run:
    """Return an invented run."""
    covered = (12, 19, 9, 7, 15, 11, 4, 6, 3)
    actors = (5.1, 6.2, 4.4, 3.8, 7.0, 5.5, 6.1, 12.4, 2.2)
    poles = tuple(Pole(*row) for row in zip(range(1, 10), covered, actors, strict=True))
    verdicts = (("edge", "held"), ("cloud", "undecided"), ("pole", "did not hold"))
    own = TaskPlan(320, 6, 3, 216.0, 128.1, 0.37, 1.35, {"pretrain": 0.41, "edge": 0.5, "cloud": 0.53})
    return Run(
        recipe=RunRecipe.model_validate(
            {
                "seed": 7,
                "tasks": {"objects": {"history": "objects"}},
                "regions": {
                    "suburb": {"role": "pretrain"},
                    "grid": {"role": "federate"},
                    "ring": {"role": "federate"},
                },
                "budgets_mb": BUDGETS,
            }
        ),
        arms={
            MAIN: ArmResult(
                plan=Plan("joint", {"objects": own}),
                placed=(Placed("grid", "vrcsp", (2,), 61, 19, 40.0, poles),),
                stages=(),
                links={"wireless": LinkUse(230.0, 216.0, 214.7), "wireline": LinkUse(135.0, 128.1, 127.6)},
                spent=tuple(Spent(stage, "objects", link, mb) for stage, link, mb in SENT),
            )
        },
        pretrained=(Pretrained("objects", "tiny", {"suburb": (0,)}, (Validated(100, 2.0, 0.4),), 100, 0.5),),
        watched=(),
        tested=tuple(
            Test(MAIN, stage, town, "objects", "test", result_of(town, mean), result_of(town, mean).estimate, None)
            for town, means in MEANS.items()
            for stage, mean in zip((PRETRAIN, EDGE, CLOUD), means, strict=True)
        ),
        differences=(
            Difference(
                "grid, objects: edge FL - pretrained", MAIN, EDGE, MAIN, PRETRAIN, "grid", "objects",
                Estimate(0.091, 0.041, 0.141), Estimate(0.091, 0.055, 0.127), Spread(0.015, 9),
            ),
        ),
        findings=tuple(
            RunFinding("grid, objects", f"Does {name} help?", said, f"What {name} did.") for name, said in verdicts
        ),
        gap_closed={},
        caveats=("ideal road detector, upper bound",),
        provenance=Provenance("0123456789abcdef", False, {"flcav": "0.1.0", "torch": "2.9.0"}, "x86-64", 1, 7),
        elapsed_s=538.2,
    )  # fmt: skip


def result_of(town: str, mean: float) -> Tested:
    estimate = Estimate(mean, mean - 0.041, mean + 0.038)
    return Tested(town, "objects", "AP50", estimate, {"AP70": mean - 0.19, "right headings": 0.96}, 96, 8)


def chart_rows() -> list[Row]:
    """Return the tested rows of a chart."""
    return select(tabulate(run()), quantity="tested.estimate")


def sent() -> list[Row]:
    return select(tabulate(run()), quantity=["arms.spent.wireless.mb", "arms.spent.wireline.mb"])


def rounds() -> list[Row]:
    rng = np.random.default_rng(3)
    rows = [_score(PRETRAIN, n, "suburb", 0.62 * (1 - np.exp(-n / 3))) for n in range(1, 9)]
    for town, start, middle, end in (("grid", 0.41, 0.50, 0.51), ("ring", 0.38, 0.45, 0.47)):
        rows.append(_score(PRETRAIN, 0, town, start))
        for n in range(1, 7):
            score = middle - (middle - start) * np.exp(-n / 2) + rng.normal(0, 0.006)
            rows.append(_score(EDGE, n, town, score))
        for n in range(1, 4):
            score = end - (end - middle) * np.exp(-n) + rng.normal(0, 0.004)
            rows.append(_score(CLOUD, n, town, score))
    return rows


def _score(stage: str, number: int, town: str, score: float) -> Row:
    return Row(stage=stage, round=number, region=town, quantity="watched.rounds.score", value=float(score))


def error_map(town: str = "grid", errors: int = 61) -> ErrorMap:
    place = load_town(town)
    rng = np.random.default_rng(1)
    road = np.concatenate(place.roads)
    xy = road[rng.integers(len(road), size=errors)] + rng.normal(0, 4, (errors, 2))
    kind = np.where(rng.random(errors) < 0.7, "miss", "false_positive")
    xyz = np.c_[xy, np.full(errors, 0.8)]
    return ErrorMap(place, xyz, kind, poles_of(place), chosen={"2": 40.0}, conventional={DENSEST: ("8",)})


def changes() -> ErrorChanges:
    """Return errors of which every third remains, with two new ones, and one pole's view of the west."""
    scene = error_map()
    axis = np.linspace(-40, 40, 41)
    site = scene.poles["2"]
    west = Viewshed(site[0] + axis, site[1] + axis, np.broadcast_to(axis < 0, (41, 41)))
    return ErrorChanges(
        town=scene.town,
        errors=scene.errors,
        kind=scene.kind,
        remains=np.arange(len(scene.errors)) % 3 == 0,
        seen=np.zeros(len(scene.errors), np.bool_),
        new=scene.errors[:2] + 3.0,
        new_kind=np.array(["miss", "false_positive"]),
        poles=dict(scene.poles),
        viewsheds={"2": west},
    )


def sweep() -> ComparedSweep:
    rng = np.random.default_rng(2)
    rows = [[12, 3, -1, 4.5, 1.8, 1.5, 0.0], [24, -3, -1, 4.5, 1.8, 1.5, 3.1], [33, 4, -1, 5.4, 2, 2.3, 0.1],
            [40, -12, -1, 4.2, 1.8, 1.5, 1.5], [19, 12, -1, 4.6, 1.8, 1.5, 1.6]]  # fmt: skip
    targets = Boxes.from_array(rows, "Car")
    false = np.array([[28.0, -16.0, -1, 4.4, 1.8, 1.5, 0.4]])
    near = targets.array() + rng.normal(0, 0.15, (5, 7))
    angle = rng.uniform(-np.pi / 2, np.pi / 2, 9000)
    reach = np.repeat(np.geomspace(5, 45, 18), 500) * (1 + 0.01 * rng.normal(size=9000))
    ground = np.c_[reach * np.cos(angle), reach * np.sin(angle), np.full(9000, -1.7), np.zeros(9000)]
    on_boxes = [
        np.c_[row[0] + rng.uniform(-2, 0, 80), row[1] + rng.uniform(-0.9, 0.9, 80), np.zeros((80, 2))] for row in rows
    ]
    before = Boxes.from_array(np.r_[near[:2], false], "Car", [0.9, 0.8, 0.4])
    after = Boxes.from_array(near[[0, 1, 2, 4]], "Car", [0.9, 0.9, 0.6, 0.5])
    return ComparedSweep(
        points=np.concatenate((ground, *on_boxes)).astype(np.float32),
        ground_m=-1.7,
        targets=targets,
        before=MatchedDetections(
            "Pretrained", before, np.array([True, True, False]), np.array([1, 1, 0, 0, 0], dtype=bool)
        ),
        after=MatchedDetections(
            "Edge + cloud FL", after, np.ones(4, dtype=bool), np.array([1, 1, 1, 0, 1], dtype=bool)
        ),
    )
