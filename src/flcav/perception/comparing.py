"""Paired comparison of any two networks of a task, on the same frames and on the targets that both detect.

The two may have different tasks, such as a subclass of a task of the package (docs/tasks.md).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import nn

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, print_progress
from flcav.machine.threads import use_threads
from flcav.perception.agents import FrameSelection, choose_frames
from flcav.perception.networks import Data, Named, Weights, open_data, resolve_network, resolve_task
from flcav.perception.outcomes import NetworkComparison, Outcomes, SharesTargets, as_measurable, compare_outcomes
from flcav.perception.task import Task
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.weights import PACKAGED, read_card, read_family


def compare(
    task: Named | tuple[Named, Named],
    data: Data,
    first: Weights,
    second: Weights,
    *,
    agents: str | None = None,
    device: str = "auto",
    threads: int = 1,
    progress: Report = print_progress,
) -> NetworkComparison:
    """Compare two networks of a task on the same recorded frames and targets, paired: the second minus the first.

    Networks of different classes or ranges are compared on the targets that both detect, in the frames that both can
    use. A file of weights is loaded by the named or packaged task of its family. Two runs are compared by
    `flcav.runs.compare`.

    Raises `InputError` where task, data, weights, device or agents are unusable, where the tasks measure different
    things, and where the networks have no frames or targets in common.

    Args:
        task: a name of `TASKS`, `module:NAME`, or the task itself; of both networks, or a pair with one for each.
        data: dataset or its folder.
        first: the first network or its file of weights; None, or "packaged": that of the package.
        second: the second network, likewise.
        agents: whose frames: "vehicles", "poles", "all", or names with commas; None: those that both networks fit.
        device: "auto", "cpu" or "cuda".
        threads: number of CPU threads.
        progress: callback for the frames done so far and in total, of each network.

    >>> from flcav import compare
    >>> same = compare("weather", "data", "packaged", "packaged")  # the network of the package, with itself
    >>> same.difference.mean, same.verdict
    (0.0, 'undecided')
    """
    use_threads(threads)
    named = [resolve_task(one) for one in (task if isinstance(task, tuple) else (task, task))]
    weights = (first, second)
    tasks = [_find_task(one, named, file) for one, file in zip(named, weights, strict=True)]
    _check_measures(tasks)
    dataset = open_data(data)
    networks = [resolve_network(one, file, device) for one, file in zip(tasks, weights, strict=True)]
    configs = [network.config for network in networks]
    frames = _choose_common(
        dataset, [choose_frames(*pair, dataset, agents) for pair in zip(tasks, configs, strict=True)]
    )
    targets, words = _share_targets(tasks, configs)
    before, after = (_test(*pair, dataset, frames, targets, progress) for pair in zip(tasks, networks, strict=True))
    return compare_outcomes(tasks[0], before, after, len(frames), words)


def read_task(weights: Sequence[Path]) -> str:
    """Return the task on the card of the first file among `weights`, which has to be one of the package.

    Raises `InputError` without a card, for another task, and where all weights are `PACKAGED`.
    """
    files = [path for path in weights if str(path) != PACKAGED]
    if not files:
        raise InputError(f"--task is missing: of which task the networks of the package are, {', '.join(TASKS)}")
    task = read_card(files[0]).task
    if task not in TASKS:
        raise InputError(f"{files[0]}: weights of '{task}', a task of your own: name it by --task module:NAME")
    return task


def _find_task(task: Task, named: Sequence[Task], weights: Weights) -> Task:
    """Return the task that loads `weights`: the first of their family among `task`, `named` and the package's."""
    if isinstance(weights, nn.Module):
        return task
    known = map(task_named, TASKS)
    packaged = next((one for one in known if one.name == task.name or isinstance(task, type(one))), task)
    if weights is None or str(weights) == PACKAGED:
        return packaged
    family = read_family(Path(weights))
    return next((one for one in (task, *named, packaged) if one.family == family), task)


def _check_measures(tasks: Sequence[Task]) -> None:
    """Raise `InputError` unless the tasks have the same measure."""
    measures = [f"{as_measurable(task).measure_name} of '{task.name}'" for task in tasks]
    alike = isinstance(tasks[0], SharesTargets) or tasks[0].name == tasks[1].name
    if as_measurable(tasks[0]).measure_name != as_measurable(tasks[1]).measure_name or not alike:
        raise InputError(
            f"the networks are measured by different things, {measures[0]} and {measures[1]}; a task of your own that "
            "is a subclass of the package's has its measure"
        )


def _choose_common(data: Dataset, chosen: Sequence[FrameSelection]) -> list[int]:
    """Return the frames that both networks use; raises `InputError` where there are none."""
    common = [number for number in chosen[0].frames if number in set(chosen[1].frames)]
    if not common:
        counts = " and ".join(selection.sentence for selection in chosen)
        raise InputError(f"{data.folder}: the networks use different frames of it, {counts}: choose some by --agents")
    return common


def _share_targets(tasks: Sequence[Task], configs: Sequence[Any]) -> tuple[Any, str]:
    """Return the configuration of the common targets and its description; None and "" for equal targets."""
    task = tasks[0]
    if not isinstance(task, SharesTargets) or len({task.describe_targets(config) for config in configs}) == 1:
        return None, ""
    common = task.share_targets(configs)
    return common, task.describe_targets(common)


def _test(task: Task, network: Any, data: Dataset, frames: Sequence[int], targets: Any, progress: Report) -> Outcomes:
    if targets is not None and isinstance(task, SharesTargets):
        return task.outcomes(network, data, frames, progress, targets)
    return as_measurable(task).outcomes(network, data, frames, progress)
