"""A step of a workflow, the context it runs in, and the record of its execution on disk.

The record states what was computed (function, arguments, inputs), which decides whether a folder is the right one, and
by which code, which decides whether its result still holds.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from flcav.config import SHOWN, Config, InputError, Json, read_json, shorten
from flcav.interface.progress import Report, print_progress
from flcav.interface.wording import plural
from flcav.storage.files import flush_tree, write_json
from flcav.storage.records import flatten_record

Notify = Callable[[str, int, int, str], None]  # step, done, total, note
DONE_NOW, DONE_BEFORE, KEPT = FINISHED = ("done", "done before", "kept, of other code")  # notes of finished steps
WHOLE = ""  # in place of a step: how many of all steps are finished, with the time left as note
DONE, STARTED = "done.json", "started.json"
Stale = str  # one of STALE
STALE = ("refuse", "redo", "keep")  # what to do with steps of other code; "redo": of other arguments, too
NAMED = 3  # most steps, or modules, that a message lists


def print_steps(step: str, done: int, total: int, note: str) -> None:
    """Report finished steps on stderr if it is a terminal: the default `Notify` of Python programs."""
    if note in FINISHED:
        print_progress(1, 1, f"{step} {note}")


def ignore_steps(step: str, done: int, total: int, note: str) -> None:
    """Report nothing: the `Notify` without a display."""


@dataclass(frozen=True)
class Work:
    """The context that a step runs in."""

    folder: Path  # of the step
    inputs: Mapping[str, Path]  # folders of the steps it needs
    report: Report  # to be called when the folder's files are a checkpoint

    def result(self, step: str) -> Any:
        """Return the value of the finished step `step`, one that this step needs."""
        return read_value(self.inputs[step])


@dataclass(frozen=True)
class Step:
    """One unit of work: a module-level function of (Work, **arguments) that returns a JSON value."""

    name: str
    run: Callable[..., Any]
    arguments: Mapping[str, Any]  # JSON values, and frozen records of them: dataclasses or `Config`
    needs: tuple[str, ...] = ()
    means: Mapping[str, int | str] = field(default_factory=dict)  # further arguments, which do not change the result
    workers: int = 1  # most that it can make use of; where several, it takes how many they are as `processes`

    def on(self, workers: int) -> "Step":
        """Return the step to be run by so many workers."""
        return self if workers == 1 else replace(self, means={**self.means, "processes": workers})

    @property
    def asked(self) -> dict[str, Json]:
        """The arguments as JSON values by dotted name, to report in which of them two steps differ."""
        values = json.loads(json.dumps(self.arguments, default=_fields))
        return {name.removeprefix("settings.").removeprefix("recipe."): value for name, value in flatten_record(values)}

    def fingerprint(self, inputs: Mapping[str, str]) -> str:
        """Return the hash of function, arguments, and fingerprints of the needed steps (`inputs`).

        Raises `TypeError` for an argument that is neither a JSON value nor a record of them.
        """
        identity = [self.run.__module__, self.run.__qualname__, self.arguments, {n: inputs[n] for n in self.needs}]
        return digest(identity, default=_named)


def _named(value: Any) -> list[Any]:
    """Return the identity of a record among a step's arguments as JSON: its class and its fields."""
    return [type(value).__module__, type(value).__qualname__, _fields(value)]


def _fields(value: Any) -> dict[str, Any]:
    """Return the fields of a record among a step's arguments."""
    if isinstance(value, Config):
        return value.model_dump(mode="json")
    if is_dataclass(value):
        return {member.name: getattr(value, member.name) for member in fields(value)}
    raise TypeError(f"{value!r} cannot be a step's argument: it is neither a JSON value nor a record of them")


