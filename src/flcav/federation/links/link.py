"""Links of a federation's server to its clients, by runtime: this process, client processes, Ray, or a deployed fleet.

What crosses a link is lost where the network loses it, held to the budget where it leaves, and entered in the ledger.
Questions outside training go over it, too; the caller enters the answers that count in the ledger.
"""

import contextlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Union

from cryptography import x509
from flwr.app import ConfigRecord, Message, MessageType, RecordDict
from flwr.serverapp import Grid

from flcav.config import InputError
from flcav.federation.client import ClientAgreement, client_app
from flcav.federation.links.in_process import EmbeddedGrid, limit_time
from flcav.federation.links.metered import Account, MeteredGrid
from flcav.federation.links.processes import ClientProcesses, train_remotely
from flcav.federation.rules import Rules
from flcav.federation.state import ClientStates, ReadStates, RoundRecord
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import Trainable, Weights, answer_question
from flcav.federation.wire import ANSWER_S, ARRAYS, ASK, GRANT, Arrived, Lost, list_events, read_arrays, to_array_record
from flcav.interface.wording import suggest

if TYPE_CHECKING:
    from flcav.federation.links.flower import Deployment, PartlyDeployed, RegionalDeployment
    from flcav.federation.links.ray import RaySimulation
    from flcav.federation.links.topics import RosTopics

RUNTIMES = "embedded", "ray", "flower"
NOTHING: Weights = {}  # comes with a question
UNREADABLE = "an answer that cannot be read"  # why one is missing
# where clients train, and how messages reach them
Runtime = Union[ClientProcesses, "RaySimulation", "Deployment", "RegionalDeployment", "PartlyDeployed", "RosTopics"]


@dataclass(frozen=True)
class Replies:
    """What clients answered to a question."""

    answers: Mapping[str, Weights]  # by client
    missing: Mapping[str, str]  # by client why it did not answer


class Ask(Protocol):
    """A way to ask clients."""

    def __call__(
        self, question: str, clients: Sequence[str], arrays: Weights = NOTHING, *, counted: bool = True
    ) -> Replies:
        """Return the replies of `clients`, in their order, to a question that these `arrays` come with.

        A deployed client keeps an answer that is `counted` where it is over the budget: `BudgetExceeded`.
        """
        ...


@dataclass(frozen=True)
class Link:
    """A server's end of the link to its clients."""

    grid: Grid
    names: Mapping[int, str]  # of the clients, by node
    ask: Ask
    read_states: ReadStates  # of what clients keep between rounds
    follow: Callable[[RoundRecord], None] = lambda _: None  # called with the record of each round that has ended
    authority: x509.Certificate | None = None  # that has certified the clients; None: they are not certified


@contextlib.contextmanager
def open_link(
    clients: Mapping[str, Trainable],
    runtime: Runtime | None,
    account: Account,
    agreed: ClientAgreement,
    states: ClientStates,
) -> Iterator[Link]:
    """Yield the link to `clients`, on which `account` counts and loses messages.

    Args:
        clients: by name.
        runtime: where they train; None: in this process.
        account: ledger of the messages, and the clients that the network loses.
        agreed: strategy, rules and secrets of the federation.
        states: what clients have kept from earlier rounds.
    """
    make_app = partial(client_app, **vars(agreed))
    rules = agreed.rules
    limit_s, names, far = rules.limits.train_s, [*clients], False
    if runtime is None:
        opened = EmbeddedGrid(make_app(limit_time(clients, limit_s)), names, states)
    elif isinstance(runtime, ClientProcesses):
        opened = EmbeddedGrid(make_app(train_remotely(clients, runtime, limit_s)), names, states, runtime.count)
    elif runtime.deployed is True:
        check_deployable(rules)
        opened, far = runtime.open(clients, agreed, states, account), True
    else:
        opened = runtime.open(clients, lambda each: make_app(limit_time(each, limit_s), simulated=True), states)
    with opened as inner:
        metered = MeteredGrid(inner, account, inner.names)
        follow = getattr(inner, "follow", lambda _: None)
        ask = partial(_ask_there, inner, inner.names) if far else partial(_ask_here, clients)
        yield Link(metered, inner.names, ask, inner.read_states, follow, getattr(inner, "authority", None))


