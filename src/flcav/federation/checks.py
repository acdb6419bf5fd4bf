"""Consistency checks of a federation's settings: which strategies, rules and clients go together."""

import inspect
from collections.abc import Iterable, Mapping, Sequence

from flcav.config import InputError
from flcav.federation.rules import RegionalModels, Rules, SecureAggregation
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.strategy import Corrects, Exchanges, Robust, needs_known_number
from flcav.federation.trainable import Counts, Trainable


def check_federation(clients: Mapping[str, Trainable], strategy: Strategy, rules: Rules) -> None:
    """Raise `InputError` where clients, strategy and rules do not go together."""
    if not clients:
        raise InputError("a federation of 0 clients: nobody trains")
    if rules.selection.predicts:
        raise InputError("selection: a deadline needs 'seconds', the predicted time of a round by client")
    check_rules(strategy, rules, [*clients])
    if isinstance(strategy, Corrects):
        check_arguments(clients, strategy.correct({}, {}).arguments(), type(strategy).__name__)
    if isinstance(strategy, FedMD):
        check_arguments(clients, ["own", "imitation_steps"], "FedMD")
    if rules.upload.layers:
        check_arguments(clients, ["layers"], f"layers {', '.join(rules.upload.layers)}:")
    if rules.keep_optimiser:
        check_arguments(clients, ["optimiser"], "keep_optimiser:")
    if rules.selection.unbiased:
        for name, client in clients.items():
            if not isinstance(client, Counts):
                lacking = f"and {name} ({type(client).__name__}) has no 'count_samples'"
                raise InputError(f"selection: unbiased weights need clients that count their samples, {lacking}")
    if isinstance(rules.personal, RegionalModels):
        check_arguments(clients, ["proximal", "centre"], "personal:")


def check_arguments(trainables: Mapping[str, Trainable], wanted: Iterable[str], why: str) -> None:
    """Raise `InputError` where a client's `train` lacks an argument of `wanted`; the message starts with `why`."""
    for name, trainable in trainables.items():
        known = inspect.signature(trainable.train).parameters
        if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in known.values()):
            continue
        if lacking := [argument for argument in wanted if argument not in known]:
            raise InputError(
                f"{why} needs clients whose training takes '{lacking[0]}', and that of {name} "
                f"({type(trainable).__name__}) does not"
            )


def check_rules(strategy: Strategy, rules: Rules, names: Sequence[str]) -> None:
    """Raise `InputError` where a strategy and rules do not go together, or not with so many clients."""
    named = type(strategy).__name__
    selection = rules.selection
    selection.check_clients(names)
    planned = selection.rule == "planned"
    any_number = planned or selection.rule in ("poisson", "importance")  # at most all; with too few there is no update
    chosen = len(names) if any_number else len(selection.choose(names, 1, 0))
    if short := rules.tell_shortage(chosen):
        raise InputError(short)
    single = isinstance(strategy, Robust | Exchanges)  # needs the updates one by one
    if selection.weighs:
        if single:
            kind = "unbiased" if selection.unbiased else "importance"
            raise InputError(f"{named} looks at each update, and {kind} selection gives each a weight of its own")
        if rules.privacy is not None and selection.rule == "importance":
            raise InputError("privacy: importance selection reads norms of the updates, which no noise covers")
    if selection.unbiased and (alike := _count_alike(strategy, rules)):
        raise InputError(f"selection: {alike} has clients count the same, and 'unbiased' weighs them by samples")
    if rules.privacy is not None and rules.privacy.amplified(selection) and isinstance(rules.least_clients, int):
        raise InputError(
            f"privacy: epsilon of {selection.rule} selection rests on secret draws, and rounds without an update for a "
            "number of 'least_clients' would reveal them"
        )
    if rules.hides_draws and rules.empty_rounds is not None:
        raise InputError("privacy: epsilon rests on secret draws, and an end after 'empty_rounds' would reveal them")
    if isinstance(strategy, FedMD):
        _check_outputs(rules)
    if isinstance(strategy, FedBuff):
        _check_buffers(strategy, rules, len(names))
    if isinstance(rules.personal, RegionalModels) and isinstance(strategy, Corrects):
        raise InputError(f"{named} corrects local steps, and so does the pull of regional models, 'personal'")
    if rules.privacy is not None and planned:
        raise InputError("privacy: rounds of a plan have other numbers of clients, and noise is for one number")
    if isinstance(strategy, Robust):
        if selection.rule not in ("poisson", "planned"):
            strategy.check_clients(chosen)
        elif needs_known_number(strategy):
            raise InputError(f"{named} needs a known number of clients, and {selection.rule} selection has any")
    if rules.secure is not None:
        _check_secure(named, rules, rules.secure, chosen, single)
    if rules.privacy is not None:
        if isinstance(strategy, Exchanges):
            raise InputError(f"{named} sends further arrays beside the weights, which the noise does not cover")
        if rules.privacy.where == "central" and single:
            raise InputError(f"{named} looks at each update, and central noise covers their sum alone")


