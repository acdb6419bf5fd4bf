"""Forms and sizes of the updates that vehicles send, and the rounds that a plan gives each vehicle."""

from collections.abc import Iterable, Sequence

from flcav.config import Config
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.selection import Selection
from flcav.federation.strategies import exchanges_more, strategy_named
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.upload import Upload
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import to_arrays
from flcav.runs.arms import Setting
from flcav.runs.recipe import Federation
from flcav.runs.results.plans import TaskPlan


class UpdateForm(Config):
    """The form in which a client's update is sent, as far as its size depends on it."""

    upload: Upload = Upload()
    exchanging: bool = False  # with an array beside each that is learned
    frames: int | None = None  # class probabilities of so many shared frames instead; None: weights


def update_forms(settings: Iterable[Setting]) -> list[UpdateForm]:
    """Return the different forms of the arms' updates, in the order of the arms."""
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
    """Return the rules by which vehicles join the rounds that the plan gives them, of stage II or after it.

    Another selection than that of all vehicles goes before the plan's.
    """
    if plan.joins is None or how.selection.rule != "all":
        return how
    joins = plan.joins_after_edge() if after_edge else plan.joins
    return how.model_copy(update={"selection": Selection(rule="planned", joins=joins)})


def model_mb(task: Task, network: str | None, forms: Sequence[UpdateForm] = (UpdateForm(),)) -> float:
    """Return the serialised size of one model update [MB], the largest of its `forms`, by a dry run of the message."""
    weights = to_arrays(build_network(task, find_configuration(task, network), 0))
    return max(update_bytes(weights, form.upload, exchanging=form.exchanging) for form in forms) / BYTES_PER_MB
