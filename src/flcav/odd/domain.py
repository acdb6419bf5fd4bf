"""Operational design domains (ODD) in ASAM OpenODD 1.0, read by openodd-py with the binding of flcav.

A domain is one of `DOMAINS` or a user's OpenODD file. openodd-py would import code that a binding names
("module:function") and fetch imports from git; in users' files both are refused before the library reads them.
"""

import logging
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

from openodd import (
    UNDECIDED,
    Backend,
    GitSourceError,
    OddDefinition,
    OddKnob,
    OpenOddError,
    UnitError,
    knobs_from_mapping,
    load_openodd,
)

from flcav.config import InputError, path_within, read_yaml, shorten
from flcav.interface.wording import suggest
from flcav.odd.ranges import has_ranges, rewrite_ranges

logging.getLogger("openodd").setLevel(logging.ERROR)  # commands report what matters of its warnings

FOLDER = Path(__file__).parent / "domains"
TAXONOMY, BINDING = FOLDER / "taxonomy.yaml", FOLDER / "binding.yaml"
DOMAINS = ("urban", "rural", "campus", "mine", "port", "parking_lot")
MOST_BYTES, MOST_FILES = 1_000_000, 20
REFUSED = {  # keys of users' files
    "git": "it names a git source to fetch",
    "probe": "it brings a binding, which may name code to import",
    "probes": "it brings a binding, which may name code to import",
    "measure": "it brings a binding, which may name code to import",
    "openodd": "it brings a binding, which may name code to import",
}
MEANT = {  # common words for domains in concepts of flcav's taxonomy
    **dict.fromkeys(("urban", "city", "suburban", "town"), "drivable_area_type: [distributor_road, minor_road]"),
    "residential": "drivable_area_type: [minor_road]",
    "rural": "drivable_area_type: [radial_road, distributor_road]",
    **dict.fromkeys(("highway", "freeway"), "drivable_area_type: [motorway]"),
    "intersection": "junction: [t_junction, crossroad]",
    "dark": "light: [night]",
    "rain": 'rainfall: "> 0 mm/h"',
    "fog": 'visibility: "<= 400 m"',
}

Value = float | str | None  # of an attribute; None if missing


@dataclass(frozen=True)
class Domain:
    """An operational design domain, with flcav's binding of its concepts."""

    name: str
    definition: OddDefinition
    bound: Mapping[str, str]  # attribute -> column of `flcav.odd.measure` that measures it
    tested: tuple[str, ...]  # attributes in the conditions of its modules
    limits: Mapping[str, tuple[float, ...]]  # thresholds of the conditions on an attribute, ascending
    backend: Backend

    @property
    def unbound(self) -> tuple[str, ...]:
        """Return the tested attributes that nothing measures."""
        return tuple(name for name in self.tested if name not in self.bound)

    def values(self, measured: Mapping[str, Value]) -> dict[str, Value]:
        """Return the values of the bound attributes from measured columns; None where missing."""
        return {name: measured.get(column) for name, column in self.bound.items()}

    def knobs(self) -> dict[str, OddKnob]:
        """Return the binding's knobs by attribute: the fields of a recipe that set it."""
        given = _section("knobs")
        return knobs_from_mapping({name: given[column] for name, column in self.bound.items() if column in given})

    def allowed(self, name: str) -> list[Value]:
        """Return the values of an attribute that can be inside, from its words, or from its limits and their midpoints.

        No condition changes between these values. An attribute that is not bound has one missing value.
        """
        item = next(attribute.item for attribute in self.definition.attributes if attribute.name == name)
        if item is None:
            return [None]
        edges = self.limits.get(name, ())
        between = [(low + high) / 2 for low, high in pairwise(edges)]
        values = [*edges, *between, edges[0] - 1, edges[-1] + 1] if edges else [0.0]
        candidates = values if item.numeric else list(item.labels)
        return [value for value in candidates if self.can_hold({name: value})]

    def can_hold(self, values: Mapping[str, Value]) -> bool:
        """Return whether these values can be inside the domain, with all other attributes undecided."""
        rest = {name: UNDECIDED for name in self.tested if name not in values}
        return self.definition.evaluate({**rest, **values}).inside

    def require_bound(self) -> None:
        """Raise `InputError` where the domain tests an attribute that nothing measures."""
        if self.unbound:
            raise InputError(
                f"{self.name}: nothing in flcav's binding measures '{self.unbound[0]}'"
                + (f" (and {len(self.unbound) - 1} more)" if len(self.unbound) > 1 else "")
                + "; `flcav odd check` lists what it measures"
            )


