"""Registry of the extras of a run: to take one out, delete its folder in `extras` and its lines below
(what else goes with it: CONTRIBUTING.md; on groups, lifelong learning and partition are built).

An extra adds fields to the recipe and to the results (the bases of the four classes), and functions that a run calls:
`load_all` returns those of a table. They are named as `module:NAME`, since their modules import the stages that call
them; the hash of a step's code follows these names, too.
"""

import functools
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from flcav.config import Config
from flcav.runs.extras.distillation.settings import AVERAGED, ArmDistillation, DistillationFields
from flcav.runs.extras.groups.rows import GroupRow
from flcav.runs.extras.groups.settings import RequestFields
from flcav.runs.extras.lifelong.rows import LifelongRow
from flcav.runs.extras.lifelong.settings import LifelongFields
from flcav.runs.extras.partition.rows import PartitionRow
from flcav.runs.extras.partition.settings import PartitionFields


class LabelFields(
    DistillationFields,
    Config,
):
    """Fields of a run recipe about labels."""


class ArmFields(
    ArmDistillation,
    Config,
):
    """Fields of an arm."""


class RecipeFields(
    LifelongFields,
    Config,
):
    """Fields of a run recipe."""


class FederationFields(
    RequestFields,
    PartitionFields,
    Config,
):
    """Fields of a recipe's `federation`."""


@dataclass(frozen=True)
class StageRows(
    GroupRow,
    PartitionRow,
):
    """Rows of a stage's result."""


@dataclass(frozen=True)
class RunRows(
    LifelongRow,
):
    """Rows of a run's results."""


# called with a recipe: raise ValueError where it is not consistent
RECIPE_CHECKS = (
    "flcav.runs.extras.lifelong.checks:check_lifelong",
    "flcav.runs.extras.distillation.checks:check_arms",
)
# called with recipe, settings of an arm, and strategy of its edge servers: raise `InputError` where they do not go
# together
ARM_CHECKS = (
    "flcav.runs.extras.buffered.driving:check_buffers",
    "flcav.runs.extras.groups.checks:check_groups",
    "flcav.runs.extras.lifelong.checks:check_conditions",
    "flcav.runs.extras.distillation.checks:check_averaged",
    "flcav.runs.extras.partition.samples:check_partition",
)
# called with recipe and `Federation`: return how many vehicles a plan may call, or None
CALLS = ("flcav.runs.extras.groups.checks:count_called",)
# called with recipe and `Arm`: return how labels are averaged
AVERAGES = ("flcav.runs.extras.distillation.checks:resolve_distillation",)
# sources of labels by name: fields of `LabelSource`
SOURCES: Mapping[str, Mapping[str, Any]] = {
    **AVERAGED,
}
# called with a step's work, settings and `Labelling`: return samples that are labelled anew, or None
LABELLERS = ("flcav.runs.extras.distillation.labelling:label_by_average",)
# called in stages II and III with a step's work, settings, `RegionInputs` and labelled samples by vehicle: return these
# as they are dealt to the vehicles, and rows of the stage's result
DEALS = ("flcav.runs.extras.partition.samples:deal_region",)
# called with settings of a federation and `Learning`: return the latter with another loss, or None
LOSSES = ("flcav.runs.extras.distillation.labelling:choose_distillation",)
# called with the drives of regions, `Sensors`, settings of averaging and configuration of the network: return the size
# of a vehicle's messages [MB]
LABEL_SIZES = ("flcav.runs.extras.distillation.sizes:measure_messages",)
# called with an `Outline`: yield further steps
STEPS = ("flcav.runs.extras.lifelong.steps:list_lifelong_steps",)
# called in stage II with its step's work, settings, `LabelledSamples`, ledger, plan and deployed vehicles: return a
# `Conduct`, or None
CONDUCTS = ("flcav.runs.extras.groups.forming:call_group",)
# called with strategy, planned rounds, `RegionStart` by region and whether the cloud takes part: return both counted
COUNTS = ("flcav.runs.extras.buffered.driving:count_buffers",)
# called with a step's work, settings, `StageFederation` and ways by wireline [s]: return a `DrivenStage`, or None
DRIVES = ("flcav.runs.extras.buffered.driving:drive_stage",)
# called with `Graph` and folder of the steps: return fields of `Run`
RESULTS = ("flcav.runs.extras.lifelong.results:collect_lifelong",)
# called with `Graph`, task, rounds of stage II and times of a step and of a tested frame [s]: return further seconds
FORECASTS = ("flcav.runs.extras.lifelong.steps:forecast_lifelong_s",)
# called with a `Run`: return a `PageSection` of its page, or None
SECTIONS = (
    "flcav.runs.extras.partition.section:describe_partitions",
    "flcav.runs.extras.lifelong.results:describe_lifelong",
)


@dataclass(frozen=True)
class PageSection:
    """A section of a run's page; its fields are the values of its template, as `section`."""

    template: ClassVar[str]  # below `extras`
    chart: ClassVar[str]  # function that draws its pictures, by name, of a `Run`, as `module:NAME`


@functools.cache
def load_all(places: Sequence[str]) -> tuple[Any, ...]:
    """Import and return the functions of a table, in its order."""
    named = [place.partition(":") for place in places]
    return tuple(getattr(importlib.import_module(module), name) for module, _, name in named)
