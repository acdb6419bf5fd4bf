"""Links from a federation's server to its clients, by runtime: this process, client processes, Ray, or a fleet.

A link applies the outages of the network, checks the budget before a message leaves, and enters it in the ledger.
Questions outside training use it, too; the caller enters the counted answers in the ledger.
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
NOTHING: Weights = {}  # arrays of a question without any
UNREADABLE = "an answer that cannot be read"  # reason of a missing answer
# where clients train, and how messages reach them
Runtime = Union[ClientProcesses, "RaySimulation", "Deployment", "RegionalDeployment", "PartlyDeployed", "RosTopics"]


@dataclass(frozen=True)
class Replies:
    """The answers of clients to a question."""

    answers: Mapping[str, Weights]  # by client
    missing: Mapping[str, str]  # reason by client without an answer


class Ask(Protocol):
    """A function that asks clients a question."""

    def __call__(
        self, question: str, clients: Sequence[str], arrays: Weights = NOTHING, *, counted: bool = True
    ) -> Replies:
        """Return the replies of `clients`, in their order, to a question with `arrays`.

        A deployed client withholds a `counted` answer over the budget, which raises `BudgetExceeded`.
        """
        ...


@dataclass(frozen=True)
class Link:
    """A server's end of the link to its clients."""

    grid: Grid
    names: Mapping[int, str]  # of the clients, by node
    ask: Ask
    read_states: ReadStates  # reads the client states
    follow: Callable[[RoundRecord], None] = lambda _: None  # called with the record of every completed round
    authority: x509.Certificate | None = None  # of the clients' certificates; None: they are not certified


@contextlib.contextmanager
def open_link(
    clients: Mapping[str, Trainable],
    runtime: Runtime | None,
    account: Account,
    agreed: ClientAgreement,
    states: ClientStates,
) -> Iterator[Link]:
    """Yield the link to `clients`, whose messages are metered and lost by `account`.

    Args:
        clients: by name.
        runtime: where they train; None: in this process.
        account: ledger and outages of the link.
        agreed: strategy, rules and secrets of the federation.
        states: client states from earlier rounds.
    """
    make_app = partial(client_app, **vars(agreed))
    rules = agreed.rules
    limit_s = rules.limits.train_s
    names = [*clients]
    far = False
    if runtime is None:
        opened = EmbeddedGrid(make_app(limit_time(clients, limit_s)), names, states)
    elif isinstance(runtime, ClientProcesses):
        opened = EmbeddedGrid(make_app(train_remotely(clients, runtime, limit_s)), names, states, runtime.count)
    elif runtime.deployed is True:
        check_deployable(rules)
        opened = runtime.open(clients, agreed, states, account)
        far = True
    else:
        opened = runtime.open(clients, lambda each: make_app(limit_time(each, limit_s), simulated=True), states)
    with opened as inner:
        metered = MeteredGrid(inner, account, inner.names)
        follow = getattr(inner, "follow", lambda _: None)
        ask = partial(_ask_there, inner, inner.names) if far else partial(_ask_here, clients)
        yield Link(metered, inner.names, ask, inner.read_states, follow, getattr(inner, "authority", None))


def check_deployable(rules: Rules) -> None:
    """Raise `InputError` where deployed clients cannot follow the rules.

    The state of an optimiser reveals gradients on a vehicle's data, so that it must not leave the vehicle; but the
    server's checkpoint would need it to resume.
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
    """Yield a function that asks clients outside the rounds of a federation, in this process or `deployed`.

    The answers of deployed clients are limited by the budget of `account`.
    """
    if deployed is None or not clients:
        yield partial(_ask_here, clients)
        return
    with open_link(clients, deployed, account, ClientAgreement(FEDAVG, Rules(), {}, 0), {}) as link:
        yield link.ask


def _ask_here(
    local: Mapping[str, Trainable],
    question: str,
    clients: Sequence[str],
    arrays: Weights = NOTHING,
    *,
    counted: bool = True,
) -> Replies:
    return Replies({name: answer_question(local[name], question, arrays) for name in clients}, {})


def _ask_there(
    grid: Grid,
    names: Mapping[int, str],
    question: str,
    clients: Sequence[str],
    arrays: Weights = NOTHING,
    *,
    counted: bool = True,
) -> Replies:
    nodes = {name: node for node, name in names.items()}
    records = {ASK: ConfigRecord({ASK: question})}
    content = RecordDict({**records, **({ARRAYS: to_array_record(arrays)} if arrays else {})})
    if counted:
        content[GRANT] = ConfigRecord()  # the grid fills it in when it sends the request
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
    """Yield `count` client processes; None, for this process, where `count` is 1 or `clients` cannot be pickled."""
    try:
        opened = ClientProcesses(clients, count) if count > 1 else None
    except InputError:
        opened = None
    with opened or contextlib.nullcontext() as processes:
        yield processes


@contextlib.contextmanager
def open_runtime(
    name: str,
    clients: Mapping[str, Trainable],
    count: int,
    fleet: Path | None = None,
    vehicles: Mapping[str, int] = {},
) -> Iterator[Runtime | None]:
    """Yield the `runtime` of `federate` for the clients of one or of several regions.

    embedded: messages within this process, and clients in `count` processes if these are several. ray: Flower's
    simulation with `count` actors. flower: vehicles of the running fleet in the folder `fleet`, with their number per
    region in `vehicles` (see `RegionalDeployment`), or of a temporary fleet on this machine. Raises `InputError` for
    another name.
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
    """Yield the vehicles of a deployed or a temporary fleet for clients, see `open_runtime`."""
    from flcav.federation.links.flower import RegionalDeployment, region_of, start_fleet

    if fleet is not None:
        yield RegionalDeployment(fleet, vehicles)
    else:
        with start_fleet(len(clients)) as deployment:
            yield RegionalDeployment(deployment.folder, Counter(map(region_of, clients)))
