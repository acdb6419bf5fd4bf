"""Settings common to several kinds of steps, and the shares of tasks and regions in the budgets."""

from collections.abc import Callable, Mapping

import numpy as np

from flcav.config import Config
from flcav.fusion.average import NavigationErrors, PoseSource
from flcav.fusion.distillation import Distillation
from flcav.network.awareness import MessageSettings
from flcav.network.ledger import Ledger, LedgerEntry, LinkMegabytes
from flcav.perception.tasks import task_named
from flcav.runs.engine import Step, Work
from flcav.runs.recipe import Budgets, Fault, Federation, Training
from flcav.runs.results.plans import Plan
from flcav.runs.results.saved import LEDGER
from flcav.runs.training.learning import Learning


class StepSettings(Config):
    """Settings of a step: all that its result depends on, besides code and the results of the steps it needs."""

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes, some more than once."""
        return ()


class LearningSettings(Config):
    """Settings of a task's training, as JSON values: see `flcav.runs.training.learning.Learning`."""

    task: str
    network: str | None  # name of the configuration; None: the task's first
    training: Training
    seed: int  # another one in a retraining

    def resolve(self) -> Learning:
        """Return the settings with the task object in place of its name."""
        return Learning(task_named(self.task), self.network, self.training, self.seed)


class RegionInputs(StepSettings):
    """The steps that a stage of a task in a region depends on, and how its vehicles' frames are chosen."""

    region: str
    plan: str  # by which the stage is carried out
    pretrain: str
    frames: str  # recording of the vehicles' training data
    place: str  # placement of the arm's sensors
    errors: str | None = None  # registration of the task's errors, whose messages precede the rounds
    edge: str | None = None  # stage II that is continued
    tracks: str | None = None  # tracks of the vehicles' frames, where labels come from them
    sites: tuple[str, ...] = ()  # placements of all arms: vehicles train on frames near one of their sensors
    group_range_m: float  # largest distance of such a frame from a sensor [m]
    recorded: bool  # whether the region is a recorded dataset, whose poles are those that it was recorded from
    pools: Mapping[str, str] = {}  # recordings of the candidates for upload, by region, where vehicles share frames

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of all these steps."""
        named = (self.plan, self.pretrain, self.errors, self.frames, self.place, self.edge, self.tracks)
        return (*(name for name in named if name is not None), *self.sites, *self.pools.values())


class FederationSettings(StepSettings):
    """Settings common to the federations of stages II and III."""

    learning: LearningSettings
    federation: Federation
    budgets_mb: Budgets  # of the run
    vehicles: Mapping[str, int]  # number by federating region
    labels: str  # kind of labels, see `LABEL_SOURCES`
    fault: Fault | None = None  # of the labels, the rest of which are ground truth
    distillation: Distillation | None = None  # of the labels "road-average"
    messages: MessageSettings | None = None  # of the labels that vehicles hear
    navigation: PoseSource = NavigationErrors()  # of the vehicles
    train_s: float = 0.0  # time that a vehicle of speed 1 trains in a round [s]; 0 without a radio network
    speeds: Mapping[str, float] = {}  # relative computing speeds by "region/vehicle"; others have 1


def make_step(name: str, run: Callable[..., None], settings: StepSettings, workers: int = 1) -> Step:
    """Return the step that calls `run` with `settings`, after the steps that they need, on so many workers at most."""
    return Step(name, run, {"settings": settings}, tuple(dict.fromkeys(settings.needs)), workers=workers)


def share_budget(budget: LinkMegabytes, planned: Mapping[str, tuple[float, float]], task: str) -> LinkMegabytes:
    """Return a task's share of both budgets, in proportion to its planned traffic [MB wireless, wireline].

    Shares are rounded down to bytes, so that their sum never exceeds the budget.
    """
    parts = []
    for link, whole_mb in enumerate((budget.wireless_mb, budget.wireline_mb)):
        total = sum(traffic[link] for traffic in planned.values())
        share = planned[task][link] / total if total else 1 / len(planned)
        parts.append(whole_mb if len(planned) == 1 else np.floor(share * whole_mb * 1e6) / 1e6)
    return LinkMegabytes(*map(float, parts))


def share_plan_budget(plan: Plan, budgets_mb: Budgets, task: str) -> LinkMegabytes:
    """Return the share of both budgets that a plan gives to a task [MB]."""
    planned = {name: (entry.wireless_mb, entry.wireline_mb) for name, entry in plan.tasks.items()}
    return share_budget(LinkMegabytes(budgets_mb.wireless, budgets_mb.wireline), planned, task)


def region_budget(stage_one: Ledger, vehicles: Mapping[str, int], region: str) -> LinkMegabytes:
    """Return the budget of a region's stage II [MB]: its share, by vehicles, of the wireless budget left by stage I."""
    share = vehicles[region] / sum(vehicles.values())
    return LinkMegabytes(share * stage_one.left_mb("wireless"), 0.0)


def read_entries(work: Work, *steps: str) -> list[LedgerEntry]:
    """Read the ledger entries of several steps, concatenated."""
    return [entry for step in steps for entry in Ledger.load(work.inputs[step] / LEDGER).entries]


def open_region_book(
    work: Work, share: LinkMegabytes, pretrained: str, vehicles: Mapping[str, int], region: str
) -> Ledger:
    """Return an empty ledger for a region's stage II; `share`: that of the task in both budgets, before stage I.

    `pretrained`: the step of stage I; `vehicles`: numbers of vehicles by federating region.
    """
    return Ledger(region_budget(Ledger(share, read_entries(work, pretrained)), vehicles, region))
