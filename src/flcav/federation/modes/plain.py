"""Plain rounds: clients train and send their updates, which a strategy combines."""

import contextlib
from collections.abc import Iterator

from flcav.config import InputError
from flcav.federation.acceptance import read_update
from flcav.federation.exchange import Exchange, Intake, OpenRound
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import NoShares
from flcav.federation.strategies.strategy import find_weigher


def collect(exchange: Exchange, round_: OpenRound, strategy: Strategy) -> Intake:
    """Return the accepted updates of the chosen clients, or their running mean where that is enough for `strategy`.

    No client is asked where fewer take part than the rules need. Central noise needs every update, to clip it. Raises
    `InputError` where the strategy cannot average the updates, `NoShares` where all their weights are 0.
    """
    here = round_.here
    if not here.count(round_.rules):
        return Intake()
    updates = Intake(find_weigher(strategy) if round_.rules.privacy is None else None)
    requests = dict.fromkeys(here.chosen, round_.training())
    for name, update in exchange.ask(here, requests, lambda _, content: read_update(content, round_.expected)):
        with refusing(strategy, round_.work.round):
            updates.add(name, update)
    return updates


@contextlib.contextmanager
def refusing(strategy: Strategy, number: int) -> Iterator[None]:
    """Turn the ValueError of a strategy that cannot combine a round's updates into `InputError`; pass on `NoShares`."""
    try:
        yield
    except NoShares:
        raise
    except ValueError as error:
        raise InputError(f"strategy {type(strategy).__name__}, round {number}: {error}") from error
