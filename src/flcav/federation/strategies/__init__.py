"""Strategies by name: aggregation of the clients' updates, and corrections of their training; or a user's strategy."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass

from pydantic import TypeAdapter, ValidationError

from flcav.config import InputError, Json, shorten
from flcav.federation.strategies.corrections import FedProx, Scaffold
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.fedbuff import FedBuff
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.strategies.fedopt import FedAdam, FedAvgM, FedYogi
from flcav.federation.strategies.robust import Krum, Median, TrimmedMean
from flcav.federation.strategies.strategy import Corrects, Exchanges, Strategy
from flcav.plugins import load_named

STRATEGIES: dict[str, type[Strategy]] = {
    "fedavg": FedAvg,
    "fedprox": FedProx,
    "fedavgm": FedAvgM,
    "fedadam": FedAdam,
    "fedyogi": FedYogi,
    "scaffold": Scaffold,
    "fedmd": FedMD,
    "fedbuff": FedBuff,
    "median": Median,
    "trimmed-mean": TrimmedMean,
    "krum": Krum,
}
FEDAVG = FedAvg()  # the default everywhere

Spec = str | Mapping[str, Mapping[str, Json]]  # a name, or a name with settings: {fedprox: {mu: 0.1}}


def strategy_named(spec: Spec) -> Strategy:
    """Return a strategy by its name: one of `STRATEGIES`, or a user's strategy, `module:NAME`.

    Settings that `spec` does not give are the strategy's defaults. Raises `InputError` for an unknown name, where the
    user's module cannot be imported or has no strategy of that name, where the strategy is no dataclass, for a setting
    that it does not have, and for one with an impossible value.

    >>> from flcav.federation import strategy_named
    >>> strategy_named({"fedavgm": {"momentum": 0.5}})
    FedAvgM(rate=1.0, momentum=0.5)
    """
    if not isinstance(spec, str) and len(spec) != 1:
        raise InputError(f"strategy {shorten(dict(spec))}: one name is wanted, with its settings")
    name, settings = (spec, {}) if isinstance(spec, str) else next(iter(spec.items()))
    found: Strategy = load_named("strategy", name, STRATEGIES, Strategy)
    if not is_dataclass(found):
        raise InputError(f"strategy '{name}': is no dataclass, so that its settings are not known")
    if not settings:
        return found
    known = [field.name for field in fields(found)]
    if odd := [setting for setting in settings if setting not in known]:
        raise InputError(f"strategy '{name}': has no setting '{odd[0]}'; it has {', '.join(known) or 'none'}")
    try:
        return TypeAdapter(type(found)).validate_python({**vars(found), **settings})
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(f"strategy '{name}': {field} = {shorten(first['input'])}: {first['msg']}") from None


def exchanges_more(spec: Spec) -> bool:
    """Return whether clients of one of `STRATEGIES` send a further array with every learned one, as SCAFFOLD's do.

    A user's strategy is not imported to find out.
    """
    name = spec if isinstance(spec, str) else next(iter(spec), "")
    return name in STRATEGIES and issubclass(STRATEGIES[name], Exchanges)


def sends_outputs(spec: Spec) -> bool:
    """Return whether clients of one of `STRATEGIES` send probabilities instead of weights; see `exchanges_more`."""
    name = spec if isinstance(spec, str) else next(iter(spec), "")
    return name in STRATEGIES and issubclass(STRATEGIES[name], FedMD)


def fills_buffers(spec: Spec) -> bool:
    """Return whether rounds of one of `STRATEGIES` are buffers filled by a clock; see `exchanges_more`."""
    name = spec if isinstance(spec, str) else next(iter(spec), "")
    return name in STRATEGIES and issubclass(STRATEGIES[name], FedBuff)


def of_servers(strategy: Strategy) -> Strategy:
    """Return the strategy among edge servers in the cloud's rounds, where `strategy` is that among vehicles.

    It is the same one, or FedAvg where the strategy only suits vehicles: edge servers take no local steps whose
    gradients could be corrected, share no samples, and the cloud waits for all of them.
    """
    return FEDAVG if isinstance(strategy, Corrects | FedMD | FedBuff) else strategy
