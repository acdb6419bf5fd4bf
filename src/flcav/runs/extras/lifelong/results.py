"""Results of lifelong learning, of the finished steps of a run: scores, transfer, bytes, and seconds until mended."""

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
    """Return each task's arms of lifelong learning: with replay, without, and nothing; no field where the run has none.

    Writes the ledger of each arm that learns to `ledgers` beside `work`.
    """
    own = graph.recipe.lifelong
    if own is None:
        return {}
    arms = [_collect_learning(graph, work, own, task, arm) for task in graph.recipe.tasks for arm in LEARNING]
    for arm in LEARNING:
        steps = [folder / name for folder, name in _list_ledgers(graph, work, own, arm)]
        book = Ledger(NO_LIMIT, (entry for path in steps for entry in Ledger.load(path).entries))
        book.save(work.parent / "ledgers" / f"{LIFELONG}-{arm.replace(' ', '-')}.parquet")
    return {"lifelong": (*arms, *(_collect_nothing(graph, work, own, task) for task in graph.recipe.tasks))}


def find_mended(
    scores: Sequence[float], wanted: float, recorded_s: float, rounds_s: Sequence[float] | None, replaced: bool
) -> tuple[float | None, float | None]:
    """Return the seconds from a condition's beginning until a copy has the score `wanted`, and until one drives.

    scores: before the first round, and after each. The first is 0 where the network that drives has it already; a copy
    drives after the last round, where it is `replaced`. None where there is no such copy, or no clock.
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


def _list_ledgers(graph: Graph, work: Path, own: Lifelong, arm: str) -> list[tuple[Path, str]]:
    return [
        (work / name(condition, task, arm), file)
        for task in graph.recipe.tasks
        for condition in own.conditions
        for name, file in ((name_learning, LEDGER), (name_driving, DELIVERED))
    ]


def _collect_learning(graph: Graph, work: Path, own: Lifelong, task: str, arm: str) -> LifelongArm:
    names, passed = graph.names, list[Passed]()
    drove = names.pretrain(MAIN, task)
    tested = [[_test(graph, work, drove, region) for region in own.conditions]]
    for number, condition in enumerate(own.conditions):
        learned, drives = name_learning(condition, task, arm), name_driving(condition, task, arm)
        tested.append([_test(graph, work, drives, region) for region in own.conditions])
        result, driving = StageResult.load(work / learned), Driving.load(work / drives)
        books = [Ledger.load(path) for path in (work / learned / LEDGER, work / drives / DELIVERED)]
        seen = own.conditions[: number + 1]
        scores = {
            region: tuple(
                each.score
                for trained in (drove, learned)
                for each in Watched.load(work / names.rounds(trained, region)).rounds
            )
            for region in seen
        }
        seconds = [record.seconds for record in result.records or ()]
        clocked = graph.settings[MAIN].federation.network is not None
        rounds_s = tuple(each for each in seconds if each is not None) if clocked else None
        reachable = _reachable(graph, work, condition, task)
        mended = find_mended(scores[condition], reachable - own.margin, driving.recorded_s, rounds_s, driving.replaced)
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
    means = tuple(tuple(each.estimate.mean for each in row) for row in tested)
    return LifelongArm.of(arm, task, tested[0][0].measure, means, tuple(passed))


def _collect_nothing(graph: Graph, work: Path, own: Lifelong, task: str) -> LifelongArm:
    """Return the arm in which the pretrained network drives throughout."""
    names, passed = graph.names, list[Passed]()
    pretrained = names.pretrain(MAIN, task)
    tested = [_test(graph, work, pretrained, region) for region in own.conditions]
    for number, condition in enumerate(own.conditions):
        scores = {
            region: (Watched.load(work / names.rounds(pretrained, region)).rounds[-1].score,)
            for region in own.conditions[: number + 1]
        }
        reachable = _reachable(graph, work, condition, task)
        mended = find_mended(scores[condition], reachable - own.margin, 0.0, None, replaced=False)
        recorded_s = count_recorded_s(Frames.open(work / names.recording(condition, EDGE, task)))
        passed.append(Passed(condition, (), 0, 0, False, scores, reachable, recorded_s, *mended, 0, 0))
    row = tuple(each.estimate.mean for each in tested)
    return LifelongArm.of(NOTHING, task, tested[0].measure, (row,) * (len(own.conditions) + 1), tuple(passed))


def _test(graph: Graph, work: Path, trained: str, region: str) -> Tested:
    return Tested.load(work / graph.names.test(trained, region))


def _reachable(graph: Graph, work: Path, condition: str, task: str) -> float:
    """Return the validation score of the network that stage II trained for this condition from the pretrained one.

    It is that of the pretrained network where this has the better one.
    """
    steps = [graph.names.stage(MAIN, stage, condition, task) for stage in (PRETRAIN, EDGE)]
    return max(Watched.load(work / graph.names.rounds(step, condition)).rounds[-1].score for step in steps)


@dataclass(frozen=True)
class LifelongSection(PageSection):
    """Values of the report's section on lifelong learning."""

    template: ClassVar[str] = "lifelong/section.html.j2"
    chart: ClassVar[str] = "flcav.report.charts.lifelong:draw_lifelong"

    arms: tuple[LifelongArm, ...]
    conditions: tuple[tuple[LifelongArm, Passed], ...]  # in which vehicles asked


def describe_lifelong(run: Run) -> LifelongSection | None:
    """Return the section of a run; None where it has no lifelong learning."""
    if not run.lifelong:
        return None
    passed = tuple((arm, each) for arm in run.lifelong for each in arm.passed if each.asked)
    return LifelongSection(run.lifelong, passed)
