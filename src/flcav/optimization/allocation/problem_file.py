"""Fitted curves in the YAML file of an allocation problem, and the definitions of the terms of a plan.

`flcav fit` writes the file that `flcav allocate` reads. An existing file keeps its text, comments included: only the
values of the fields that a fit determines are replaced, or added after the other fields of their task. Numbers are
rounded to `DIGITS` digits. Each term is defined once, in `TERMS`: the plan's page and the command line show these
sentences, and the documentation repeats them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from flcav.config import InputError
from flcav.geometry.arrays import Array
from flcav.optimization.allocation.allocate import resolve_problem
from flcav.optimization.curves.curves import Additive, OwnCurve
from flcav.optimization.curves.fitting import QUANTITIES, CurveFit
from flcav.optimization.problem import Problem

MEASURES = {"weighted": "weighted error", "max-min": "largest error", "area": "area"}  # by objective; keys of `TERMS`
STEPS = {  # the quantities that cost uplink megabytes
    "samples": "labelled samples go from the vehicles over a wireless link to their edge server and over a wireline to "
    "the cloud",
    "edge round": "in an edge round every vehicle sends its network to its edge server",
    "cloud round": "in a cloud round every edge server sends its network to the cloud",
}
CURVE = "A learning curve per task says how much error each of them takes away."
TERMS = {
    "error": "1 minus a task's accuracy, as its curve predicts it.",
    "band": "of a predicted accuracy: between the curves fitted to both edges of the bootstrap band, which `flcav fit` "
    "gives a level of 90 % unless told otherwise.",
    "weighted error": "the errors of all tasks, each times its weight, added up: their mean only where the weights sum "
    "to 1.",
    "largest error": "the error of the task that errs most.",
    "area": "that of the polygon whose corners are the tasks' accuracies on equally spaced axes; large where no task "
    "is left behind.",
    "budget": "what may go up over one type of link, from all vehicles together, during the whole training. What comes "
    "down is not counted.",
    "saved": "what a plan that is solved anew with more of one budget, the other as it is, does better than this one. "
    "Plans are in whole samples and rounds, so more megabytes help in steps.",
    "up to": "the upper band of a curve, which this plan makes least; the predicted error is the curve's own.",
    "proven": "the solver also finds a bound that no plan can be below, so how far this one could still be improved is "
    "known. It is a bound for the fitted curves; a training may go otherwise.",
}
Edit = tuple[int, int, str]  # start, end, replacement
DIGITS = 6  # significant digits of a number
ENDLESS = 10**9  # width of a line that is never wrapped


def explain_objective(problem: Problem, objective: float) -> str:
    """Return the definition of the problem's objective, in a sentence.

    For weights that do not sum to 1, a second sentence gives the mean error of a plan whose objective is `objective`.
    """
    sentence = TERMS[MEASURES[problem.objective]]
    weights = sum(task.weight for task in resolve_problem(problem).tasks)
    if problem.objective != "weighted" or abs(weights - 1) < 1e-9:
        return sentence
    return f"{sentence} Here they sum to {weights:.3g}, and the mean is {objective / weights:#.2g}."


@dataclass(frozen=True)
class FittedFields:
    """The fields of a task in an allocation problem that are determined by a history."""

    curve: OwnCurve
    upper: OwnCurve | None  # of the upper band; None: too few points for one
    limits: Mapping[str, list[int]]  # least and most of each quantity in the history
    measured: Mapping[str, float]  # most of each quantity that varies in the history
    lower: OwnCurve | None = None  # of the lower band; None: too few points for one


def collect_fitted_fields(
    fit: CurveFit, resources: Array, upper: OwnCurve | None, lower: OwnCurve | None = None
) -> FittedFields:
    """Return the fields of a task from its `fit`, its bands and the `resources` (n, 3) of its history."""
    least = np.ceil(resources.min(axis=0)).astype(int).tolist()
    most = np.floor(resources.max(axis=0)).astype(int).tolist()
    limits = {name: [low, max(low, high)] for name, low, high in zip(QUANTITIES, least, most, strict=True)}
    return FittedFields(fit.curve, upper, limits, fit.measured, lower)


def format_problem(tasks: Mapping[str, FittedFields], k: int, history: str) -> str:
    """Return the YAML text of a new problem of `tasks`, by name; fields that no history determines are left empty.

    `k` are the edge rounds per cloud round, `history` names the source of the curves in a comment.
    """
    lines = [
        f"# Learning curves of {history}. What is empty is yours to fill in; then `flcav allocate` takes this file.",
        f"budgets_mb: {{wireless: , wireline: }} # [MB] {TERMS['budget']}",
        f"edge_rounds_per_cloud_round: {k}",
        "tasks:",
    ]
    for name, fitted_fields in tasks.items():
        limits, *fitted = [_entry(field, value) for field, value in _fields(fitted_fields).items() if value is not None]
        lines += [
            f"  - {_entry('name', name)}",
            "    weight: 1",
            "    sample_mb: # [MB] one labelled sample",
            "    model_mb: # [MB] the network, as it is sent in every round",
            "    edge_groups: # vehicles per edge server, such as [4, 3]",
            f"    {limits} # least and most; here what the history covers",
            *(f"    {entry}" for entry in fitted),
        ]
    return "\n".join(lines) + "\n"


def read_task_names(text: str, origin: str) -> list[str]:
    """Return the names of the tasks in the `text` of a problem; raises `InputError` where it is not a problem."""
    return list(_tasks(text, origin)[1])


def insert_curves(text: str, tasks: Mapping[str, FittedFields], k: int, origin: str) -> str:
    """Return the `text` of a problem (a list of tasks or a graph) with the fitted fields of `tasks`, by name, inserted.

    Existing limits are kept. `k` is the number of edge rounds per cloud round in fits over effective samples. Raises
    `InputError` where the problem has no task of a name or another `k`, or where its text cannot be edited in place.
    """
    (values, known), edits = _tasks(text, origin), []
    planned = values.get("edge_rounds_per_cloud_round", 1)
    if planned != k and not all(isinstance(fitted.curve, Additive) for fitted in tasks.values()):
        raise InputError(f"{origin}: edge_rounds_per_cloud_round = {planned}, and the curves are fitted with {k}")
    for name, fitted in tasks.items():
        if name not in known:
            raise InputError(f"{origin}: the history is of task {name!r}, which is none of {', '.join(known)}")
        held, node = known[name]
        if isinstance(several := held.get("network"), list) and len(several) > 1:
            raise InputError(f"{origin}: task {name!r} has {len(several)} networks, and a curve is of one of them")
        fields = {field: value for field, value in _fields(fitted).items() if _wanted(field, value, held)}
        if "networks" in values:  # a graph, whose tasks have a curve and no more
            fields = {"curve": fields["curve"]}
        held |= fields
        edits += _edits(text, node, fields)
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    if _loaded(text) != values:
        raise InputError(f"{origin}: curves cannot be put into YAML that is laid out like this: write a field per line")
    return text


def _fields(fitted: FittedFields) -> dict[str, Any]:
    """Return the fields of a task, as in a problem file."""
    return {
        "limits": dict(fitted.limits),
        "curve": _written(fitted.curve),
        "upper": None if fitted.upper is None else _written(fitted.upper),
        "lower": None if fitted.lower is None else _written(fitted.lower),
        "measured": _rounded(fitted.measured),
    }


def _wanted(field: str, value: Any, held: Mapping[str, Any]) -> bool:
    if field == "limits":
        return held.get(field) is None
    return value is not None or field in held  # an upper band of older points does not outlive them


def _tasks(text: str, origin: str) -> tuple[dict[str, Any], dict[str, tuple[dict[str, Any], yaml.MappingNode]]]:
    """Return the values in `text`, and the tasks by name: their values (part of the former) and their YAML nodes."""
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
        raise InputError(f"{origin}: curves cannot be put into YAML with aliases (*): write out what they stand for")
    values, root = yaml.safe_load(text), yaml.compose(text)
    tasks = values.get("tasks") if isinstance(values, dict) else None
    node = _entries(root).get("tasks")
    listed: list[tuple[Any, Any, yaml.Node]]
    if isinstance(tasks, dict):
        listed = [(name, tasks.get(name), each) for name, each in _entries(node).items()]
    elif isinstance(tasks, list) and isinstance(node, yaml.SequenceNode):
        listed = [(task.get("name"), task, each) for task, each in zip(tasks, node.value) if isinstance(task, dict)]
    else:
        raise InputError(f"{origin}: not an allocation problem: it has no tasks")
    return values, {
        name: (task, each)
        for name, task, each in listed
        if isinstance(name, str) and isinstance(task, dict) and isinstance(each, yaml.MappingNode)
    }


def _entries(node: yaml.Node | None) -> dict[str, yaml.Node]:
    return {key.value: value for key, value in node.value} if isinstance(node, yaml.MappingNode) else {}


def _edits(text: str, node: yaml.MappingNode, fields: Mapping[str, Any]) -> list[Edit]:
    """Return the edits of `text` that set `fields` in `node`."""
    held, edits = {key.value: (key, value) for key, value in node.value}, []
    for field, value in fields.items():
        if field in held:
            key, old = held[field]
            edits.append((key.start_mark.index, _end(old), _entry(field, value)))
    added = [_entry(field, value) for field, value in fields.items() if field not in held]
    if added:
        end = _end(node.value[-1][1])
        if node.flow_style:
            edits.append((end, end, "".join(f", {entry}" for entry in added)))
        else:
            line = text.find("\n", end)
            place = len(text) if line < 0 else line
            edits.append((place, place, "".join(f"\n{' ' * node.start_mark.column}{entry}" for entry in added)))
    return edits


def _end(node: yaml.Node) -> int:
    """Return the index at which the text of `node` ends.

    The end mark of a block is after the blank lines and comments that follow it, so it is that of its last value.
    """
    if not isinstance(node, yaml.CollectionNode) or node.flow_style or not node.value:
        return node.end_mark.index
    last = node.value[-1]
    return _end(last[1] if isinstance(last, tuple) else last)


def _written(curve: OwnCurve) -> dict[str, Any]:
    return {"model": curve.model} | _rounded(curve.model_dump(exclude_defaults=True, exclude={"model"}))


def _rounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `values` with numbers rounded to `DIGITS` digits, whole ones as int."""
    return {name: _short(value) for name, value in values.items()}


def _short(value: Any) -> Any:
    if isinstance(value, dict):
        return _rounded(value)
    return [_number(each) for each in value] if isinstance(value, tuple) else _number(value)


def _number(value: float) -> float:
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short.is_integer() and abs(short) < 10**DIGITS else short


def _entry(name: str, value: Any) -> str:
    return f"{name}: {_flow(value)}"


def _flow(value: Any) -> str:
    """Return `value` as YAML on one line."""
    dumped = yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=ENDLESS, allow_unicode=True)
    return dumped.strip()[1:-1]


def _loaded(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None