def _count_alike(strategy: Strategy, rules: Rules) -> str | None:
    """Return the setting that weights all clients equally, whatever their samples; None where there is none."""
    alike = {"FedMD": isinstance(strategy, FedMD), "privacy": rules.privacy, "secure aggregation": rules.secure}
    return next((name for name, there in alike.items() if there), None)


def _check_outputs(rules: Rules) -> None:
    if rules.download != "none":
        raise InputError("FedMD sends class probabilities, and 'download' is a form of weights")
    if rules.upload.layers:
        raise InputError("FedMD sends class probabilities, and 'upload.layers' names arrays of weights")
    if isinstance(rules.personal, RegionalModels):
        raise InputError("FedMD's vehicles have networks of their own, which regional models, 'personal', cannot pull")
    if rules.privacy is not None:
        raise InputError("FedMD sends class probabilities, and noise is for changes of weights")
    if rules.keep_optimiser:
        raise InputError("FedMD's vehicles train towards two goals in turn; 'keep_optimiser' is for one")


def _check_buffers(strategy: FedBuff, rules: Rules, clients: int) -> None:
    strategy.check_buffer(clients)
    if rules.download != "none":
        raise InputError("FedBuff: clients begin with models of several rounds, which 'download' does not compress")
    if rules.selection.rule != "all":
        raise InputError(f"FedBuff: all clients train, at their own pace, and {rules.selection.rule} selects some")
    if rules.secure is not None:
        raise InputError("FedBuff: masks cancel in a round that all begin together, and clients of a buffer do not")
    if isinstance(rules.least_clients, int) and rules.least_clients > strategy.buffer:
        raise InputError(f"FedBuff: least_clients {rules.least_clients}, and a buffer has {strategy.buffer} updates")
    if isinstance(rules.personal, RegionalModels):
        raise InputError("FedBuff: regional models, 'personal', are pulled to the cloud's round by round")
    if rules.privacy is not None and rules.privacy.noise is None:
        raise InputError("FedBuff: how often a client takes part is known with the clock alone; give 'privacy.noise'")


def _check_secure(strategy: str, rules: Rules, secure: SecureAggregation, chosen: int, single: bool) -> None:
    needed = secure.needed(chosen)
    if single:
        raise InputError(f"{strategy} looks at each update, and secure aggregation shows their sum alone")
    if rules.selection.rule in ("poisson", "importance"):
        raise InputError(f"secure aggregation needs a known number of clients, and {rules.selection.rule} draws any")
    if rules.upload.compression != "none":
        raise InputError(f"secure aggregation sums integers of 32 bits, and {rules.upload.compression} sends others")
    if rules.privacy is not None and rules.privacy.where == "central":
        raise InputError("secure aggregation goes with local noise: a server that adds noise clips each update first")
    if not max(chosen / 2, 1) < needed <= chosen:
        raise InputError(
            f"secure.threshold: more than half of the {chosen} clients of a round, 2 or more, and not {needed}"
        )
