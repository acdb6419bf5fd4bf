"""Results of lifelong learning from the finished steps of a run: scores, transfer, bytes, and times until mended."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from flcav.network.ledger import Ledger
from flcav.runs.extras.lifelong.replay import NO_LIMIT
from flcav.runs.extras.lifelong.rows import LifelongArm, Passed
from flcav.runs.extras.lifelong.settings import LEARNING, LIFELONG, NOTHING, Lifelong
from flcav.runs.extras.lifelong.steps import DELIVERED, Driving, count_recorded_s, name_driving, name_learning
from flcav.runs.frames import Frames
from flcav.runs.recipe import EDGE, MAIN, PRETRAIN
from flcav.runs.registry import PageSection
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.runs.results.tests import Tested
from flcav.runs.results.training import StageResult, Watched
from flcav.runs.stages.graph import Graph


def collect_lifelong(graph: Graph, work: Path) -> dict[str, tuple[LifelongArm, ...]]:
    """Collect the arms of lifelong learning by task: with replay, without, and nothing; no field if the run has none.

    Writes the ledgers of the arms that learn to the folder `ledgers` next to `work`.
    """
    lifelong = graph.recipe.lifelong
    if lifelong is None:
        return {}
    arms = [_collect_learning(graph, work, lifelong, task, arm) for task in graph.recipe.tasks for arm in LEARNING]
    for arm in LEARNING:
        steps = [folder / name for folder, name in _list_ledgers(graph, work, lifelong, arm)]
        book = Ledger(NO_LIMIT, (entry for path in steps for entry in Ledger.load(path).entries))
        book.save(work.parent / "ledgers" / f"{LIFELONG}-{arm.replace(' ', '-')}.parquet")
    return {"lifelong": (*arms, *(_collect_nothing(graph, work, lifelong, task) for task in graph.recipe.tasks))}


def find_mended(
    scores: Sequence[float], wanted: float, recorded_s: float, rounds_s: Sequence[float] | None, replaced: bool
) -> tuple[float | None, float | None]:
    """Return the times [s] from a condition's beginning until a copy reaches the score `wanted`, and until it drives.

    `scores`: before the first round, and after every round. `recorded_s`: time of recording before the rounds [s];
    `rounds_s`: durations of the rounds [s]. The first time is 0 where the deployed network has the score already; a
    copy drives after the last round, if it has `replaced` the deployed one. None where there is no such copy, or no
    clock.
    """
    if scores[0] >= wanted:
        stays = not replaced or scores[-1] >= wanted
        return 0.0, 0.0 if stays else None
    if rounds_s is None:
        return None, None
    ends = recorded_s + np.cumsum(rounds_s)
    reached = [number for number, score in enumerate(scores[1:]) if score >= wanted]
    learned = float(ends[reached[0]]) if reached else None
    return learned, float(ends[-1]) if replaced and reached and scores[-1] >= wanted else None


def _list_ledgers(graph: Graph, work: Path, lifelong: Lifelong, arm: str) -> list[tuple[Path, str]]:
    return [
        (work / name(condition, task, arm), file)
        for task in graph.recipe.tasks
        for condition in lifelong.conditions
        for name, file in ((name_learning, LEDGER), (name_driving, DELIVERED))
    ]


def _collect_learning(graph: Graph, work: Path, lifelong: Lifelong, task: str, arm: str) -> LifelongArm:
    names = graph.names
    passed = list[Passed]()
    drove = names.pretrain(MAIN, task)
    tested = [[_test(graph, work, drove, region) for region in lifelong.conditions]]
    for number, condition in enumerate(lifelong.conditions):
        learned, drives = name_learning(condition, task, arm), name_driving(condition, task, arm)
        tested.append([_test(graph, work, drives, region) for region in lifelong.conditions])
        result, driving = StageResult.load(work / learned), Driving.load(work / drives)
        books = [Ledger.load(path) for path in (work / learned / LEDGER, work / drives / DELIVERED)]
        seen = lifelong.conditions[: number + 1]
        scores = {
            region: tuple(
                scored.score
                for trained in (drove, learned)
                for scored in Watched.load(work / names.rounds(trained, region)).rounds
            )
            for region in seen
        }
        seconds = [record.seconds for record in result.records or ()]
        clocked = graph.settings[MAIN].federation.network is not None
        rounds_s = tuple(round_s for round_s in seconds if round_s is not None) if clocked else None
        reachable = _reachable(graph, work, condition, task)
        mended = find_mended(
            scores[condition], reachable - lifelong.margin, driving.recorded_s, rounds_s, driving.replaced
        )
        group = result.group
        passed.append(
            Passed(
                condition=condition,
                asked=() if group is None else group.asked,
                members=0 if group is None else len(group.members),
                rounds=result.rounds,
                replaced=driving.replaced,
                scores=scores,
                reachable=reachable,
                recorded_s=driving.recorded_s,
                rounds_s=rounds_s,
                learned_s=mended[0],
                mended_s=mended[1],
                up_bytes=sum(book.used_bytes() for book in books),
                down_bytes=sum(book.used_bytes(direction="down") for book in books),
            )
        )
        drove = drives
    means = tuple(tuple(test.estimate.mean for test in row) for row in tested)
    return LifelongArm.of(arm, task, tested[0][0].measure, means, tuple(passed))


def _collect_nothing(graph: Graph, work: Path, lifelong: Lifelong, task: str) -> LifelongArm:
    """Return the arm in which the pretrained network drives throughout."""
    names = graph.names
    passed = list[Passed]()
    pretrained = names.pretrain(MAIN, task)
    tested = [_test(graph, work, pretrained, region) for region in lifelong.conditions]
    for number, condition in enumerate(lifelong.conditions):
        scores = {
            region: (Watched.load(work / names.rounds(pretrained, region)).rounds[-1].score,)
            for region in lifelong.conditions[: number + 1]
        }
        reachable = _reachable(graph, work, condition, task)
        mended = find_mended(scores[condition], reachable - lifelong.margin, 0.0, None, replaced=False)
        recorded_s = count_recorded_s(Frames.open(work / names.recording(condition, EDGE, task)))
        passed.append(Passed(condition, (), 0, 0, False, scores, reachable, recorded_s, *mended, 0, 0))
    row = tuple(test.estimate.mean for test in tested)
    return LifelongArm.of(NOTHING, task, tested[0].measure, (row,) * (len(lifelong.conditions) + 1), tuple(passed))


def _test(graph: Graph, work: Path, trained: str, region: str) -> Tested:
    return Tested.load(work / graph.names.test(trained, region))


def _reachable(graph: Graph, work: Path, condition: str, task: str) -> float:
    """Return the validation score that this condition can reach: of stage II from the pretrained network.

    Where the pretrained network has the better score, it is that one.
    """
    steps = [graph.names.stage(MAIN, stage, condition, task) for stage in (PRETRAIN, EDGE)]
    return max(Watched.load(work / graph.names.rounds(step, condition)).rounds[-1].score for step in steps)


@dataclass(frozen=True)
class LifelongSection(PageSection):
    """Values of the report's section on lifelong learning."""

    template: ClassVar[str] = "lifelong/section.html.j2"
    chart: ClassVar[str] = "flcav.report.charts.lifelong:draw_lifelong"

    arms: tuple[LifelongArm, ...]
    conditions: tuple[tuple[LifelongArm, Passed], ...]  # in which vehicles sent requests


def describe_lifelong(run: Run) -> LifelongSection | None:
    """Return the section of a run; None where it has no lifelong learning."""
    if not run.lifelong:
        return None
    passed = tuple((arm, condition) for arm in run.lifelong for condition in arm.passed if condition.asked)
    return LifelongSection(run.lifelong, passed)
