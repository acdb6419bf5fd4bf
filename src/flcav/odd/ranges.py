"""Conversion of OpenODD taxonomies with classes defined by ranges into the form that openodd-py reads.

Autoware's files with the concepts of ISO 34503 define no_rain: {rainfall_rate: "<= 0 mm/h"}, where openodd-py expects a
list of words: no_rain becomes a word of rainfall_intensity, and rainfall_rate a number. Files that extend one another
may add words to a concept; these are joined.
"""

import re
from collections.abc import Mapping, Sequence

import yaml

from flcav.config import Json

RANGE = re.compile(
    r"\s*(?:[<>]=?\s*[-+.\d]+|\[\s*[-+.\d]+\s*\.\.\s*[-+.\d]+\s*\])\s*(?P<unit>[A-Za-z%°/²]*)\s*"
)  # of numbers, as in conditions
DIMENSIONS: Mapping[str, str] = {  # OpenODD's dimension by unit of such a range
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
    """Return whether a concept of a taxonomy is defined by a range of numbers."""
    if isinstance(taxonomy, dict):
        return any(has_ranges(node) for node in taxonomy.values())
    return isinstance(taxonomy, str) and RANGE.fullmatch(taxonomy) is not None


def rewrite_ranges(documents: Sequence[Mapping[str, Json]]) -> str:
    """Return several OpenODD documents as one (YAML), with words and numbers in place of classes by ranges."""
    taxonomy: Node = {}
    modules: Node = {}
    for document in documents:
        concepts = document.get("TAXONOMY")
        taxonomy = _join(taxonomy, concepts if isinstance(concepts, dict) else {})
        given = document.get("MODULES")
        modules |= given if isinstance(given, dict) else {}
    numbers: dict[str, str] = {}
    written = _rewrite(taxonomy, numbers)
    missing = {name: kind for name, kind in numbers.items() if name not in _names(written)}
    whole: Node = {"TAXONOMY": {**written, **({"ranges": dict(missing)} if missing else {})}}
    return yaml.safe_dump({**whole, **({"MODULES": modules} if modules else {})}, sort_keys=False)


def _join(one: Mapping[str, Json], other: Mapping[str, Json]) -> Node:
    """Merge two taxonomies: lists of words are joined, other values are those of the second."""
    joined = dict(one)
    for name, value in other.items():
        known = joined.get(name)
        if isinstance(known, dict) and isinstance(value, dict):
            joined[name] = _join(known, value)
        elif isinstance(known, list) and isinstance(value, list):
            joined[name] = [*known, *(word for word in value if word not in known)]
        else:
            joined[name] = value
    return joined


def _rewrite(node: Mapping[str, Json], numbers: dict[str, str]) -> Node:
    """Return a taxonomy without ranges, and add the types of the numbers with ranges to `numbers`."""
    written: Node = {}
    for name, value in node.items():
        if isinstance(value, str) and (match := RANGE.fullmatch(value)):
            numbers[name] = f"float {DIMENSIONS.get(match['unit'], '')}".strip()
        elif isinstance(value, dict):
            classes = [key for key, child in value.items() if isinstance(child, dict) and _is_class(child)]
            rest = {key: child for key, child in value.items() if key not in classes}
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
    return bool(node) and all(isinstance(child, str) and RANGE.fullmatch(child) for child in node.values())


def _names(node: Json) -> set[str]:
    if not isinstance(node, dict):
        return set()
    return set(node).union(*map(_names, node.values()))
