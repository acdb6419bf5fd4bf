"""The configuration of an allocation problem: budgets, and per task message sizes, limits and learning curves."""

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from flcav.config import Config
from flcav.interface.notebook import Displayed
from flcav.network.plan import FORM_BITS, STORED_BITS, FormName, MessageSizes
from flcav.optimization.curves.curves import (
    STAGES,
    Additive,
    Curve,
    Effective,
    Federated,
    NonNegative,
    OwnCurve,
    Positive,
    SharedCurve,
)
from flcav.storage.records import LEFT_OUT, WHERE_TRUE

MOST = 10**9  # largest count
WORST = 1e6  # largest error that a curve may predict within the limits; that of a fitted curve is about 1
BITS_PER_BYTE = 8
Count = Annotated[int, Field(ge=0, le=MOST)]
Vehicles = Annotated[int, Field(ge=1, le=MOST)]
Range = tuple[Count, Count]  # least and most, both allowed
Called = tuple[Vehicles, Vehicles]  # least and most, both allowed
Fraction = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(min_length=1)]
Objective = Literal["weighted", "max-min", "area"]


class Quantities(Config):
    """Base of the parts of an allocation problem: numbers are 0, or from 1e-9 to 1e9 in size."""

    magnitudes: ClassVar[tuple[float, float]] = (1e-9, 1e9)


class Limits(Config):
    """Least and most of each quantity of a task, both allowed."""

    samples: Range  # (least, most) samples
    edge_rounds: Range  # (least, most) edge rounds
    cloud_rounds: Range  # (least, most) cloud rounds

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in Limits.model_fields:
            least, most = getattr(self, name)
            if least > most:
                raise ValueError(f"{name} from {least} to {most} is empty")
        return self


class Uplink(Quantities):
    """Uplink rates of one vehicle [Mbit/s]."""

    wireless: Positive
    wireline: Positive | None = None  # of its edge server, on the vehicle's behalf; None: not limited


class Learner(NamedTuple):
    """A learning curve with its weight: of the task itself, or of a member of its cluster."""

    name: str
    weight: float
    curve: OwnCurve


class Measured(Config):
    """The largest value of each quantity in the history that a curve was fitted to; plans beyond it extrapolate."""

    samples: NonNegative | None = None  # most samples in the history
    edge_rounds: NonNegative | None = None  # most edge rounds in the history
    cloud_rounds: NonNegative | None = None  # most cloud rounds in the history


class LocalSteps(Quantities):
    """A number of local steps that a plan may choose, relative to the history of the learning curve."""

    factor: Positive  # times the steps, and so the training time, of a round of the history
    worth: Positive = 1.0  # rounds of the history that a round of so many steps is worth, as measured


class UpdateForm(Quantities):
    """A form of updates that a plan may choose: what it takes, and what it costs in accuracy."""

    bits: Positive | None = None  # of an update, per parameter, as measured; None: those of the form, without headers
    fraction: Annotated[float, Field(gt=0, le=1)] | None = None  # of the parameters that top-k sends
    loss: Fraction = 0.0  # added to the error of a plan with this form, as measured


class Annotation(Quantities):
    """A way of annotating the samples of stage I: what it takes, and what its noise costs in accuracy."""

    box_s: NonNegative  # time of an annotator for a box [s]
    worth: Positive = 1.0  # samples of the history that a sample annotated in this way is worth, as measured
    loss: Fraction = 0.0  # added to the error of a plan with it, as measured


Form = Annotated[UpdateForm, BeforeValidator(lambda value: {} if value is None else value)]  # `int8:` has all defaults


