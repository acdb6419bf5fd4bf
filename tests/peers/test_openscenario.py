"""Scenarios of every corner case by ASAM's checker of OpenSCENARIO XML, and parsed by scenariogeneration."""

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Peer

from flcav.driving.scripts import write_script
from flcav.odd.domain import read_domain
from flcav.odd.openscenario import to_openscenario
from flcav.odd.sampling import CASES, SampledScenario, Space, sample_domain
from flcav.odd.scenery import Scenery
from flcav.world.map.town import load_town
from flcav.world.opendrive.exporting import export_town

CHECKS = 17  # of the checker's bundle


@pytest.fixture(scope="module")
def drawn() -> dict[str, SampledScenario]:
    space = Space(read_domain("urban"), [Scenery(load_town("ring"))])
    found = {each.case: each for each in sample_domain(space, 300, "sobol").samples}
    assert set(found) == {case for cases in CASES.values() for case in cases}
    return found


def test_every_corner_case_is_valid_and_parsed(
    drawn: dict[str, SampledScenario], peer: Callable[[str], Peer], tmp_path: Path
) -> None:
    (tmp_path / "ring.xodr").write_text(export_town(load_town("ring")))
    for case, sample in drawn.items():
        (tmp_path / f"{case}.xosc").write_bytes(to_openscenario(sample, "ring.xodr"))
    rows = peer("openscenario").read(*(tmp_path / f"{case}.xosc" for case in drawn))
    for case, (checks, issues, version, entities, events, same) in zip(drawn, rows, strict=True):
        script = write_script(drawn[case].case, 10.0)
        assert (len(checks), issues, version, same) == (CHECKS, [], ["1", "2"], True), case
        assert entities == ["ego", *(actor.name for actor in script.actors)]
        assert events == len(script.actions)


def test_the_checker_finds_what_is_wrong(
    drawn: dict[str, SampledScenario], peer: Callable[[str], Peer], tmp_path: Path
) -> None:
    right = to_openscenario(drawn["crash"], "ring.xodr")
    (tmp_path / "unknown.xosc").write_bytes(right.replace(b'<EntityRef entityRef="car_1"', b'<EntityRef entityRef="x"'))
    (tmp_path / "schema.xosc").write_bytes(right.replace(b'author="flcav"', b'author="flcav" mood="x"'))
    rows = peer("openscenario").read(tmp_path / "unknown.xosc", tmp_path / "schema.xosc")
    assert all(issues for _, issues, *_ in rows)
