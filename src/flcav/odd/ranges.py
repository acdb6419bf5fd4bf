"""Taxonomies of OpenODD whose classes are defined by ranges, rewritten as openodd-py reads them.

The concepts of ISO 34503 in Autoware's form have no_rain: {rainfall_rate: "<= 0 mm/h"} where OpenODD has a list of
words: no_rain is a word of rainfall_intensity, and rainfall_rate is a number. Files that extend one another may also
give one concept more words, which are joined.
"""

import re
from collections.abc import Mapping, Sequence

import yaml

from flcav.config import Json

RANGE = re.compile(
    r"\s*(?:[<>]=?\s*[-+.\d]+|\[\s*[-+.\d]+\s*\.\.\s*[-+.\d]+\s*\])\s*(?P<unit>[A-Za-z%°/²]*)\s*"
)  # of numbers, as conditions have it
DIMENSIONS: Mapping[str, str] = {  # of a unit in such a range, in OpenODD's words
    "m": "length",
    "km": "length",
    "m/s": "velocity",
    "km/h": "velocity",
    "mm/h": "precipitation_rate",
    "lux": "illuminance",
    "okta": "cloud_coverage",
    "%": "fraction",
    "deg": "angle",
    "rad": "angle",
    "count": "count",
}

Node = dict[str, Json]


def has_ranges(taxonomy: Json) -> bool:
    """Return whether a concept of a taxonomy has a range of numbers for its type."""
    if isinstance(taxonomy, dict):
        return any(has_ranges(each) for each in taxonomy.values())
    return isinstance(taxonomy, str) and RANGE.fullmatch(taxonomy) is not None


def rewrite_ranges(documents: Sequence[Mapping[str, Json]]) -> str:
    """Return one OpenODD document (YAML) of several that import one another, its classes in words and numbers."""
    taxonomy: Node = {}
    modules: Node = {}
    for document in documents:
        own = document.get("TAXONOMY")
        taxonomy = _join(taxonomy, own if isinstance(own, dict) else {})
        given = document.get("MODULES")
        modules |= given if isinstance(given, dict) else {}
    numbers: dict[str, str] = {}
    written = _rewrite(taxonomy, numbers)
    missing = {name: kind for name, kind in numbers.items() if name not in _names(written)}
    whole: Node = {"TAXONOMY": {**written, **({"ranges": dict(missing)} if missing else {})}}
    return yaml.safe_dump({**whole, **({"MODULES": modules} if modules else {})}, sort_keys=False)


def _join(one: Mapping[str, Json], other: Mapping[str, Json]) -> Node:
    """Return two taxonomies as one: lists of words are joined, and otherwise the second is taken."""
    joined = dict(one)
    for name, value in other.items():
        known = joined.get(name)
        if isinstance(known, dict) and isinstance(value, dict):
            joined[name] = _join(known, value)
        elif isinstance(known, list) and isinstance(value, list):
            joined[name] = [*known, *(each for each in value if each not in known)]
        else:
            joined[name] = value
    return joined


def _rewrite(node: Mapping[str, Json], numbers: dict[str, str]) -> Node:
    """Return a taxonomy without ranges, and note in `numbers` the type of each number that has one."""
    written: Node = {}
    for name, value in node.items():
        if isinstance(value, str) and (found := RANGE.fullmatch(value)):
            numbers[name] = f"float {DIMENSIONS.get(found['unit'], '')}".strip()
        elif isinstance(value, dict):
            classes = [key for key, each in value.items() if isinstance(each, dict) and _is_class(each)]
            rest = {key: each for key, each in value.items() if key not in classes}
            for key in classes:
                _rewrite(value[key], numbers)  # pyright: ignore[reportArgumentType]
            if classes and rest:
                written[name] = {f"{name}_class": list[Json](classes), **_rewrite(rest, numbers)}
            else:
                written[name] = list[Json](classes) if classes else _rewrite(rest, numbers)
        else:
            written[name] = value
    return written


def _is_class(node: Mapping[str, Json]) -> bool:
    return bool(node) and all(isinstance(each, str) and RANGE.fullmatch(each) for each in node.values())


def _names(node: Json) -> set[str]:
    if not isinstance(node, dict):
        return set()
    return set(node).union(*map(_names, node.values()))
