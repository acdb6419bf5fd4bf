"""Forms and sizes of the updates that vehicles send, and the rounds in which a plan has them take part."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flcav.config import Config
from flcav.federation.links.in_process import update_bytes
from flcav.federation.rules import Rules
from flcav.federation.selection import Selection
from flcav.federation.strategies import exchanges_more, strategy_named
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.upload import Upload
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.client import SharedSamples, as_shared
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting
from flcav.runs.frames import Frames
from flcav.runs.recipe import Federation
from flcav.runs.results.plans import TaskPlan
from flcav.statistics.streams import stream


class UpdateForm(Config):
    """The form in which a client's update is sent, as far as its size depends on it."""

    upload: Upload = Upload()
    exchanging: bool = False  # with a second array for every learned one
    frames: int | None = None  # class probabilities of so many shared frames instead; None: weights


def update_forms(settings: Iterable[Setting]) -> list[UpdateForm]:
    """Return the distinct forms of the arms' updates, in the order of the arms."""
    forms = []
    for setting in settings:
        how = setting.federation
        strategy = strategy_named(how.strategy)
        frames = strategy.frames if isinstance(strategy, FedMD) else None
        form = UpdateForm(upload=how.upload, exchanging=exchanges_more(how.strategy), frames=frames)
        if form not in forms and setting.central is None:
            forms.append(form)
    return forms


def follow_plan(how: Federation, plan: TaskPlan, *, after_edge: bool) -> Rules:
    """Return the rules by which vehicles join their planned rounds, in stage II or after it.

    A selection in the recipe other than all vehicles has precedence over the plan.
    """
    if plan.joins is None or how.selection.rule != "all":
        return how
    joins = plan.joins_after_edge() if after_edge else plan.joins
    return how.model_copy(update={"selection": Selection(rule="planned", joins=joins)})


def model_mb(task: Task, network: str | None, forms: Sequence[UpdateForm] = (UpdateForm(),)) -> float:
    """Measure the serialised size of a model update [MB], the largest of its `forms`, by a dry run of the message."""
    weights = to_arrays(build_network(task, find_configuration(task, network), 0))
    return max(update_bytes(weights, form.upload, exchanging=form.exchanging) for form in forms) / BYTES_PER_MB


def measure_exchange(
    task: Task, config: Any, pools: Sequence[Frames], forms: Sequence[UpdateForm], most: int, seed: int
) -> float | None:
    """Measure what a vehicle sends in a round to be combined [MB], the largest of the `forms`.

    None where all of them are updates of weights. `most`: number of uploaded frames, from which shared ones are drawn.
    """
    if not any(form.frames for form in forms):
        return None
    weights = to_arrays(build_network(task, config, 0))
    sizes = []
    every = [(pool, i) for pool in pools for i in pool.vehicles]
    drawn = [every[number] for number in stream(seed, "shared").permutation(len(every)).tolist()]
    for form in forms:
        sent: Mapping[str, Any] = weights
        if form.frames:
            shown = drawn[: min(form.frames, most)]
            messages = [one for pool, i in shown for one in as_shared(task).pack_samples(pool.data, config, [i])]
            samples = as_shared(task).unpack_samples(messages, config) or ()
            sent = SharedSamples(task, config, samples, 1).outputs(weights) if samples else {}
        sizes.append(update_bytes(sent, form.upload, exchanging=form.exchanging))
    return max(sizes) / BYTES_PER_MB


@dataclass(frozen=True)
class RegionDrive:
    """A drive of a region before its training, and the number of training frames that its vehicles will hold."""

    drive: Frames
    recorded: bool  # whether the region is a recorded dataset, whose poles are those that it was recorded from
    training_frames: int  # of all its vehicles together
    vehicles: int


@dataclass(frozen=True)
class Sensors:
    """The roadside sensors near which vehicles label their frames, as far as known before their placement."""

    poles: tuple[int, ...]  # numbers of poles that the recipe names
    count: int  # number of other sensors in a region
    traffic_m: float  # radius of the traffic around a pole [m]
    near_m: float  # vehicles label frames recorded within this distance of a sensor [m]