def check_deployable(rules: Rules) -> None:
    """Raise `InputError` where deployed clients cannot keep to rules.

    The state of an optimiser tells of the gradients on a vehicle's data. To resume, the server's checkpoint would need
    it, and it is not to leave the vehicle.
    """
    if rules.keep_optimiser:
        raise InputError(
            "keep_optimiser: the server's checkpoint would need the state of each deployed vehicle's optimiser, which "
            "tells of its data; leave it out, or train in processes or on Ray"
        )


@contextlib.contextmanager
def open_questions(
    clients: Mapping[str, Trainable], deployed: "RegionalDeployment | PartlyDeployed | None", account: Account
) -> Iterator[Ask]:
    """Yield a way to ask clients outside the rounds of a federation: in this process, or `deployed`.

    By the budget of `account` deployed clients are granted bytes.
    """
    if deployed is None or not clients:
        yield partial(_ask_here, clients)
        return
    with open_link(clients, deployed, account, ClientAgreement(FEDAVG, Rules(), {}, 0), {}) as link:
        yield link.ask


def _ask_here(
    own: Mapping[str, Trainable],
    question: str,
    clients: Sequence[str],
    arrays: Weights = NOTHING,
    *,
    counted: bool = True,
) -> Replies:
    return Replies({name: answer_question(own[name], question, arrays) for name in clients}, {})


def _ask_there(
    grid: Grid,
    names: Mapping[int, str],
    question: str,
    clients: Sequence[str],
    arrays: Weights = NOTHING,
    *,
    counted: bool = True,
) -> Replies:
    nodes, records = {name: node for node, name in names.items()}, {ASK: ConfigRecord({ASK: question})}
    content = RecordDict({**records, **({ARRAYS: to_array_record(arrays)} if arrays else {})})
    if counted:
        content[GRANT] = ConfigRecord()  # filled in as it leaves
    messages = [Message(content, nodes[name], f"{MessageType.QUERY}.{ASK}") for name in clients]
    answers, missing = dict[str, Weights](), dict[str, str]()
    for event in list_events(clients, grid.send_and_receive(messages, timeout=ANSWER_S), names):
        if isinstance(event, Arrived):
            try:
                answers[event.client] = read_arrays(event.content, ARRAYS)
            except (KeyError, TypeError, ValueError) as error:
                missing[event.client] = f"{UNREADABLE}: {error}"
        else:
            missing[event.client] = event.reason if isinstance(event, Lost) else "no answer in time"
    return Replies(answers, missing)


@contextlib.contextmanager
def open_client_processes(clients: Mapping[str, Trainable], count: int) -> Iterator[ClientProcesses | None]:
    """Yield `count` processes for `clients`; None, for this one, where one is enough or they cannot be pickled."""
    try:
        own = ClientProcesses(clients, count) if count > 1 else None
    except InputError:
        own = None
    with own or contextlib.nullcontext() as processes:
        yield processes


@contextlib.contextmanager
def open_runtime(
    name: str,
    clients: Mapping[str, Trainable],
    count: int,
    fleet: Path | None = None,
    vehicles: Mapping[str, int] = {},
) -> Iterator[Runtime | None]:
    """Yield what `federate` takes as its `runtime` for clients of one region, or for those of each of several.

    embedded: messages within this process, and clients in `count` processes where these are several. ray: Flower's
    simulation with `count` actors. flower: vehicles of the `fleet` that is up in this folder, where each region of
    `vehicles` has so many (see `RegionalDeployment`), or of one that is brought up on this machine for as long. Raises
    `InputError` for another name.
    """
    match name:
        case "embedded":
            with open_client_processes(clients, count) as processes:
                yield processes
        case "ray":
            from flcav.federation.links.ray import RaySimulation

            yield RaySimulation(count)
        case "flower":
            with open_deployment(clients, fleet, vehicles) as deployed:
                yield deployed
        case _:
            raise InputError(f"runtime '{name}': choose one of {', '.join(RUNTIMES)}{suggest(name, RUNTIMES)}")


@contextlib.contextmanager
def open_deployment(
    clients: Collection[str], fleet: Path | None, vehicles: Mapping[str, int]
) -> Iterator["RegionalDeployment"]:
    """Yield the vehicles of a deployed `fleet` for clients, or of one that is brought up, see `open_runtime`."""
    from flcav.federation.links.flower import RegionalDeployment, region_of, start_fleet

    if fleet is not None:
        yield RegionalDeployment(fleet, vehicles)
    else:
        with start_fleet(len(clients)) as deployment:
            yield RegionalDeployment(deployment.folder, Counter(map(region_of, clients)))
