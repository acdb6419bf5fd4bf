"""Operational design domains (ODD) in ASAM OpenODD 1.0: read by openodd-py, with flcav's own binding and no other.

A domain is one of `DOMAINS`, or a stranger's OpenODD file. The library would import what a binding calls
`module:function`, and fetch what an import calls `git:`; of strangers' files both are refused before it reads them.
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

logging.getLogger("openodd").setLevel(logging.ERROR)  # of its warnings commands say what matters in their own words

FOLDER = Path(__file__).parent / "domains"
TAXONOMY, BINDING = FOLDER / "taxonomy.yaml", FOLDER / "binding.yaml"
DOMAINS = ("urban", "rural", "campus", "mine", "port", "parking_lot")
MOST_BYTES, MOST_FILES = 1_000_000, 20
REFUSED = {  # keys of strangers' files
    "git": "it names a git source to fetch",
    "probe": "it brings a binding, which may name code to import",
    "probes": "it brings a binding, which may name code to import",
    "measure": "it brings a binding, which may name code to import",
    "openodd": "it brings a binding, which may name code to import",
}
MEANT = {  # how words that people use for a domain are said in flcav's concepts
    **dict.fromkeys(("urban", "city", "suburban", "town"), "drivable_area_type: [distributor_road, minor_road]"),
    "residential": "drivable_area_type: [minor_road]",
    "rural": "drivable_area_type: [radial_road, distributor_road]",
    **dict.fromkeys(("highway", "freeway"), "drivable_area_type: [motorway]"),
    "intersection": "junction: [t_junction, crossroad]",
    "dark": "light: [night]",
    "rain": 'rainfall: "> 0 mm/h"',
    "fog": 'visibility: "<= 400 m"',
}

Value = float | str | None  # of an attribute: None is missing


@dataclass(frozen=True)
class Domain:
    """An operational design domain, with flcav's binding of its concepts."""

    name: str
    definition: OddDefinition
    bound: Mapping[str, str]  # attribute -> column of `flcav.odd.measure` that measures it
    tested: tuple[str, ...]  # attributes that its modules test
    limits: Mapping[str, tuple[float, ...]]  # numbers at which a condition on an attribute changes, ascending
    backend: Backend

    @property
    def unbound(self) -> tuple[str, ...]:
        """Return the attributes that its modules test and nothing measures."""
        return tuple(name for name in self.tested if name not in self.bound)

    def values(self, measured: Mapping[str, Value]) -> dict[str, Value]:
        """Return the value of each bound attribute from measured columns; None where one is missing."""
        return {name: measured.get(column) for name, column in self.bound.items()}

    def knobs(self) -> dict[str, OddKnob]:
        """Return how a recipe sets each attribute that it can set, by attribute: the knobs of the binding."""
        given = _section("knobs")
        return knobs_from_mapping({name: given[column] for name, column in self.bound.items() if column in given})

    def allowed(self, name: str) -> list[Value]:
        """Return values of an attribute that can be inside: of its words, or of its limits and points between them.

        No condition changes between these values. Of one that is not bound nothing is known: one missing value.
        """
        item = next(each.item for each in self.definition.attributes if each.name == name)
        if item is None:
            return [None]
        edges = self.limits.get(name, ())
        between = [(low + high) / 2 for low, high in pairwise(edges)]
        values = [*edges, *between, edges[0] - 1, edges[-1] + 1] if edges else [0.0]
        candidates = values if item.numeric else list(item.labels)
        return [each for each in candidates if self.can_hold({name: each})]

    def can_hold(self, values: Mapping[str, Value]) -> bool:
        """Return whether the domain can hold with these values, whatever the other attributes are."""
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
    """Return the domain of that name, or in that OpenODD file, with flcav's binding.

    A file without a taxonomy has flcav's. Raises `InputError` where it is missing, too large, names code to import or a
    source to fetch, is not OpenODD as the library reads it, has units that do not convert, tests nothing, or is empty.
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
    # The one that is imported is joined first, and those that extend it later.
    sources = [rewrite_ranges(documents[::-1])] if any(map(has_ranges, taxonomies)) else [path]
    domain = _load(sources if taxonomies else [path, TAXONOMY], path.stem, path)
    _refuse_empty(domain, path)
    return domain


def everything() -> Domain:
    """Return the domain without bounds: all concepts of flcav's taxonomy, and no modules."""
    return _load([TAXONOMY], "taxonomy", TAXONOMY)


