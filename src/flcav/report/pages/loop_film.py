"""The loop of a finished run as an animated picture, from its results and the files of its steps."""

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from flcav.config import InputError
from flcav.perception.errors import load_errors
from flcav.report.pages.run_page import read_changes
from flcav.report.pictures.loop import LINKS, PER_SECOND, Loop, LoopRound, draw_loop, find_shares
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.plans import Placed
from flcav.runs.results.run import ArmResult, Run
from flcav.runs.results.saved import ERRORS
from flcav.runs.running import WORK
from flcav.storage.files import write_bytes
from flcav.storage.records import select
from flcav.world.trace import Trace

FORMATS = {".webp": "WEBP", ".gif": "GIF"}
MOST_BYTES = 3_000_000
QUALITIES = (80, 65, 50, 35, 20)  # of WebP, and steps of fewer colours of GIF: the first that fits is taken


def write_loop(folder: Path, path: Path) -> tuple[int, float]:
    """Write the animation of a run's first region that has all it shows, and return its frames and seconds.

    It has at most `MOST_BYTES`. Raises `InputError` for another ending than those of `FORMATS`, and where the folder no
    longer has the recordings of a region and its errors before and after edge FL.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: end the name with {' or '.join(FORMATS)}")
    frames = [*draw_loop(read_loop(Run.load(folder), folder))]
    save_frames(frames, path)
    return len(frames), len(frames) / PER_SECOND


def save_frames(frames: Sequence[Image.Image], path: Path) -> None:
    """Write frames as an animation that begins anew, in the format of the path's ending, in `MOST_BYTES` at most.

    Both formats join equal frames that follow one another.
    """
    kind = FORMATS[path.suffix.lower()]
    contents = (_encode(frames, kind, quality) for quality in QUALITIES)
    small = next((content for content in contents if len(content) <= MOST_BYTES), None)
    if small is None:
        raise InputError(f"{path}: takes more than {MOST_BYTES / 1e6:g} MB even in the coarsest quality")
    write_bytes(path, small)


def _encode(frames: Sequence[Image.Image], kind: str, quality: int) -> bytes:
    out = io.BytesIO()
    unit = 10 if kind == "GIF" else 1  # of durations [ms]
    ends = [unit * round(1000 * n / PER_SECOND / unit) for n in range(len(frames) + 1)]
    lasts = np.diff(ends).tolist()
    if kind == "GIF":
        palette = frames[-1].quantize(max(2 * quality, 32))
        frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    options = {"quality": quality, "method": 4} if kind == "WEBP" else {}
    frames[0].save(out, kind, save_all=True, append_images=frames[1:], duration=lasts, loop=0, **options)
    return out.getvalue()


def read_loop(run: Run, folder: Path) -> Loop:
    """Return what the animation of a run shows; raises `InputError` where its folder no longer has it."""
    placed = next((each for each in run.arms[MAIN].placed if _has_all(run, folder, each)), None)
    changes = None if placed is None else read_changes(run, folder / WORK, placed)
    if placed is None or changes is None:
        raise InputError(f"{folder}: has no region with its recordings, and its errors before and after edge FL")
    names, region, tasks = run.steps, placed.region, run.recipe.placement.tasks
    found = [
        error for task in tasks for error in load_errors(folder / WORK / names.errors(MAIN, region, task) / ERRORS)
    ]
    registry, edge = (_read_traces(run, folder, region, split) for split in ("registry", "edge"))
    scenes = [error.scene for error in found]
    most = max(registry, key=lambda scene: (scenes.count(scene), scene))
    watched = next(each for each in select(run.watched, task=tasks[0]) if each.region == region)
    tested = next(each for each in run.tested if each.task == tasks[0])
    return Loop(
        region=region,
        task=tasks[0],
        measure=tested.measure,
        frames=watched.frames,
        changes=changes,
        share=find_shares(registry, scenes, [error.track for error in found], changes.errors),
        drives=len({*scenes}),
        drive=registry[most],
        learning=next(iter(edge.values()), registry[most]),
        rounds=(*list_rounds(run, region, tasks[0]),),
        budgets_mb={link: use.budget_mb for link, use in run.arms[MAIN].links.items()},
    )


def _has_all(run: Run, folder: Path, placed: Placed) -> bool:
    tasks, names = run.recipe.placement.tasks, run.steps
    return bool(tasks) and bool(placed.poles) and all(
        (folder / WORK / step).is_dir()
        for task in tasks
        for step in (
            names.errors(MAIN, placed.region, task),
            names.remaining(placed.region, task),
            names.recording(placed.region, "registry", task),
        )
    )  # fmt: skip


def _read_traces(run: Run, folder: Path, region: str, split: str) -> dict[str, Trace]:
    """Return the traffic of a split's scenes; empty where the folder no longer has it."""
    step = folder / WORK / run.steps.recording(region, split, run.recipe.placement.tasks[0])
    if not step.is_dir():
        return {}
    data = Frames.open(step).data
    scenes = sorted({key.scene for key in data.keys})
    return {scene: trace for scene in scenes if (trace := data.trace(scene)) is not None}


def list_rounds(run: Run, region: str, task: str) -> Iterator[LoopRound]:
    """Yield pretraining and the rounds of the stages, with what all regions had sent by then."""
    result, sent = run.arms[MAIN], dict.fromkeys(LINKS, 0.0)
    score: float | None = None
    for stage, word in ((PRETRAIN, "Pretraining"), (EDGE, "Edge FL, round"), (CLOUD, "Cloud FL, round")):
        scores = {
            each.round: each.score
            for watched in select(run.watched, stage=stage, task=task, region=region)
            for each in watched.rounds
        }
        records = [row for each in result.stages if each.stage == stage for row in each.records or ()]
        numbers = sorted({row.round for row in records}) if stage != PRETRAIN else [0]
        beside = _count_beside(result, stage)
        for number in numbers:
            rows = [row for row in records if row.round == number]
            for row in rows:
                sent["wireline" if row.server == CLOUD else "wireless"] += (row.up_bytes or 0) / 1e6
            for link in LINKS:
                sent[link] += beside[link] if number == numbers[0] else 0.0
            score = scores.get(number, score)
            own = [row for row in rows if row.server == region]
            clients = tuple(dict.fromkeys(name.rpartition("/")[2] for row in own for name in row.clients))
            cloud = any(row.server == CLOUD and region in row.clients for row in rows)
            yield LoopRound(word if stage == PRETRAIN else f"{word} {number}", score, dict(sent), clients, cloud)


def _count_beside(result: ArmResult, stage: str) -> dict[str, float]:
    """Return what a stage sent upwards beside its rounds, its samples and labels, by link [MB]."""
    beside = {link: sum(row.mb for row in select(result.spent, stage=stage, link=link)) for link in LINKS}
    if stage != PRETRAIN:
        for each in result.stages:
            for row in (each.records or ()) if each.stage == stage else ():
                beside["wireline" if row.server == CLOUD else "wireless"] -= (row.up_bytes or 0) / 1e6
    return {link: max(mb, 0.0) for link, mb in beside.items()}