def read_domain(name: str | Path) -> Domain:
    """Return the domain of a name of `DOMAINS` or in an OpenODD file, with flcav's binding.

    A file without a taxonomy uses flcav's. Raises `InputError` if the file is missing, too large, names code to import
    or a git source, is not valid OpenODD for openodd-py, has units that do not convert, has no modules, or is empty.
    """
    path = FOLDER / f"{name}.yaml" if str(name) in DOMAINS else Path(name)
    if str(name) not in DOMAINS:
        if not path.exists() and not path.suffix:
            raise InputError(
                f"unknown domain {shorten(str(name))}; those of flcav: {', '.join(DOMAINS)}, or an OpenODD "
                f"file{suggest(str(name), DOMAINS)}"
            )
        _refuse_foreign(path, path.parent, set())
    documents = list(_documents(path, path.parent))
    taxonomies = [document["TAXONOMY"] for document in documents if "TAXONOMY" in document]
    # Imported documents come first, those that extend them later.
    sources = [rewrite_ranges(documents[::-1])] if any(map(has_ranges, taxonomies)) else [path]
    domain = _load(sources if taxonomies else [path, TAXONOMY], path.stem, path)
    _refuse_empty(domain, path)
    return domain


def everything() -> Domain:
    """Return the unbounded domain: all concepts of flcav's taxonomy, without modules."""
    return _load([TAXONOMY], "taxonomy", TAXONOMY)


def _load(sources: Sequence[Path | str], name: str, origin: Path) -> Domain:
    backend = _backend()
    concepts = _read(sources, {}, backend, name, origin)
    bindings = {
        attribute.name: _section("probes")[leaf]
        for attribute in concepts.attributes
        if (leaf := attribute.name.rpartition(".")[2]) in _section("probes")
    }
    # A concept of the same name with other words is not bound: flcav's words would be outside by mistake.
    words = _literals()
    spoken = {
        attribute.name: attribute.item for attribute in _read(sources, bindings, backend, name, origin).attributes
    }
    for full in list(bindings):
        item, ours = spoken[full], words.get(full.rpartition(".")[2])
        if item is not None and (item.numeric != (ours is None) or (ours and not set(ours) <= set(item.labels))):
            del bindings[full]
    definition = _read(sources, bindings, backend, name, origin)
    conditions = [condition for module in definition.modules for condition in module.conditions()]
    tested = tuple(dict.fromkeys(attribute for condition in conditions for attribute in condition.attributes()))
    # Without the binding's buckets, the edges of an item are the thresholds of the domain's conditions.
    bare = {full: {"probe": probe["probe"], "unit": probe.get("unit", "")} for full, probe in bindings.items()}
    bounded = _read(sources, bare, backend, name, origin).attributes
    items = [attribute.item for attribute in bounded if attribute.item is not None]
    limits = {item.name.removeprefix("odd."): item.edges for item in items if item.numeric}  # as conditions name them
    return Domain(
        name,
        definition,
        {full: probe["probe"] for full, probe in bindings.items()},
        tested,
        {full: tuple(sorted(filter(math.isfinite, edges))) for full, edges in limits.items()},
        backend,
    )


def _read(
    sources: Sequence[Path | str], bindings: Mapping[str, Mapping[str, str]], backend: Backend, name: str, origin: Path
) -> OddDefinition:
    try:
        return load_openodd(*sources, bindings=bindings, backend=backend, name=name)
    except (OpenOddError, UnitError, GitSourceError) as error:
        meant = _say_meant(str(error))
        raise InputError(f"{origin}: not OpenODD as openodd-py reads it ({error}){meant}") from None


def _say_meant(error: str) -> str:
    """Return a hint for an unknown word in a message of openodd-py: its attribute, or a similar word; "" for others."""
    match = re.search(r"has no literal (.+?) \(literals: (.*)\)", error)
    if match is None:
        return ""
    word = match[1].strip("'\"").lower()
    for leaf, words in _literals().items():
        if word in words:
            return f"; {word} is a word of {leaf}: write `{leaf}: [{word}]`"
    if word in MEANT:
        return f"; {word} is said by another attribute: write `{MEANT[word]}`"
    return suggest(word, match[2].split(", "))