class AllocationTask(Quantities):
    """A unit of allocation: one perception task or a cluster, with its message sizes, vehicles and learning curve.

    Tasks that share a network and its data are a cluster, with a `shared` curve: their weighted mean error.
    Construction raises pydantic's ValidationError where vehicles, limits and curves do not match.
    """

    name: Name
    weight: Positive = 1.0
    sample_mb: Positive  # one labelled sample
    model_mb: Positive  # one model update
    exchange_mb: Annotated[Positive | None, LEFT_OUT] = None  # what a vehicle sends in an edge round; None: the model
    labels_mb: Annotated[NonNegative | None, LEFT_OUT] = (
        None  # what it sends to have its samples labelled: before each edge round of stage II, once before stage III
    )
    edge_groups: Annotated[tuple[Vehicles, ...], Field(min_length=1)]  # vehicles per edge server
    called: Annotated[Called | None, LEFT_OUT] = (
        None  # vehicles of each edge server that a plan may call to a round of stage II; curves are of the most of them
    )
    worth: Annotated[tuple[Positive, ...] | None, LEFT_OUT] = (
        None  # of the data of an edge server's vehicles, in the order in which they are called; None: equal
    )
    uplink_mbps: Mapping[str, Uplink] | None = None  # by vehicle, in the order of the edge groups
    samples_held: Mapping[str, Count] = {}  # by vehicle; not limited for one that is not named
    data_quality: Mapping[str, Positive] = {}  # by vehicle: worth of one of its samples; 1 if not named
    train_s: NonNegative = 0.0  # time that a vehicle trains in one round [s]
    vehicle_train_s: Mapping[str, NonNegative] = {}  # by vehicle, where it is another; names them all if uplinks do not
    local_steps: Annotated[tuple[LocalSteps, ...], WHERE_TRUE] = ()  # those to choose from; none: those of the history
    forms: Annotated[Mapping[FormName, Form], WHERE_TRUE] = {}  # of updates, to choose from; none: `model_mb` is sent
    boxes: NonNegative = 1.0  # to be annotated in a sample, mean
    annotations: Annotated[Mapping[Name, Annotation], WHERE_TRUE] = {}  # to choose from; none: they take no time
    network: Annotated[Name | None, LEFT_OUT] = None  # name of its network, where a plan chooses between several
    alternatives: Annotated[tuple["AllocationTask", ...], WHERE_TRUE] = ()
    # the task with other networks and modalities, of which a plan takes one instead; name and weight are the task's
    limits: Limits
    curve: Curve
    upper: Curve | None = None  # the upper band of `curve`, for robust plans
    lower: Annotated[Curve | None, LEFT_OUT] = None  # its lower band: with the upper, that of the predicted accuracy
    measured: Measured = Measured()
    performance_without: Fraction | None = None  # of the whole system when this task is left out

    @property
    def variants(self) -> tuple["AllocationTask", ...]:
        """The task by every network that a plan may choose, its own first."""
        return (self, *self.alternatives)

    @property
    def annotate_s(self) -> float:
        """Time to annotate one sample [s], where there is no choice of the way."""
        return self.boxes * sum(each.box_s for each in self.annotations.values()) if len(self.annotations) == 1 else 0.0

    @property
    def learners(self) -> tuple[Learner, ...]:
        """The learning curves of the task or of its cluster's members; their weights sum to the task's weight."""
        if not isinstance(self.curve, SharedCurve):
            return (Learner(self.name, self.weight, self.curve),)
        total = sum(member.weight for member in self.curve.members)
        return tuple(
            Learner(member.name, self.weight * member.weight / total, member.curve) for member in self.curve.members
        )

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Names of the vehicles, in the order of the edge groups; empty where the vehicles are not named."""
        return tuple(self.vehicle_train_s if self.uplink_mbps is None else self.uplink_mbps)

    @property
    def sizes(self) -> MessageSizes:
        """Sizes of the task's messages [MB]."""
        return MessageSizes(self.sample_mb, self.model_mb, self.exchange_mb, self.labels_mb)

    def form_bits(self, form: FormName) -> float:
        """Return what an update of one of the task's forms takes per parameter [bits]."""
        own = self.forms[form]
        return FORM_BITS[form] * (own.fraction or 1.0) if own.bits is None else own.bits

    def weigh_groups(self, called: int) -> tuple[float, ...]:
        """Return the worth of the data at each edge server where at most `called` of its vehicles are called."""
        worth = self.worth or (1.0,) * max(self.edge_groups)
        return tuple(sum(worth[: min(called, size)]) for size in self.edge_groups)

    def sample_s(self, vehicle: str) -> float:
        """Return the time that a vehicle takes to send one sample [s]; 0 where its link is not known."""
        return self._sending_s(vehicle, self.sample_mb)

    def round_s(self, vehicle: str) -> float:
        """Return the time that a vehicle needs for one round [s]: to train, and to send its update and any labels."""
        sent_mb = (self.exchange_mb or self.model_mb) + (self.labels_mb or 0.0)
        return self.vehicle_train_s.get(vehicle, self.train_s) + self._sending_s(vehicle, sent_mb)

    def _sending_s(self, vehicle: str, mb: float) -> float:
        return 0.0 if self.uplink_mbps is None else BITS_PER_BYTE * mb / self.uplink_mbps[vehicle].wireless

    @model_validator(mode="before")
    @classmethod
    def _name_alternatives(cls, values: Any) -> Any:
        if not (isinstance(values, dict) and isinstance(values.get("alternatives"), list | tuple)):
            return values
        shared = {name: values[name] for name in ("name", "weight") if name in values}
        named = [shared | each if isinstance(each, dict) else each for each in values["alternatives"]]
        return values | {"alternatives": named}

    @model_validator(mode="after")
    def _alternative(self) -> Self:
        for each in self.alternatives:
            if each.alternatives or (each.name, each.weight) != (self.name, self.weight):
                raise ValueError(f"alternatives of task {self.name!r} have its name and weight, and none of their own")
            if bool(each.vehicles) != bool(self.vehicles) or (each.train_s > 0) != (self.train_s > 0):
                raise ValueError(
                    f"alternatives of task {self.name!r}: all of them name their vehicles and take train_s, or none"
                )
            if (each.called is None) != (self.called is None) or (each.upper is None) != (self.upper is None):
                raise ValueError(f"alternatives of task {self.name!r}: all of them have 'called', and 'upper', or none")
            if [member[0] for member in _members(each.curve)] != [member[0] for member in _members(self.curve)]:
                raise ValueError(f"alternatives of task {self.name!r} must have curves of the same members")
        names = [each.network for each in self.variants]
        if self.alternatives and (None in names or len(set(names)) < len(names)):
            raise ValueError(f"alternatives of task {self.name!r}: it and they need a 'network' each, all different")
        return self

    @model_validator(mode="after")
    def _vehicles(self) -> Self:
        naming = "vehicle_train_s" if self.uplink_mbps is None else "uplink_mbps"
        known = self.vehicles
        if (known or self.uplink_mbps is not None) and len(known) != sum(self.edge_groups):
            raise ValueError(
                f"{naming} of task {self.name!r} names {len(known)} vehicles, edge_groups have {sum(self.edge_groups)}"
            )
        for field in ("samples_held", "data_quality", "vehicle_train_s"):
            for vehicle in getattr(self, field):
                if vehicle not in known:
                    raise ValueError(f"{field} of task {self.name!r} names {vehicle!r}, which {naming} does not")
        return self

    @model_validator(mode="after")
    def _callable(self) -> Self:
        if self.called is None:
            if self.worth is not None:
                raise ValueError(f"worth of task {self.name!r} is of vehicles that are called: 'called' is missing")
            return self
        if self.worth is not None and len(self.worth) < max(self.edge_groups):
            raise ValueError(
                f"worth of task {self.name!r} is of {len(self.worth)} vehicles, and an edge server has "
                f"{max(self.edge_groups)}"
            )
        if self.called[0] > self.called[1] or self.called[1] > max(self.edge_groups):
            raise ValueError(
                f"called of task {self.name!r} is from {self.called[0]} to {self.called[1]}: least and most vehicles, "
                f"of {max(self.edge_groups)} at an edge server"
            )
        if self.vehicles:
            raise ValueError(f"called of task {self.name!r}: vehicles with names join rounds by a plan of their own")
        if any(not isinstance(each, Effective | Federated) for each in (self.curve, self.upper or self.curve)):
            raise ValueError(f"called of task {self.name!r}: its curve does not know what data vehicles bring")
        return self

    @model_validator(mode="after")
    def _choosable(self) -> Self:
        factor, times = (
            Counter(each.factor for each in self.local_steps).most_common(1)[0] if self.local_steps else (1, 1)
        )
        if times > 1:
            raise ValueError(f"local_steps of task {self.name!r}: {times} of them have the factor {factor:g}")
        for form, own in self.forms.items():
            if (own.fraction is not None) != (form == "top-k" and own.bits is None):
                wanted = "'fraction' or 'bits'" if form == "top-k" else "no 'fraction', which is of top-k"
                raise ValueError(f"forms.{form} of task {self.name!r}: it takes {wanted}")
            if (bits := self.form_bits(form)) > STORED_BITS:
                raise ValueError(
                    f"forms.{form} of task {self.name!r}: {bits:g} bits per parameter are more than the "
                    f"{STORED_BITS:g} that are stored"
                )
        if self.forms and self.exchange_mb is not None:
            raise ValueError(f"forms of task {self.name!r} are of the network, and vehicles send 'exchange_mb' instead")
        return self

    @model_validator(mode="after")
    def _finite(self) -> Self:
        limits = self.limits
        ranges = (limits.samples, limits.edge_rounds, limits.cloud_rounds)
        for field, curve in (("curve", self.curve), ("upper", self.upper or self.curve)):
            for each in (member.curve for member in curve.members) if isinstance(curve, SharedCurve) else (curve,):
                if not isinstance(each, Additive) and limits.samples[0] == 0:
                    raise ValueError(
                        f"limits.samples of task {self.name!r} must start at 1 or more: its error at 0 is infinite"
                    )
                decays = each.decays() if isinstance(each, Additive) else ()
                for stage, decay, (_, most) in zip(STAGES, decays, ranges):
                    if most == 0 and decay.infinite_at_0:
                        raise ValueError(f"{field}.{stage}.x0 of task {self.name!r} is 0: its error at 0 is infinite")
                least = [float(low) for low, _ in ranges]
                # A power law without an offset is infinite at 0 rounds: one round is its least finite case.
                for stage, decay in enumerate(decays):
                    least[stage] = max(least[stage], decay.infinite_at_0)
                with np.errstate(over="ignore"):
                    error = float(each.error(*least, k=0))
                if not error <= WORST:
                    raise ValueError(
                        f"{field} of task {self.name!r} predicts an error of {error:g} at its least limits: at most "
                        f"{WORST:g} is taken for one"
                    )
        return self

    @model_validator(mode="after")
    def _same_members(self) -> Self:
        if self.upper is not None and _members(self.curve) != _members(self.upper):
            raise ValueError(f"upper of task {self.name!r} must have the members of its curve, with the same weights")
        return self


