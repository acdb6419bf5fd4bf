"""What is refused about the options of any command: numbers that are none, and options that would have no effect."""

import math

import click
from click.core import ParameterSource

from flcav.config import InputError


def finite(parameter: click.Parameter, value: float | None) -> float | None:
    """Return the value of an option, as its callback; raises `InputError` for nan, which lies within any limits."""
    if value is not None and not math.isfinite(value):
        raise InputError(f"{parameter.opts[0]} {value}: a finite number is wanted")
    return value


def refuse_unused(what: str, *names: str) -> None:
    """Raise `InputError` where one of the options of these parameters was given, for which `what` has no use."""
    context = click.get_current_context()
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is ParameterSource.COMMANDLINE:
            raise InputError(f"{what}: has no use for {parameter.opts[0]}")
