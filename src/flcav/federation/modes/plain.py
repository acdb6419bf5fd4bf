"""Plain rounds: those who take part train and send their updates, which a strategy combines."""

import contextlib
from collections.abc import Iterator

from flcav.config import InputError
from flcav.federation.acceptance import read_update
from flcav.federation.exchange import Exchange, Intake, OpenRound
from flcav.federation.strategies import Strategy
from flcav.federation.strategies.fedavg import NoShares
from flcav.federation.strategies.strategy import find_weigher


def collect(exchange: Exchange, round_: OpenRound, strategy: Strategy) -> Intake:
    """Return the updates that count of those who are chosen, or their running mean where `strategy` needs no more.

    Where fewer take part than the rules want nobody is asked. Central noise is for every update, clipped. Raises
    `InputError` where the strategy cannot average what clients sent, `NoShares` where it gives none a weight.
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
    """Raise `InputError` where a strategy cannot combine the updates of a round; `NoShares` as it is."""
    try:
        yield
    except NoShares:
        raise
    except ValueError as error:
        raise InputError(f"strategy {type(strategy).__name__}, round {number}: {error}") from error