@dataclass(frozen=True)
class StepRecord:
    """The record of a step's execution: hashes of what was asked and of the code that did it."""

    fingerprint: str  # see `Step.fingerprint`
    code: Mapping[str, str]  # hash of the code it reaches, by module: see `engine.source_hash`
    lineage: str  # of its code and of the lineages of the steps it needs; "" where the code is not known
    asked: Mapping[str, Json] | None = field(default=None, compare=False)  # see `Step.asked`; None: not recorded

    @classmethod
    def of(
        cls,
        fingerprint: str,
        code: Mapping[str, str],
        needs: Iterable["StepRecord"],
        asked: Mapping[str, Json] | None = None,
    ) -> "StepRecord":
        """Return the record of a step done by `code`, where the steps it needs have the records `needs`."""
        return cls(fingerprint, code, digest([sorted(code.items()), *(need.lineage for need in needs)]), asked)


def digest(value: Any, **how: Any) -> str:
    """Return the first 16 digits of the SHA-256 of a JSON value, in hexadecimal; `how`: options of `json.dumps`."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, **how).encode()).hexdigest()[:16]


def read_record(folder: Path) -> StepRecord | None:
    """Read the record of a finished step in `folder`, or of one that was begun; None where it was neither.

    Without recorded code, `code` is empty and `lineage` is "". If the record of the finished step is damaged, the one
    written at its start is returned. Raises `InputError` for a file that is not a record.
    """
    for path in (folder / DONE, folder / STARTED):
        if path.exists():
            if path.name == DONE and (folder / STARTED).exists() and find_damage(folder) == DONE:
                continue
            values: Any = read_json(path)
            if not isinstance(values, dict) or not isinstance(values.get("fingerprint"), str):
                raise InputError(f"{path}: not the record of a step; choose another folder")
            known = (values["fingerprint"], values.get("code") or {}, values.get("lineage") or "")
            return StepRecord(*known, values.get("asked"))
    return None


def read_value(folder: Path) -> Any:
    """Read the value of the finished step in `folder`."""
    return json.loads((folder / DONE).read_text())["value"]


def write_started(folder: Path, record: StepRecord) -> None:
    """Write the record of the step that begins in `folder`."""
    write_json(folder / STARTED, asdict(record))


def write_done(folder: Path, record: StepRecord, value: Any, provenance: Mapping[str, Any]) -> None:
    """Mark the step in `folder` as finished: write its record, value, provenance, and the sizes of its files.

    Its files are flushed to disk first, so that no crash leaves a finished step with missing bytes.
    """
    flush_tree(folder)
    files = {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != STARTED and not path.name.startswith(".")
    }
    write_json(folder / DONE, asdict(record) | {"value": value, "files": files, "provenance": provenance})


def find_damage(folder: Path) -> str | None:
    """Return the name of a file of a finished step that is missing or has another size; None if all are intact.

    A record that cannot be read counts as damaged. For a step that was finished before sizes were recorded, only the
    record is checked.
    """
    try:
        done: Any = read_json(folder / DONE)
    except InputError:
        return DONE
    if not isinstance(done, dict) or not {"fingerprint", "value"} <= done.keys():
        return DONE
    for name, size in done.get("files", {}).items():
        if not (folder / name).is_file() or (folder / name).stat().st_size != size:
            return name
    return None


def changed_modules(held: StepRecord, wanted: StepRecord) -> list[str]:
    """Return the modules whose reached code differs between two records; none where `held` has no recorded code."""
    if not held.code:
        return []
    return [name for name in sorted({*held.code, *wanted.code}) if held.code.get(name) != wanted.code.get(name)]


def make_stale_error(folder: Path, outdated: Mapping[str, tuple[StepRecord, StepRecord]]) -> InputError:
    """Return the error for a folder whose steps were run by other code; `outdated`: records (held, wanted) by step."""
    moved = [name for name, (held, wanted) in outdated.items() if held.fingerprint != wanted.fingerprint]
    modules = {name: changed_modules(*records) for name, records in outdated.items()}
    unknown = [name for name, (held, _) in outdated.items() if not held.code]
    changed = [name for name in outdated if modules[name] and name not in moved]
    after = [name for name in outdated if name not in unknown and name not in (*changed, *moved)]
    which = sorted({module for name in changed for module in modules[name]})
    causes = [
        f"{_some(moved)} by an earlier flcav, whose steps have moved since" if moved else "",
        f"{_some(changed)} by other code ({_some(which)} changed)" if changed else "",
        f"{_some(unknown)} by code that was not recorded" if unknown else "",
        f"{_some(after)} on top of other code" if after else "",
    ]
    return InputError(
        f"{folder}: did {', '.join(filter(None, causes))}; choose another folder, or --stale redo to do that again, or "
        "--stale keep to take it as it is"
    )


def make_edited_error(
    folder: Path, edited: Mapping[str, tuple[StepRecord, StepRecord]], steps: Sequence[Step]
) -> InputError:
    """Return the error for a folder in which some `steps` had other arguments; `edited`: records (held, wanted)."""
    changes: dict[str, list[str]] = {}  # steps by how their arguments differ
    after = []
    for step in steps:
        if step.name in edited:
            differences = describe_changes(*edited[step.name])
            if not differences and any(name in edited for name in step.needs):
                after.append(step.name)
            else:
                changes.setdefault(_some(differences), []).append(step.name)
    reasons = [
        f"{_some(names)} by another configuration{f' ({fields})' if fields else ''}"
        for fields, names in changes.items()
    ]
    reasons += [f"{_some(after)} on top of that"] if after else []
    return InputError(
        f"{folder}: did {'; '.join(reasons)}; choose another folder, or --stale redo to do that again and keep "
        f"{plural(len(steps) - len(edited), 'other step')}"
    )


def asks_the_same(held: StepRecord, wanted: Mapping[str, Json]) -> bool:
    """Return whether two steps have the same arguments; a missing argument equals None."""
    given, expected = (
        {name: value for name, value in (arguments or {}).items() if value is not None}
        for arguments in (held.asked, wanted)
    )
    return held.asked is not None and given == expected


def describe_changes(held: StepRecord, wanted: StepRecord) -> list[str]:
    """Return the changed arguments of a step, in words; empty if the earlier ones were not recorded."""
    if held.asked is None or wanted.asked is None:
        return []
    names = [*dict.fromkeys((*wanted.asked, *held.asked))]
    pairs = {name: (wanted.asked.get(name), held.asked.get(name)) for name in names}
    return [f"{name}: {_said(new)}, was {_said(old)}" for name, (new, old) in pairs.items() if new != old]


def _said(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= SHOWN else shorten(text)


def _some(names: Sequence[str]) -> str:
    """Return the first `NAMED` names as text, and the number of others."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def take_over(folder: Path, record: StepRecord, others: Iterable[Path]) -> bool:
    """Link a finished step with the same record from one of the folders `others` to `folder`; False if there is none.

    Files are hard-linked, not copied, and the folder appears atomically. A step that has begun is left alone.
    """
    for other in () if folder.exists() else others:
        if (other / DONE).exists() and read_record(other) == record:
            copy = reserve_sibling(folder, "copy")
            shutil.copytree(other, copy, copy_function=os.link)
            copy.rename(folder)
            return True
    return False


def remove(folder: Path) -> None:
    """Remove a step's folder, or the link to it; the folder is renamed first, so that it disappears atomically."""
    if folder.is_symlink():
        folder.unlink()
        return
    old = reserve_sibling(folder, "old")
    if folder.exists():
        folder.rename(old)
    shutil.rmtree(old, ignore_errors=True)


def reserve_sibling(folder: Path, what: str) -> Path:
    """Return an unused hidden path next to a step's folder, after removing leftovers of an interrupted run."""
    path = folder.with_name(f".{folder.name}.{what}")
    shutil.rmtree(path, ignore_errors=True)
    return path
