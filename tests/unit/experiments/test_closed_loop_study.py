"""The closed loop by networks against the truth: arms over the same drives, counts per hundred, and resuming."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from flcav.driving.jobs import DriveJob, Sensed
from flcav.driving.measures import DriveResult, Hit
from flcav.reproductions.closed_loop import run as study
from flcav.reproductions.closed_loop.run import ARMS, FIRST_SEED, NETWORKS, TRUTH, closed_loop_tables, summarise_arms
from flcav.statistics.estimates import score_interval

OWN = DriveResult("a", 900, 12.0, 0.6, 6.0, 2.0, 0.1, 1, 0, (), 0.6, {}, {"a red light": 2.0})
HIT = Hit(3.0, "car", "vehicle", 5.0, at_fault=True)


@pytest.fixture(scope="module")
def results() -> study.ClosedLoop:
    """The networks reach three quarters of what the truth does, and hit somebody in one drive of two."""
    hurt = replace(OWN, progress=0.3, red_lights=2, hits=(HIT, HIT), score=0.0, stood_s={"a parked car": 10.0})
    own = [OWN, replace(OWN, scenario="b")]
    return summarise_arms({TRUTH: own, NETWORKS: [hurt, own[1]]}, 2)


def test_arms_are_means_over_the_same_drives(results: study.ClosedLoop) -> None:
    networks = results.arms[NETWORKS]
    assert (results.drives, results.scenarios) == (2, 2)
    assert networks.progress.mean == pytest.approx(0.45)
    assert networks.crashed == score_interval(0.5, 2)  # a drive with two collisions counts once
    assert networks.red_lights == 2
    assert networks.stood_s == {"a parked car": 10.0, "a red light": 2.0}
    assert results.share_stood(networks) == pytest.approx(12.0 / 24.0)
    gap = results.differences["progress"]
    assert (gap.mean, gap.low, gap.high) == pytest.approx((-0.15, -0.3, 0.0))
    beyond = results.beyond  # .3 and .6 less .48
    assert (beyond.mean, beyond.low, beyond.high) == pytest.approx((-0.03, -0.18, 0.12))


def test_the_tables_have_every_arm_and_cause(results: study.ClosedLoop) -> None:
    tables = closed_loop_tables(results)
    assert all(name in tables["arms"] for name in ARMS)
    assert "50.0 (" in tables["arms"]
    assert "| a parked car | 0.0 | 10.0 |" in tables["standing"]
    assert "| progress less 0.8 of that by ground truth | -0.030 (-0.180 to +0.120) |" in tables["differences"]
    assert results.sentences()[1].startswith("networks: progress 0.450")


def test_arms_go_on_side_by_side_on_seeds_that_were_not_tuned_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int, str]] = []

    def drive_none(jobs: Sequence[DriveJob], sensed: Sensed, *_: object, kept: Path) -> list[DriveResult]:
        assert kept == tmp_path / "drives.jsonl"
        asked.extend((job.scenario.name, job.seed, sensed.kind) for job in jobs)
        return [replace(OWN, scenario=job.scenario.name, seed=job.seed) for job in jobs]

    monkeypatch.setattr(study, "run_jobs", drive_none)
    found = study.compare_perception(tmp_path, seeds=2, scenarios=3)
    assert found.drives == 6
    assert {seed for _, seed, _ in asked} == {FIRST_SEED, FIRST_SEED + 1}
    assert FIRST_SEED > 900
    assert len(set(asked)) == len(asked) == 12
