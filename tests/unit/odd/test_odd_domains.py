"""Domains: the six of the package, those of strangers, and what of these is refused before the library sees it."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from flcav.cli.main import run
from flcav.config import InputError
from flcav.odd import domain as reading
from flcav.odd.domain import DOMAINS, MEANT, everything, read_domain

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[4] / "shared" / "data")) / "odd"
Write = Callable[..., Path]


@pytest.mark.parametrize("name", DOMAINS)
def test_a_domain_of_the_package_is_bound_whole_and_has_a_revision(name: str):
    found = read_domain(name)
    assert found.unbound == ()
    assert len(found.tested) >= 8
    assert found.definition.version == "1.0"
    assert len(found.definition.revision or "") == 64


def test_the_binding_measures_every_concept_of_the_taxonomy():
    whole = everything()
    assert {each.name for each in whole.definition.attributes} == set(whole.bound)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("IMPORT: [{git: 'https://example.invalid/a.git', rev: v1, path: t.yaml}]\nMODULES: {}", "git"),
        ("IMPORT: ['git:https://example.invalid/a.git']\nMODULES: {}", "git:"),
        ("openodd: [a.yaml]\nprobes: {rainfall: {probe: 'os:getcwd'}}", "openodd"),
        ("MODULES: {m: {INCLUDE_AND: {rainfall: '<= 1 mm/h'}}}\nprobes: {rainfall: {probe: 'os:getcwd'}}", "probes"),
        ("MODULES: {m: {METADATA: {probe: 'os:getcwd'}}}", "probe"),
        ("IMPORT: [../../etc/passwd]\nMODULES: {}", "no name of a file"),
        ("IMPORT: [/etc/passwd]\nMODULES: {}", "no name of a file"),
        ("IMPORT: [own.yaml]\nMODULES: {}", "imports itself"),
    ],
)
def test_code_and_sources_of_strangers_never_reach_the_library(
    text: str, said: str, odd_file: Write, monkeypatch: pytest.MonkeyPatch
):
    path = odd_file(text)
    monkeypatch.setattr(reading, "load_openodd", lambda *_, **__: pytest.fail("the library was called"))
    with pytest.raises(InputError, match=said):
        read_domain(path)


def test_an_imported_file_is_looked_through_too(odd_file: Write):
    odd_file("IMPORT: [{git: 'https://example.invalid/a.git', rev: v1, path: t.yaml}]", "inner.yaml")
    with pytest.raises(InputError, match=r"inner\.yaml: 'git"):
        read_domain(odd_file("IMPORT: [inner.yaml]\nMODULES: {}"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("MODULES: {m: {INCLUDE_AND: {rainfall: '<= 1 m'}}}", "'m' measures length, not precipitation_rate"),
        (
            "TAXONOMY: {speed_limit: float length}\nMODULES: {m: {INCLUDE_AND: {speed_limit: '<= 1 m'}}}",
            "cannot convert 'm'",
        ),
        (
            "MODULES: {m: {INCLUDE_AND: {rainfall: '<= 1 mm/h'}, EXCLUDE_AND: {rainfall: '<= 2 mm/h'}}}",
            "the domain is empty: no value of environment.rainfall is inside",
        ),
        ("MODULES: {m: {INCLUDE_AND: {light: [day]}, EXCLUDE_AND: {light: [day]}}}", "no value of environment.light"),
        ("TAXONOMY: {wind: float velocity}", "has no modules, so that it bounds nothing"),
        ("MODULES: {m: {INCLUDE_AND: {snowfall: '<= 1 mm/h'}}}", "snowfall is neither a concept"),
        ("- a list", "a mapping"),
    ],
)
def test_bad_domains_are_refused_in_a_sentence(text: str, said: str, odd_file: Write):
    with pytest.raises(InputError, match=said):
        read_domain(odd_file(text))


def test_units_are_converted(odd_file: Write):
    found = read_domain(odd_file("MODULES: {m: {INCLUDE_AND: {visibility: '>= 0.5 km'}}}"))
    assert found.limits["environment.visibility"] == (500.0,)


def test_a_concept_of_other_words_is_unbound_and_not_outside_by_mistake(odd_file: Write):
    text = (
        "TAXONOMY: {junction: [cross_road, tee], wind: float velocity}\n"
        "MODULES: {m: {INCLUDE_AND: {junction: [cross_road], wind: '<= 5 m/s'}}}"
    )
    found = read_domain(odd_file(text))
    assert found.unbound == ("junction", "wind")
    with pytest.raises(InputError, match="measures 'junction' \\(and 1 more\\)"):
        found.require_bound()


def test_a_huge_file_is_not_read(odd_file: Write, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reading, "MOST_BYTES", 10)
    with pytest.raises(InputError, match="more than 10 bytes"):
        read_domain(odd_file("MODULES: {m: {INCLUDE_AND: {rainfall: '<= 1 mm/h'}}}"))


def test_a_pipe_is_not_waited_for(odd_file: Write):
    path = odd_file("").with_name("pipe.yaml")
    os.mkfifo(path)
    with pytest.raises(InputError, match="no pipe or device"):
        read_domain(path)


@pytest.mark.skipif(not REAL.is_dir(), reason=f"Autoware's ODD files are not at {REAL}; set FLCAV_REAL_DATA")
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ODD_Dense_Urban", "no literal minor_or local_roads"),  # a typing error in the file, whose word is suggested
        ("ODD_Dense_Urban", "did you mean 'minor_or_local_roads'?"),
        ("Domain_Concepts_Definition_ISO_34503", "has no modules"),
        ("ODD_Taxonomy_Extended", "has no modules"),
    ],
)
def test_autowares_files_are_refused_in_one_sentence(name: str, said: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        run(["odd", "check", str(REAL / f"{name}.yaml")])
    told = capsys.readouterr()
    assert (ended.value.code, told.out, told.err.count("\n")) == (2, "", 1)
    assert said in told.err


@pytest.mark.skipif(not REAL.is_dir(), reason=f"Autoware's ODD files are not at {REAL}; set FLCAV_REAL_DATA")
@pytest.mark.parametrize("name", ["ODD_Taxonomy_Extended", "Domain_Concepts_Definition_ISO_34503"])
def test_a_domain_on_autowares_concepts_is_read(name: str, odd_file: Write):
    for path in REAL.glob("*.yaml"):
        odd_file(path.read_text(), path.name)
    rules = "lane_width: '[2.5 .. 4] m', rainfall_intensity: [no_rain, light_rain], speed_limit: '<= 50 km/h'"
    found = read_domain(odd_file(f"IMPORT: [{name}.yaml]\nMODULES: {{m: {{INCLUDE_AND: {{{rules}}}}}}}"))
    assert {each.rpartition(".")[2] for each in found.tested} == {"lane_width", "rainfall_intensity", "speed_limit"}
    assert {found.bound[each] for each in found.tested if each in found.bound} == {"lane_width", "speed_limit"}
    (width,) = (each for each in found.tested if each.endswith("lane_width"))
    assert [found.can_hold({width: value}) for value in (2.4, 3.0, 4.1)] == [False, True, False]


RAIN = """
TAXONOMY:
  rain:
    intensity:
      none: {rate: "<= 0 mm/h"}
      light: {rate: "[0 .. 2.5] mm/h"}
    kind: [dynamic]