def _section(name: str) -> dict[str, dict[str, str]]:
    return _packaged(BINDING)[name]


@cache
def _packaged(path: Path) -> dict:
    """Return the content of a file of the package, cached."""
    document = read_yaml(path)
    assert isinstance(document, dict)
    return document


def _literals() -> dict[str, list[str]]:
    """Return the words of each categorical concept of flcav's taxonomy, by leaf name."""
    taxonomy = _packaged(TAXONOMY)["TAXONOMY"]
    leaves = {leaf: kind for group in taxonomy.values() for leaf, kind in group.items()}
    return {leaf: kind for leaf, kind in leaves.items() if isinstance(kind, list)}


@dataclass
class Recordings(Backend):
    """Backend of openodd-py over rows of measured columns, with the agent's position and geolocation where known."""

    def position(self, context: Mapping[str, Value]) -> tuple[float, float, float] | None:
        """Return the agent's position x, y, z [m] in the world frame; None where missing."""
        return _numbers(context, ("x", "y", "z"))

    def geolocation(self, context: Mapping[str, Value]) -> tuple[float, float] | None:
        """Return the agent's latitude and longitude [deg]; None where missing."""
        return _numbers(context, ("latitude", "longitude"))


def _numbers(row: Mapping[str, Value], names: tuple[str, ...]) -> tuple | None:
    values = [row.get(name) for name in names]
    return None if None in values else tuple(values)


def _backend() -> Recordings:
    """Return the backend with a probe per measured column; it imports no code."""

    def read(column: str) -> tuple:
        return (lambda row: row.get(column)), _section("probes")[column].get("unit", "")

    return Recordings(name="flcav", probes={column: read(column) for column in _section("probes")}, allow_imports=False)


def _documents(path: Path, folder: Path) -> Iterator[dict]:
    """Yield the OpenODD document of a file, followed by those that it imports."""
    document = read_yaml(path)
    if isinstance(document, dict):
        yield document
        imports = document.get("IMPORT") or []
        for name in imports if isinstance(imports, list) else [imports]:
            if isinstance(name, str):
                yield from _documents(path_within(folder, name, path), folder)


def _refuse_foreign(path: Path, folder: Path, seen: set[Path]) -> None:
    """Raise `InputError` if a file or an import is too large, names code or a git source, or is outside the folder."""
    if path in seen:
        raise InputError(f"{path}: imports itself")
    if len(seen) >= MOST_FILES:
        raise InputError(f"{path}: more than {MOST_FILES} files are imported")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: an ODD is a file, and no pipe or device")
    if path.is_file() and path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: an ODD of more than {MOST_BYTES} bytes is not read")
    document = read_yaml(path)
    for key, value in _pairs(document):
        if key in REFUSED:
            raise InputError(f"{path}: '{key}: {shorten(value)}' is refused: {REFUSED[key]}; flcav reads files alone")
    if not isinstance(document, dict):
        raise InputError(f"{path}: an OpenODD document is a mapping")
    imports = document.get("IMPORT") or []
    for name in imports if isinstance(imports, list) else [imports]:
        if not isinstance(name, str) or ":" in name:
            raise InputError(f"{path}: IMPORT of {shorten(name)} is refused: flcav reads files beside an ODD alone")
        _refuse_foreign(path_within(folder, name, path), folder, seen | {path})


def _pairs(value: object) -> Iterator[tuple[str, object]]:
    """Yield the keys and values of all mappings within a YAML document, recursively."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield str(key), item
            yield from _pairs(item)
    elif isinstance(value, list):
        for item in value:
            yield from _pairs(item)


def _refuse_empty(domain: Domain, origin: Path) -> None:
    """Raise `InputError` if a domain has no modules, or no value of one of its attributes can be inside."""
    if not domain.definition.modules:
        raise InputError(f"{origin}: has no modules, so that it bounds nothing")
    for name in domain.tested:
        if not domain.allowed(name):
            raise InputError(f"{origin}: the domain is empty: no value of {name} is inside")
