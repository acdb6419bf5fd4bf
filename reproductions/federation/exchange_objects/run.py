"""Comparison of exchanges for the object detector SECOND: `federation/exchange` with another recipe."""

from functools import partial

from flcav.experiments.experiment import Experiment
from flcav.reproductions.federation.exchange.run import ExchangeResult, run_exchange, tables

EXPERIMENT = Experiment(
    ExchangeResult, partial(run_exchange, "exchange_objects"), tables, seeds=5, recipe="exchange_objects"
)
