"""The plan that chooses the modalities to upload, from learning curves of two sizes, and what retraining says of it.

A curve is a power law through the errors after few and after all samples, on validation frames. The plan takes a
network for a budget that neither size has; all networks are retrained within it. The limit of annotators' time is for
the network of the LiDAR alone: quick annotations cost less time, and their noise more error, as measured.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import log
from typing import Any

from flcav.config import Json, parse_config
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.problem import Problem
from flcav.optimization.verification.allocation import verify_allocation
from flcav.storage.markdown import format_table

CAREFUL, QUICK = "careful", "quick"
BOX_S: Mapping[str, float] = {CAREFUL: 30.0, QUICK: 10.0}  # of an annotator for a box: settings, not measured
BOXES = 4.0  # to be annotated in a sample: likewise
HOURS = (2.0, 6.0, 20.0)  # of annotators
NETWORK_MB = 0.65  # of an update, which no plan here sends
LEAST_B = 0.01  # of a curve's exponent, where more samples do not help


@dataclass(frozen=True)
class Choice:
    """A network that a plan may choose: bytes of its samples, measured errors, and the error of a retraining."""

    sample_mb: float
    measured: tuple[tuple[float, float], tuple[float, float]]  # samples and error (1 - AP50): few, and all
    retrained: float  # error after retraining within the plan's budget
    quick: float | None  # error of all samples with quick annotations; None: not trained

    @property
    def curve(self) -> tuple[float, float]:
        """Return a and b of the error a x^-b after x samples."""
        (few, high), (all_, low) = self.measured
        b = max(log(high / low) / log(all_ / few), LEAST_B)
        return low * all_**b, b


@dataclass(frozen=True)
class PlannedAnnotation:
    """The plan under a limit of annotators' time."""

    hours: float
    annotation: str
    samples: int
    predicted_error: float
    verified: bool  # whether the independent verification finds no fault


@dataclass(frozen=True)
class PlanResult:
    """The plan of modalities under a budget, and those of annotation."""

    budget_mb: float
    choices: Mapping[str, Choice]  # by network
    predicted: Mapping[str, float]  # error within the budget, by network
    chosen: str
    verified: bool  # whether the independent verification finds no fault
    best: str  # network of least error by retraining
    worth: float | None  # samples with careful annotations that one with quick ones is worth
    annotations: tuple[PlannedAnnotation, ...]

    def tables(self) -> dict[str, str]:
        """Return Markdown by name: plan, annotation."""
        rows = [
            [
                *(name, f"{choice.sample_mb:.3f}", f"{int(self.budget_mb / choice.sample_mb)}"),
                *(f"{1 - self.predicted[name]:.3f}", f"{1 - choice.retrained:.3f}"),
                ", ".join(["plan"] * (name == self.chosen) + ["best of the retrainings"] * (name == self.best)),
            ]
            for name, choice in self.choices.items()
        ]
        head = ("network", "sample, MB", f"samples in {self.budget_mb:g} MB", "AP50, predicted", "AP50, retrained", "")
        annotated = [
            [f"{each.hours:g}", each.annotation, str(each.samples), f"{1 - each.predicted_error:.3f}"]
            for each in self.annotations
        ]
        return {
            "plan": format_table(head, rows),
            "annotation": format_table(("annotators' hours", "annotation", "samples", "AP50, predicted"), annotated),
        }


def plan_uploads(choices: Mapping[str, Choice], budget_mb: float) -> PlanResult:
    """Return the plan under `budget_mb` of uplink, and those under limits of annotators' time for the first network."""
    own, *others = (describe_variant(name, choice) for name, choice in choices.items())
    values: dict[str, Json] = {"budgets_mb": {"wireless": budget_mb, "wireline": budget_mb}}
    chosen, verified = _plan({**values, "tasks": [own | {"alternatives": others}]})
    predicted = {}
    for name, choice in choices.items():
        a, b = choice.curve
        predicted[name] = a * min(int(budget_mb / choice.sample_mb), choice.measured[1][0]) ** -b
    first = next(iter(choices.values()))
    worth, planned = None, []
    if first.quick is not None:
        a, b = first.curve
        worth = (a / first.quick) ** (1 / b) / first.measured[1][0]
        ways = {CAREFUL: {"box_s": BOX_S[CAREFUL]}, QUICK: {"box_s": BOX_S[QUICK], "worth": worth}}
        task = {name: each for name, each in own.items() if name != "network"} | {"boxes": BOXES, "annotations": ways}
        for hours in HOURS:
            plan, holds = _plan(
                {"budgets_mb": {"wireless": 1e4, "wireline": 1e4}, "annotation_s": 3600 * hours, "tasks": [task]}
            )
            planned.append(
                PlannedAnnotation(hours, plan["annotation"], plan["samples"], plan["predicted_error"], holds)
            )
    best = min(choices, key=lambda name: choices[name].retrained)
    return PlanResult(budget_mb, choices, predicted, chosen["network"], verified, best, worth, tuple(planned))


def describe_variant(name: str, choice: Choice) -> dict[str, Any]:
    """Return the task by one network, as in a problem file."""
    a, b = choice.curve
    return {
        "name": "objects",
        "network": name,
        "sample_mb": choice.sample_mb,
        "model_mb": NETWORK_MB,
        "edge_groups": [2],
        "limits": {"samples": [1, int(choice.measured[1][0])], "edge_rounds": [0, 0], "cloud_rounds": [0, 0]},
        "curve": {"model": "additive", "floor": 0.0, "pretrain": {"a": a, "b": b}},
    }


def _plan(values: Mapping[str, Json]) -> tuple[dict[str, Any], bool]:
    """Return the plan of the only task of a problem, and whether the independent verification finds no fault."""
    problem = parse_config(Problem, dict(values), "modalities")
    plan = allocate(problem)
    told = asdict(plan)
    told["used_mb"] = {link.removesuffix("_mb"): mb for link, mb in told["used_mb"].items()}
    faults = verify_allocation(problem.model_dump_json(), json.dumps(told)).faults
    return told["tasks"][0], plan.status == "optimal" and not faults
