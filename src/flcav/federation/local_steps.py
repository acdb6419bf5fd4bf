"""`local_steps: fit` in a run recipe: as many local steps in a round as the horizon holds over all rounds.

A vehicle of speed 1 trains in every round of every task, in the fixed plan or, with a history, in the most rounds that
`limits` allow. `train_s` of a task is the time of a round with `MEASURED` steps, and becomes that of the steps found.
Where all plans are fixed, the horizon decides on nothing else, and the recipe is then without it.
"""

from collections.abc import Mapping
from math import floor

from flcav.config import Json

FIT = "fit"
MEASURED = 16  # steps that `train_s` is of where the recipe's own are to be found: the default of `Training`
ROUNDING = 1e-9  # of a step, which there is time for all the same

Values = Mapping[str, Json]  # of a recipe, before any field is checked


def fit_local_steps(values: Values, preset: int) -> Values:
    """Return the values of a recipe with a number wherever they say `fit`.

    preset: local steps of the run where it has no `training` of its own.
    Raises ValueError where the time or the rounds are not told, or no step fits.
    """
    training, arms = _mapping(values, "training"), _mapping(values, "arms")
    fitted = [name for name in arms if _mapping(_mapping(arms, name), "training").get("local_steps") == FIT]
    own = training.get("local_steps") == FIT
    for task in _mapping(values, "tasks"):
        if _mapping(_mapping(_mapping(values, "tasks"), task), "training").get("local_steps") == FIT:
            raise ValueError(f"tasks.{task}.training.local_steps: tasks share a vehicle's time; write it in training")
    measured = _count(MEASURED if own else training.get("local_steps", MEASURED if training else preset))
    if not (own or fitted) or measured is None:
        return values
    steps = _find_steps(values, measured, "training" if own else f"arms.{fitted[0]}.training")
    found = dict(values)
    tasks = {name: _mapping(_mapping(values, "tasks"), name) for name in _mapping(values, "tasks")}
    if all(_mapping(task, "plan") for task in tasks.values()):
        found["horizon_s"] = None  # it is used up: no plan is left that it could limit
    if own:
        taken = {name: _number(task, "train_s", "train_s") * steps / measured for name, task in tasks.items()}
        found["training"] = {**training, "local_steps": steps}
        found["tasks"] = {name: {**task, "train_s": taken[name]} for name, task in tasks.items()}
    if fitted:
        changed = {name: _mapping(arms, name) for name in fitted}
        by_arm = {name: {**_mapping(arm, "training"), "local_steps": steps} for name, arm in changed.items()}
        found["arms"] = {**arms, **{name: {**arm, "training": by_arm[name]} for name, arm in changed.items()}}
    return found


def _find_steps(values: Values, measured: int, where: str) -> int:
    """Return how many steps of all tasks fit in the horizon, where `train_s` is of `measured` steps."""
    horizon_s, needed_s, many = _number(values, "horizon_s", "horizon_s"), 0.0, 0
    for name in _mapping(values, "tasks"):
        task = _mapping(_mapping(values, "tasks"), name)
        rounds = _count_rounds(values, task, name)
        needed_s += rounds * _number(task, "train_s", f"tasks.{name}.train_s")
        many += rounds
    steps = floor(measured * horizon_s / needed_s + ROUNDING) if needed_s > 0 else 0
    if steps < 1:
        why = f"no round can hold a step: {many} rounds of {measured} steps take {needed_s:g} s"
        raise ValueError(f"{where}.local_steps: {why if many else 'there is no round'}, and horizon_s is {horizon_s:g}")
    return steps


def _count_rounds(values: Values, task: Values, name: str) -> int:
    """Return the edge rounds of a task, those in its cloud rounds included: of its plan, or the most by the limits."""
    plan, limits = _mapping(task, "plan"), _mapping(values, "limits")
    told = [plan.get(stage) if plan else limits.get(stage) for stage in ("edge_rounds", "cloud_rounds")]
    edge, cloud = (_count(each[-1] if isinstance(each, list | tuple) and each else each) for each in told)
    k = _count(_mapping(values, "federation").get("edge_rounds_per_cloud_round", 1))
    if edge is None or cloud is None or k is None:
        raise ValueError(
            f"local_steps: {FIT} needs the number of rounds of '{name}': a fixed 'plan', or the most of 'edge_rounds' "
            "and 'cloud_rounds' in 'limits'"
        )
    return edge + k * cloud


def _count(value: Json) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None


def _mapping(values: Values, name: str) -> Values:
    found = values.get(name)
    return found if isinstance(found, Mapping) else {}


def _number(values: Values, name: str, told: str) -> float:
    found = values.get(name)
    if isinstance(found, bool) or not isinstance(found, int | float) or not found > 0:
        raise ValueError(f"local_steps: {FIT} needs '{told}', in seconds")
    return float(found)