def _load(sources: Sequence[Path | str], name: str, origin: Path) -> Domain:
    backend = _backend()
    concepts = _read(sources, {}, backend, name, origin)
    bindings = {
        each.name: _section("probes")[leaf]
        for each in concepts.attributes
        if (leaf := each.name.rpartition(".")[2]) in _section("probes")
    }
    # A stranger's concept of other words is not bound: flcav's would be none of them, and so outside by mistake.
    words = _literals()
    spoken = {each.name: each.item for each in _read(sources, bindings, backend, name, origin).attributes}
    for full in list(bindings):
        item, own = spoken[full], words.get(full.rpartition(".")[2])
        if item is not None and (item.numeric != (own is None) or (own and not set(own) <= set(item.labels))):
            del bindings[full]
    found = _read(sources, bindings, backend, name, origin)
    conditions = [condition for module in found.modules for condition in module.conditions()]
    tested = tuple(dict.fromkeys(each for condition in conditions for each in condition.attributes()))
    bare = {full: {"probe": each["probe"], "unit": each.get("unit", "")} for full, each in bindings.items()}
    items = [each.item for each in _read(sources, bare, backend, name, origin).attributes if each.item is not None]
    limits = {item.name.removeprefix("odd."): item.edges for item in items if item.numeric}  # as conditions name them
    return Domain(
        name,
        found,
        {full: each["probe"] for full, each in bindings.items()},
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
    """Return what was meant by a word that an attribute does not have: of another attribute, or another word."""
    found = re.search(r"has no literal (.+?) \(literals: (.*)\)", error)
    if found is None:
        return ""
    word = found[1].strip("'\"").lower()
    for leaf, words in _literals().items():
        if word in words:
            return f"; {word} is a word of {leaf}: write `{leaf}: [{word}]`"
    if word in MEANT:
        return f"; {word} is said by another attribute: write `{MEANT[word]}`"
    return suggest(word, found[2].split(", "))


def _section(name: str) -> dict[str, dict[str, str]]:
    return _own(BINDING)[name]


@cache
def _own(path: Path) -> dict:
    """Return a file of the package."""
    document = read_yaml(path)
    assert isinstance(document, dict)
    return document


def _literals() -> dict[str, list[str]]:
    """Return the words of each categorical concept of flcav's taxonomy, by leaf name."""
    taxonomy = _own(TAXONOMY)["TAXONOMY"]
    leaves = {leaf: kind for group in taxonomy.values() for leaf, kind in group.items()}
    return {leaf: kind for leaf, kind in leaves.items() if isinstance(kind, list)}


@dataclass
class Recordings(Backend):
    """The library's backend over rows of measured columns, with the agent's position and geolocation where known."""

    def position(self, context: Mapping[str, Value]) -> tuple[float, float, float] | None:
        """Return where the agent is [m]; None where the row does not say."""
        return _numbers(context, ("x", "y", "z"))

    def geolocation(self, context: Mapping[str, Value]) -> tuple[float, float] | None:
        """Return latitude and longitude [degrees]; None where the row does not say."""
        return _numbers(context, ("latitude", "longitude"))


def _numbers(row: Mapping[str, Value], names: tuple[str, ...]) -> tuple | None:
    values = [row.get(name) for name in names]
    return None if None in values else tuple(values)


def _backend() -> Recordings:
    """Return the library's backend: a probe per column, which reads a row of measured columns, and no imports."""

    def read(column: str) -> tuple:
        return (lambda row: row.get(column)), _section("probes")[column].get("unit", "")

    return Recordings(name="flcav", probes={column: read(column) for column in _section("probes")}, allow_imports=False)


def _documents(path: Path, folder: Path) -> Iterator[dict]:
    """Yield the OpenODD document in a file and those that it imports."""
    document = read_yaml(path)
    if isinstance(document, dict):
        yield document
        imports = document.get("IMPORT") or []
        for name in imports if isinstance(imports, list) else [imports]:
            if isinstance(name, str):
                yield from _documents(path_within(folder, name, path), folder)


def _refuse_foreign(path: Path, folder: Path, seen: set[Path]) -> None:
    """Raise `InputError` where a file or an import is too large, names code or a source, or leaves its folder."""
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
    """Yield the keys and values of all mappings within a YAML document."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield str(key), each
            yield from _pairs(each)
    elif isinstance(value, list):
        for each in value:
            yield from _pairs(each)


def _refuse_empty(domain: Domain, origin: Path) -> None:
    """Raise `InputError` where a domain has no modules, or leaves no value of one attribute inside."""
    if not domain.definition.modules:
        raise InputError(f"{origin}: has no modules, so that it bounds nothing")
    for name in domain.tested:
        if not domain.allowed(name):
            raise InputError(f"{origin}: the domain is empty: no value of {name} is inside")
