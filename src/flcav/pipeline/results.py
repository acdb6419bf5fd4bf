"""What the steps of a run result in: frozen records, each saved to and loaded from its folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from flcav.config import read_json
from flcav.files import write_json
from flcav.intervals import Estimate
from flcav.pipeline.provenance import Provenance
from flcav.pipeline.recipe import RunRecipe
from flcav.records import Record

RESULT = "result.json"
WEIGHTS, LEDGER, ERRORS, OUTCOMES = "weights.safetensors", "ledger.parquet", "errors.parquet", "outcomes.npz"


class Saved(Record):
    """A record that is kept as JSON in a folder."""

    def save(self, folder: Path, name: str = RESULT) -> None:
        """Write the record to `folder`, atomically; tasks and regions stay in their order."""
        write_json(folder / name, self.as_json(), sort=False)

    @classmethod
    def load(cls, folder: Path, name: str = RESULT) -> Self:
        """Return what `save` wrote; raises `InputError` where it is not there, or of another version."""
        return cls.of_json(read_json(folder / name), str(folder / name))


@dataclass(frozen=True)
class Recorded(Saved):
    """The frames of one split: a dataset's folder and which of its frames."""

    folder: str  # relative to the step's own, or absolute
    vehicles: tuple[int, ...]  # numbers of the vehicles' frames
    poles: Mapping[int, tuple[int, ...]]  # numbers of each roadside sensor's frames, by pole
    scenes: int


@dataclass(frozen=True)
class TaskPlan:
    """How much of each stage one task takes."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    wireless_mb: float
    wireline_mb: float
    sample_mb: float
    model_mb: float
    predicted: Mapping[str, float] | None  # accuracy after each stage by the learning curve; None for a fixed plan


@dataclass(frozen=True)
class Plan(Saved):
    """The allocation of both budgets to tasks and stages."""

    rule: str
    tasks: Mapping[str, TaskPlan]


@dataclass(frozen=True)
class Block:
    """One block of pretraining."""

    rate: float  # share of the learning rate
    loss: float
    score: float  # on validation frames


@dataclass(frozen=True)
class Pretrained(Saved):
    """Stage I of a task; weights and ledger are beside."""

    task: str
    network: str  # name of the configuration
    uploaded: Mapping[str, tuple[int, ...]]  # frames by region
    blocks: tuple[Block, ...]
    steps: int
    threshold: float | None  # from which score on its detections serve as labels; None where labels come otherwise


@dataclass(frozen=True)
class ErrorRegistry(Saved):
    """The errors of a pretrained network in a region, each once; the table is beside."""

    region: str
    task: str
    counts: Mapping[str, int]  # by kind
    dropped: int  # false positives that point at no place of the town


@dataclass(frozen=True)
class Pole:
    """A candidate site."""

    pole: int
    covered: int  # errors within range
    actors: float  # road users within range on average


@dataclass(frozen=True)
class Placed(Saved):
    """Where a region's roadside sensors stand."""

    region: str
    rule: str
    chosen: tuple[int, ...]
    errors: int
    covered: int
    range_m: float
    poles: tuple[Pole, ...]

    @property
    def densest(self) -> int:
        """Return the site with most road users around."""
        return max(self.poles, key=lambda site: site.actors).pole


@dataclass(frozen=True)
class Round:
    """A round of a federation, measured on validation frames."""

    round: int
    score: float


@dataclass(frozen=True)
class StageResult(Saved):
    """A federated stage of a task, or a central arm's training; weights and ledger are beside."""

    stage: str
    task: str
    region: str | None  # None: all that federate
    rounds: int
    samples: int  # that the clients hold together
    clients: int
    poles: tuple[int, ...]  # whose sensors helped to label
    losses: tuple[float, ...] = ()  # mean training loss of each round


@dataclass(frozen=True)
class Watched(Saved):
    """A federation measured after each of its rounds; stage II also before them, as round 0."""

    stage: str
    task: str
    region: str
    frames: int
    rounds: tuple[Round, ...]


@dataclass(frozen=True)
class Tested(Saved):
    """A network measured on a region's test frames; what it did in each is beside."""

    region: str
    task: str
    measure: str  # what the estimate is of
    estimate: Estimate
    numbers: Mapping[str, float | None]  # more of the task's
    frames: int
    scenes: int


@dataclass(frozen=True)
class Test:
    """A test as part of a run."""

    arm: str
    stage: str
    region: str
    task: str
    step: str  # whose folder holds the outcomes
    result: Tested


@dataclass(frozen=True)
class Difference:
    """A measure after something minus before it, on the same test frames."""

    name: str
    arm: str
    stage: str
    before_arm: str
    before_stage: str
    region: str
    task: str
    estimate: Estimate


@dataclass(frozen=True)
class Finding:
    """What a run says of a claim."""

    place: str  # region and task
    question: str
    verdict: str  # held | did not hold | undecided
    sentence: str  # with the numbers behind it


@dataclass(frozen=True)
class Seen:
    """What one network found in a sweep, LiDAR frame."""

    boxes: tuple[tuple[float, ...], ...]  # x y z length width height yaw; without those of neutral objects
    hit: tuple[bool, ...]  # of each box
    found: tuple[bool, ...]  # of each target


@dataclass(frozen=True)
class Looked(Saved):
    """One test sweep seen by two networks."""

    frame: int  # number in its dataset
    targets: tuple[tuple[float, ...], ...]
    before: Seen
    after: Seen


@dataclass(frozen=True)
class Spent:
    """What one stage of a task sent up over a link [MB]."""

    stage: str
    task: str
    link: str
    mb: float


@dataclass(frozen=True)
class LinkUse:
    """One uplink: what it may carry, was planned to, and did [MB]."""

    budget_mb: float
    planned_mb: float
    used_mb: float


@dataclass(frozen=True)
class ArmResult:
    """What belongs to one arm."""

    plan: Plan
    placed: tuple[Placed, ...]
    stages: tuple[StageResult, ...]
    links: Mapping[str, LinkUse]
    spent: tuple[Spent, ...]

    def sent_mb(self, task: str, link: str) -> float:
        """Return what went up for a task over a link in all stages [MB]."""
        return sum(row.mb for row in self.spent if (row.task, row.link) == (task, link))


@dataclass(frozen=True)
class Run(Saved):
    """A finished run."""

    recipe: RunRecipe
    arms: Mapping[str, ArmResult]
    pretrained: tuple[Pretrained, ...]  # of the run itself
    watched: tuple[Watched, ...]  # of the run itself
    tested: tuple[Test, ...]
    differences: tuple[Difference, ...]
    findings: tuple[Finding, ...]
    gap_closed: Mapping[str, float]  # to central training on ground truth; where an arm does that
    caveats: tuple[str, ...]
    provenance: Provenance
    elapsed_s: float = 0.0  # over all starts

    def test(self, *, stage: str, region: str, task: str, arm: str = "main") -> Tested:
        """Return a test; raises `KeyError` for one that was not made."""
        for each in self.tested:
            if (each.arm, each.stage, each.region, each.task) == (arm, stage, region, task):
                return each.result
        raise KeyError((arm, stage, region, task))


@dataclass(frozen=True)
class Mean:
    """A number over seeds: Student's 95 % interval."""

    name: str
    estimate: Estimate


@dataclass(frozen=True)
class Summary(Saved):
    """What several seeds of a recipe say together."""

    seeds: tuple[int, ...]
    measures: tuple[Mean, ...]
    differences: tuple[Mean, ...]
    gap_closed: tuple[Mean, ...]
