"""A finished run, moment by moment: what was learned, who sent how much, and what the ledger then held."""

from collections.abc import Iterator
from pathlib import Path

from flcav.config import InputError, Json
from flcav.planner.desk import Desk, lay_out, with_errors
from flcav.planner.footage import Footage
from flcav.runs.results.run import ArmResult, Run
from flcav.runs.results.training import StageResult
from flcav.storage.records import select
from flcav.world.map.town import load_town

STAGES = {"pretrain": "pretraining", "edge": "edge round", "cloud": "cloud round"}  # a moment's stage in words
CLOUD = "cloud"  # name of the server that edge servers send to, over the wireline
LINKS = ("wireless", "wireline")
MB = 1e6  # bytes


def open_run(folder: Path) -> Desk:
    """Return the desk of a run's folder: its moments, and of each region the errors that it registered, if kept.

    Raises `InputError` where it is no finished run.
    """
    run = Run.load(folder)
    if not run.arms:
        raise InputError(f"{folder}: the run has no arm")
    arm = "main" if "main" in run.arms else next(iter(run.arms))
    footage = Footage(folder, run, arm)
    desk = Desk(run={**describe_run(run, arm, folder.resolve().name), "footage": footage.shown}, footage=footage)
    for placed in run.arms[arm].placed:
        errors, region = footage.errors_of(placed.region), run.recipe.regions[placed.region]
        if errors is not None and region.data is None:
            town = load_town(region.town or placed.region, folder)
            space = with_errors(lay_out(town), errors)
            key = desk.add(space, f"{town.name}~{placed.region}")
            if footage.has_error_sweeps(placed.region):
                desk.regions[key] = placed.region
            desk.first = desk.first or key
    return desk


def describe_run(run: Run, arm: str, name: str) -> dict[str, Json]:
    """Return the moments of an arm, in their order, for the page."""
    result = run.arms[arm]
    moments: list[dict[str, Json]] = []
    sent = dict.fromkeys(("wireless", "wireline"), 0.0)
    scores: dict[str, Json] = {}
    for moment, up in _list_moments(result):
        sent = {link: mb + up[link] for link, mb in sent.items()}
        seen = {
            f"{watched.task} in {watched.region}": reached.score
            for watched in select(run.watched, stage=str(moment["stage"]))
            for reached in watched.rounds
            if reached.round == moment["round"]
        }
        scores = scores | seen
        moments.append({**moment, "sent": dict(sent), "scores": dict(scores)})
    return {
        "name": name,
        "arm": arm,
        "moments": moments,
        "budgets": {link: use.budget_mb for link, use in result.links.items()},
        "used": {link: use.used_mb for link, use in result.links.items()},
        "frames": max((watched.frames for watched in run.watched), default=0),
        "findings": [{"verdict": found.verdict, "sentence": found.sentence} for found in run.findings],
        "placed": [
            {"region": each.region, "poles": list(each.chosen), "covered": each.covered, "errors": each.errors}
            for each in result.placed
        ],
    }


def _list_moments(result: ArmResult) -> Iterator[tuple[dict[str, Json], dict[str, float]]]:
    """Yield pretraining and every round with what it sent upwards over each link [MB].

    What a stage sent beside its rounds, samples and labels, comes before the first of them.
    """
    for stage, word in STAGES.items():
        of_stage = [each for each in result.stages if each.stage == stage]
        beside = {
            link: sum(row.mb for row in select(result.spent, stage=stage, link=link))
            for link in ("wireless", "wireline")
        }
        rounds = sorted({record.round for each in of_stage for record in each.records or ()})
        sent = {number: _up_of_round(of_stage, number) for number in rounds}
        for up in sent.values():
            beside = {link: mb - up[link] for link, mb in beside.items()}
        beside = {link: max(mb, 0.0) for link, mb in beside.items()}
        if stage == "pretrain" and any(beside.values()):
            yield {"stage": stage, "round": 0, "told": word, "servers": []}, beside
            continue
        for number in rounds:
            servers: list[Json] = [
                {
                    "server": record.server,
                    "task": each.task,
                    "clients": [name.rpartition("/")[2] for name in record.clients],
                    "failed": len(record.failed),
                    "loss": record.loss,
                    "up_mb": (record.up_bytes or 0) / MB,
                    "down_mb": (record.down_bytes or 0) / MB,
                }
                for each in of_stage
                for record in each.records or ()
                if record.round == number
            ]
            first = {link: mb if number == rounds[0] else 0.0 for link, mb in beside.items()}
            up = {link: sent[number][link] + first[link] for link in first}
            yield {"stage": stage, "round": number, "told": f"{word} {number}", "servers": servers}, up


def _up_of_round(stages: list[StageResult], number: int) -> dict[str, float]:
    """Return what the messages of a round sent upwards over each link [MB]."""
    up: dict[str, float] = dict.fromkeys(LINKS, 0.0)
    for stage in stages:
        for record in stage.records or ():
            if record.round == number:
                up["wireline" if record.server == CLOUD else "wireless"] += (record.up_bytes or 0) / MB
    return up