"""


@pytest.mark.parametrize("typed", ["'>= 0 m'", '"[0 .. 20] m"', "'> 0 km'", "'<10.5 m'"])
def test_a_range_in_place_of_a_type_is_a_number(typed: str, odd_file: Write):
    text = f"TAXONOMY: {{lane_width: {typed}}}\nMODULES: {{m: {{INCLUDE_AND: {{lane_width: '<= 4 m'}}}}}}"
    found = read_domain(odd_file(text))
    (name,) = found.tested
    assert found.bound == {name: "lane_width"}
    assert [found.can_hold({name: value}) for value in (3.9, 4.1)] == [True, False]


def test_classes_by_range_are_words_and_files_that_extend_others_add_theirs(odd_file: Write):
    odd_file(RAIN, "rain.yaml")
    more = "TAXONOMY: {rain: {kind: [convective]}}"
    rules = "MODULES: {m: {INCLUDE_AND: {intensity: [light], kind: [convective, dynamic], rate: '<= 2 mm/h'}}}"
    found = read_domain(odd_file(f"IMPORT: [rain.yaml]\n{more}\n{rules}"))
    names = {each.rpartition(".")[2]: each for each in found.tested}
    assert found.can_hold({names["intensity"]: "light", names["rate"]: 1.0})
    assert not found.can_hold({names["intensity"]: "none"})
    assert not found.can_hold({names["rate"]: 3.0})


@pytest.mark.parametrize(
    ("rule", "meant"),
    [
        ("zone: [urban]", "write `drivable_area_type: [distributor_road, minor_road]`"),
        ("zone: [motorway]", "motorway is a word of drivable_area_type"),
        ("surface_type: [wet]", "wet is a word of surface_condition"),
        ("junction: [crossroads]", "did you mean 'crossroad'?"),
    ],
)
def test_a_word_of_another_attribute_says_which_is_meant(rule: str, meant: str, odd_file: Write):
    with pytest.raises(InputError) as refused:
        read_domain(odd_file(f"MODULES: {{m: {{INCLUDE_AND: {{{rule}}}}}}}"))
    assert meant in str(refused.value)


@pytest.mark.parametrize("word", MEANT)
def test_what_is_said_to_be_meant_is_a_domain(word: str, odd_file: Write):
    assert read_domain(odd_file(f"MODULES: {{m: {{INCLUDE_AND: {{{MEANT[word]}}}}}}}")).unbound == ()
