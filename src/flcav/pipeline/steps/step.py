"""One unit of an experiment's work, and what it is given."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from flcav.pipeline.steps.record import digest, value_of
from flcav.progress import Report

Notify = Callable[[str, int, int, str], None]  # step, done, total, note
DONE_NOW, DONE_BEFORE, KEPT = FINISHED = ("done", "done before", "kept, of other code")  # notes of finished steps


@dataclass(frozen=True)
class Work:
    """What a step is given."""

    folder: Path  # its own
    inputs: Mapping[str, Path]  # folders of the steps it needs
    report: Report  # to be called where what is in its folder can be gone on from

    def result(self, step: str) -> Any:
        """Return the value of a step that this one needs."""
        return value_of(self.inputs[step])


@dataclass(frozen=True)
class Step:
    """One unit of work: a module-level function of (Work, **arguments) that returns a JSON value."""

    name: str
    run: Callable[..., Any]
    arguments: Mapping[str, Any]  # JSON values, and frozen dataclasses of them
    needs: tuple[str, ...] = ()

    def fingerprint(self, inputs: Mapping[str, str]) -> str:
        """Return what identifies what is asked of this step: its function, arguments and what it is built on."""
        asked = [self.run.__module__, self.run.__qualname__, self.arguments, {n: inputs[n] for n in self.needs}]
        return digest(asked, default=_named)


def _named(value: Any) -> list[Any]:
    """Return what identifies a record among a step's arguments: its class and its fields."""
    if not is_dataclass(value):
        raise TypeError(f"{value!r} cannot be a step's argument: it is neither a JSON value nor a dataclass of them")
    return [type(value).__module__, type(value).__qualname__, {f.name: getattr(value, f.name) for f in fields(value)}]
