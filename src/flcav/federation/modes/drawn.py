"""Rounds of sampled clients, with updates weighted by inverse probability, so that their mean is unbiased."""

from functools import partial

from flwr.app import ConfigRecord, RecordDict

from flcav.federation.acceptance import read_norm, read_update
from flcav.federation.exchange import Exchange, Intake, OpenRound
from flcav.federation.strategies.fedavg import average_inversely
from flcav.federation.wire import ASK, CONFIG, COUNT, NORM, SEND


def collect(exchange: Exchange, round_: OpenRound) -> Intake:
    """Return the accepted updates of the sampled clients, and their Horvitz-Thompson mean.

    Under importance selection all clients train and report the norm of their update; clients are sampled by it and then
    send that update. Under other unbiased selections all clients report their number of samples before the chosen ones
    train. No update is requested where fewer clients take part than the rules need.
    """
    here, rules, work = round_.here, round_.rules, round_.work
    unbiased = rules.selection.unbiased
    local = RecordDict({CONFIG: work.record()})
    first = RecordDict({**local}) if unbiased else round_.training()
    first[ASK] = ConfigRecord({ASK: COUNT if unbiased else NORM})
    requests = dict.fromkeys(here.asked if unbiased else here.chosen, first)
    reports = dict(exchange.ask(here, requests, lambda _, content: read_norm(content, rules)))  # norm and samples
    total = max(sum(samples for _, samples in reports.values()), 1)
    shares = {name: samples / total for name, (_, samples) in reports.items()}
    norms: dict[str, float] = {}  # upper bounds of the updates sent later
    if unbiased:
        probability = rules.selection.inclusion_probability(len(here.asked))
        drawn = {name: probability for name in here.chosen if name in shares}
        request = round_.training()
    else:
        norms = {name: norm for name, (norm, _) in reports.items()}
        drawn = rules.selection.draw({name: norm * shares[name] for name, norm in norms.items()}, work.seed)
        here.chosen = [*drawn]
        request = RecordDict({ASK: ConfigRecord({ASK: SEND}), **local})
    if not here.count(rules):
        return Intake()
    updates = Intake()
    read = lambda name, content: read_update(content, round_.expected, norms.get(name))  # noqa: E731
    for name, update in exchange.ask(here, dict.fromkeys(drawn, request), read):
        updates.add(name, update)
    if updates.updates:
        weights = {name: shares[name] / drawn[name] for name in updates.updates}
        updates.average = partial(average_inversely, round_.start, updates.updates, weights)
    return updates