def _members(curve: Curve) -> list[tuple[str, float]]:
    return [(member.name, member.weight) for member in curve.members] if isinstance(curve, SharedCurve) else []


class Budgets(Quantities):
    """Uplink budgets [MB; 1 MB = 10^6 bytes]."""

    wireless: Positive  # from vehicles to edge servers
    wireline: Positive  # from edge servers to the cloud


class Problem(Displayed, Quantities):
    """An allocation problem: how to split the budgets of both links over tasks and stages.

    Construction checks the fields and raises pydantic's ValidationError, which names the field.

    >>> from flcav import Problem
    >>> curve = {"model": "additive", "floor": 0.05, "pretrain": {"a": 0.51, "b": 0.1}}
    >>> limits = {"samples": (100, 5000), "edge_rounds": (0, 0), "cloud_rounds": (0, 0)}
    >>> sizes = {"sample_mb": 1.6, "model_mb": 60, "edge_groups": (4,)}
    >>> task = {"name": "objects", **sizes, "limits": limits, "curve": curve}
    >>> Problem(budgets_mb={"wireless": 4000, "wireline": 4000}, tasks=[task]).tasks[0].limits.samples
    (100, 5000)
    """

    document: ClassVar = "an allocation problem"

    budgets_mb: Budgets
    edge_rounds_per_cloud_round: Count = 1  # k: each cloud round runs, and pays, k edge rounds in every region
    horizon_s: Positive | None = None  # longest time that each vehicle may be busy, on its own link and training
    annotation_s: Annotated[Positive | None, LEFT_OUT] = None  # time of all annotators for the samples of stage I
    objective: Objective = "weighted"
    robust: bool = False  # whether to plan for the upper bands of the curves
    performance: Fraction | None = (
        None  # of the whole system with all tasks; then weights are what each task adds to it
    )
    tasks: Annotated[tuple[AllocationTask, ...], Field(min_length=1)]

    @property
    def variants(self) -> tuple[AllocationTask, ...]:
        """All tasks, each by every network that a plan may choose."""
        return tuple(each for task in self.tasks for each in task.variants)

    @model_validator(mode="after")
    def _one_link_per_vehicle(self) -> Self:
        links: dict[str, Uplink] = {}
        for task in self.variants:
            for vehicle, link in (task.uplink_mbps or {}).items():
                if links.setdefault(vehicle, link) != link:
                    raise ValueError(
                        f"uplink_mbps of task {task.name!r} gives vehicle {vehicle!r} another link than an earlier task"
                    )
        return self

    @model_validator(mode="after")
    def _held_by_a_round(self) -> Self:
        horizon_s = np.inf if self.horizon_s is None else self.horizon_s
        for task in self.variants:
            train_s = min([task.vehicle_train_s.get(name, task.train_s) for name in task.vehicles] or [task.train_s])
            for steps in task.local_steps:
                if steps.factor * train_s > horizon_s:
                    raise ValueError(
                        f"local_steps of task {task.name!r}: no round can hold {steps.factor:g} times the steps, which "
                        f"take {steps.factor * train_s:g} s and horizon_s is {horizon_s:g}"
                    )
        return self

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        names = [learner.name for task in self.tasks for learner in task.learners]
        for each in ([task.name for task in self.tasks], names):
            name, times = Counter(each).most_common(1)[0]
            if times > 1:
                raise ValueError(f"{times} tasks are named {name!r}")
        if self.edge_rounds_per_cloud_round == 0:
            for task in self.tasks:
                if task.limits.cloud_rounds[0] > 1:
                    raise ValueError(
                        f"task {task.name!r} asks for {task.limits.cloud_rounds[0]} cloud rounds or more, and "
                        "edge_rounds_per_cloud_round = 0 allows one: models that no one trains in between are equal"
                    )
        return self

    @model_validator(mode="after")
    def _annotated(self) -> Self:
        if self.annotation_s is not None and not any(each.annotations for each in self.variants):
            raise ValueError(f"annotation_s = {self.annotation_s:g} limits nothing: no task has annotations")
        return self

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.objective == "area" and sum(len(task.learners) for task in self.tasks) < 3:
            raise ValueError("objective 'area' needs at least 3 tasks: the area has one corner per task")
        for task in self.tasks:
            if self.robust and task.upper is None:
                raise ValueError(f"robust = true needs 'upper' beside the curve of task {task.name!r}")
            if (self.performance is None) != (task.performance_without is None):
                given, missing = ("performance_without", "performance")[:: 1 if self.performance is None else -1]
                raise ValueError(f"task {task.name!r}: '{given}' is given, and '{missing}' is missing")
        if self.performance is not None and all(
            (task.performance_without or 0) >= self.performance for task in self.tasks
        ):
            raise ValueError(f"no task adds to performance = {self.performance:g}: there is nothing to weigh")
        return self
