"""Every command on mutated inputs, and the contract that holds whatever they are.

The exit code is 0 or 2. On 2 there is one sentence on stderr, no traceback, and nothing half-written.
"""

import contextlib
import io
import json
import os
import re
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bombs import bomb
from mutations import Rng, link_tree, mutate, odd_number
from time_limits import Slow, within

from flcav.cli.main import run
from flcav.perception.errors import RegistersErrors
from flcav.perception.task import Scores
from flcav.perception.tasks import TASKS, task_named


@dataclass(frozen=True)
class Call:
    """A command line whose inputs may be mutated; words of it that name an input are paths, OUT is a new one."""

    words: str  # "#5" is the number 5, and now and then an extreme one
    inputs: tuple[str, ...]  # globs of files, below the folder of inputs, that may be mutated
    seconds: float  # of computing that a mutated input takes on average, measured
    problems: bool = False  # whether it reports problems of its input with exit code 1
    kept: tuple[str, ...] = ()  # what is whole, and kept where a later input is bad
    recordings: str = ""  # glob of the folders of which each is to become a scene; those above them are splits

    def arguments(self, folder: Path, out: Path, rng: Rng) -> list[str]:
        """Return the command line for inputs in `folder`."""
        return [self._argument(word, folder, out, rng) for word in self.words.split()]

    def _argument(self, word: str, folder: Path, out: Path, rng: Rng) -> str:
        if word.startswith("OUT"):
            return str(out) + word.removeprefix("OUT")
        if "/" in word or ("." in word and (folder / word).exists()):
            return str(folder / word)
        return re.sub(r"#([\d.]+)", lambda found: odd_number(rng) if rng.random() < 0.15 else found[1], word)


@dataclass(frozen=True)
class Outcome:
    """What came of one case."""

    number: int
    words: str
    done: str  # to the inputs
    code: int
    said: str  # on stderr
    broken: str  # in what way the contract is; "" where it holds
    slow: bool = False


DATASET = ("data/*", "data/*/*")
BEGUN, DRAWN = ("out/events", "out/checkpoint.pt"), ("out/0",)
FORMATS = {
    **{"kitti": "--min-points #1 --calibration assumed", "yolo": "--labels actors --validation #0.5 --min-pixels #1"},
    **{
        "coco": "--min-pixels #1",
        "nuscenes": "--validation #0.5",
        "opv2v": "--min-points #2",
        "mcap": "",
        "culane": "--validation #0.5",
    },
}
# seconds of what trains a task, what reads a dataset for it, and what draws pictures
LEARNERS = {
    "weather": (0.1, 0.04, 1.1),
    "signs": (0.2, 0.1, 0.7),
    "objects": (0.3, 0.13, 1.8),
    "trajectory": (0.55, 0.4, 0.8),
    "road": (0.6, 0.3, 0.9),
}
SCORED = {name: "--threshold #0.3" if isinstance(task_named(name), Scores) else "" for name in TASKS}
BOMBS, COPIED = 0.05, 0.1  # shares of files that unfold without end or are links, of imports with a recording twice
SPLITS = ("train", "test")  # folders of recordings in every such format
MOST_MB = 1500  # of memory that a case may take beyond what the process has, libraries included
FILES = {"weather": "picture.*", "signs": "picture.*", "road": "picture.*", "objects": "cloud.bin"}


def calls() -> list[Call]:
    """Return every command that reads something, in the ways it can be asked to."""
    found = [
        Call("validate data/", DATASET, 0.05, problems=True),
        Call("validate data/ data/", DATASET, 0.09, problems=True),
        Call("birdseye data/ --out OUT.png --range #40", DATASET, 0.2),
        Call("camera data/ --out OUT.png --boxes", DATASET, 0.3),
        *(
            Call(f"export {name} data/ --out OUT {options}", DATASET, 0.15 if name == "nuscenes" else 0.04)
            for name, options in FORMATS.items()
        ),
        Call("export yolo data/ --out OUT", DATASET, 0.04),
        Call("view data/ --save OUT.rrd", DATASET, 0.5),
        Call("place --errors errors.csv --poles poles.csv --range #40 --count #2", ("errors.csv", "poles.csv"), 0.02),
        Call(
            "place --errors errors.parquet --poles poles.parquet --range #40 --count #1 --json --method greedy",
            ("errors.parquet", "poles.parquet"),
            0.02,
        ),
        Call(
            "place --errors errors.csv --poles poles.csv --range 40 --count 1 --town town/ --map OUT.png",
            ("errors.csv", "poles.csv", "town/*"),
            0.14,
        ),
        Call("radio data/ --pole #1 --network network.yaml --map OUT.png", (*DATASET, "network.yaml"), 1.0),
        Call(
            "rounds data/ --pole 1 --model-mb #0.1 --step-s #0.001 --network network.yaml --timeline OUT.png",
            (*DATASET, "network.yaml"),
            0.5,
        ),
        Call(
            "place --errors errors.csv --poles poles.csv --sensors sensors.csv --budget #6 --json",
            ("errors.csv", "poles.csv", "sensors.csv"),
            0.05,
        ),
        Call(
            "place --errors errors.csv --poles poles.csv --sensors sensors.csv --cover #0.3",
            ("errors.csv", "poles.csv", "sensors.csv"),
            0.05,
        ),
        Call(
            "place --errors errors.csv --poles poles.csv --range 40 --count 1 --data data/ --town town/ "
            "--line-of-sight",
            ("errors.csv", "poles.csv", "town/*"),
            0.2,
        ),
        Call("fit history.csv --json --repeats 20 --at #500,#2,#1 --level #0.9 --seed #0", ("history.csv",), 0.09),
        Call("fit joint.csv --repeats 20 --at #500,1", ("joint.csv",), 0.2),
        Call("fit history.csv --repeats 20 --problem problem.yaml", ("history.csv", "problem.yaml"), 0.17),
        Call("fit history.csv --repeats 20 --problem OUT.yaml", ("history.csv",), 0.1),
        Call("fit history.parquet --repeats 20", ("history.parquet",), 0.17),
        Call(
            "fit joint.csv --json --repeats 20 --model effective --group-samples #700 --alpha #0.1 --beta #0.5",
            ("joint.csv",),
            0.03,
        ),
        Call("fit joint.csv --repeats 20 --model effective --group-samples #700", ("joint.csv",), 0.03),
        Call(
            "fit joint.csv --json --repeats 20 --model federated --group-samples #700 --group-samples #300",
            ("joint.csv",),
            0.03,
        ),
        *(Call(f"allocate {name} --json", (name,), 0.1) for name in ("problem.yaml", "graph.yaml", "graph.json")),
        Call("allocate problem.yaml --progress progress.yaml", ("problem.yaml", "progress.yaml"), 0.08),
        Call("replan problem.yaml progress.yaml --json", ("problem.yaml", "progress.yaml"), 0.08),
        Call("allocate graph.yaml --out OUT.html", ("graph.yaml",), 0.25),
        *(
            Call(f"allocate problem.yaml --baseline {name} --json", ("problem.yaml",), 0.09)
            for name in ("equal-stages", "equal-tasks", "max-throughput", "article")
        ),
        Call("towns show town/ --out OUT.png", ("town/*",), 0.12),
        Call("towns show town/ --poles OUT.csv", ("town/*",), 0.07),
        Call("towns import map.xodr --out OUT", ("map.xodr",), 0.09),
        Call("record recipe.yaml --out OUT --frames #1 --seed #3", ("recipe.yaml",), 0.1),
        Call("record elsewhere.yaml --out OUT --frames 1", ("town/*",), 0.45),
        Call("reproduce sim-to-real --kitti real/ --out OUT", ("real/training/*/*",), 4.0),
    ]
    for task, (trains, reads, draws) in LEARNERS.items():
        weights = f"weights/{task}.safetensors"
        found += [
            Call(f"train {task} --data data/ --out OUT --epochs 1 --seed #0", DATASET, trains, kept=BEGUN),
            Call(f"train {task} --data data/ --validation data/ --out OUT --epochs 1", DATASET, trains, kept=BEGUN),
            Call(f"evaluate {task} --data data/ --weights {weights} --json", (*DATASET, weights), reads),
            Call(f"infer {task} data/ --weights {weights} {SCORED[task]}", (*DATASET, weights), reads),
            Call(
                f"infer {task} data/ --weights {weights} --pictures OUT --json",
                (*DATASET, weights),
                draws,
                kept=DRAWN,
            ),
        ]
        if task in FILES:
            suffixes = ("png", "jpg", "webp") if "picture" in FILES[task] else ("bin",)
            found += [
                Call(f"infer {task} {name} --weights {weights} --json", (name, weights), reads / 2)
                for name in (f"{FILES[task].partition('.')[0]}.{suffix}" for suffix in suffixes)
            ]
        if isinstance(task_named(task), RegistersErrors):
            options = f"--data data/ --weights {weights} --out OUT.csv {SCORED[task]}"
            found.append(Call(f"errors {task} {options}", (*DATASET, weights), draws / 2))
    weights = "weights/objects.safetensors"
    found += [
        Call(f"import {name} {folder}/ --out OUT", (f"{folder}/**/*",), 0.1, kept=("out/.recording",), recordings=glob)
        for name, folder, glob in (
            *(("kitti", "real", ""), ("argoverse2", "argoverse2", "argoverse2/*/*")),
            *(("nuscenes", "nuscenes", ""), ("opv2v", "opv2v", "opv2v/*/*")),
        )
    ]
    found.append(Call(f"evaluate objects --data real/ --weights {weights}", ("real/training/*/*", weights), 0.15))
    tracks = f"evaluate objects --data data/ --weights {weights} --tracks"
    return [*found, Call(f"{tracks} --agents vehicles --range #30,#20", DATASET, 0.2)]


def run_case(inputs: Path, number: int, scratch: Path, choices: list[Call], limit_s: float) -> Outcome:
    """Run case `number` on mutated links to the files of `inputs`, in the new folder `scratch`."""
    rng = np.random.default_rng([number, 1])
    weights = np.array([1 / (call.seconds + 0.05) for call in choices])
    call = choices[int(rng.choice(len(choices), p=weights / weights.sum()))]
    link_tree(inputs, scratch / "in")
    done = []
    files = sorted({path for glob in call.inputs for path in (scratch / "in").glob(glob) if path.is_file()})
    count = min(len(files), int(rng.choice((1, 1, 1, 2))))
    for path in rng.choice(np.array(files, dtype=object), count, replace=False):
        done.append(bomb(path, rng) if rng.random() < BOMBS else mutate(path, rng))
    done += _copy_recordings(call, scratch / "in", rng)
    (scratch / "secret").write_text("not to be read, written or linked to")
    arguments = call.arguments(scratch / "in", scratch / "out", rng)
    before = _files(scratch)
    held_mb = _peak_mb()
    code, out, said, slow, trace = run_within(arguments, limit_s)
    broken = trace or ("" if slow else _broken(call, code, out, said, scratch, before))
    if not broken and (taken_mb := _peak_mb() - held_mb) > MOST_MB:
        broken = f"it took {taken_mb} MB of memory"
    shutil.rmtree(scratch, ignore_errors=True)
    return Outcome(number, " ".join(arguments), "; ".join(done), code, said, broken, slow)


def _broken(call: Call, code: int, out: str, said: str, scratch: Path, before: dict[str, tuple[int, int]]) -> str:
    """Return in what way the contract is broken."""
    if call.problems and code == 1 and not said and out:
        return ""
    if code not in (0, 2):
        return f"exit code {code}"
    after = _files(scratch)
    changed = {name for name, state in after.items() if before.get(name) != state}
    if elsewhere := sorted(name for name in changed if not name.startswith(("in", "out"))):
        return f"written elsewhere: {elsewhere[:3]}"
    if lost := before.keys() - after.keys():
        return f"deleted: {sorted(lost)[:3]}"
    links = [path for path in (scratch / "out").rglob("*") if path.is_symlink()]
    if odd := [path for path in links if not path.resolve().is_relative_to((scratch / "in").resolve())]:
        return f"a link to {odd[0].resolve()}"
    if code == 0 and call.recordings and (lacking := _lacking(call, scratch)):
        return lacking
    left = changed - {".", "out"}
    if code == 2:
        lines = said.splitlines()
        if len(lines) != 1 or not lines[0].startswith("flcav: "):
            return f"{len(lines)} lines on stderr"
        if len(lines[0]) > 1500:
            return f"a sentence of {len(lines[0])} characters"
        if left := {name for name in left if not name.startswith(call.kept)}:
            return f"left behind: {sorted(left)[:3]}"
    if parts := [name for name in left if ".part" in name]:
        return f"left behind: {parts[:3]}"
    return ""


def _copy_recordings(call: Call, folder: Path, rng: Rng) -> list[str]:
    """Copy a recording under the same name into another split, now and then; return what was done."""
    found = _recordings(call, folder)
    if not found or rng.random() > COPIED:
        return []
    one = found[int(rng.integers(len(found)))]
    split = str(rng.choice([name for name in SPLITS if name != one.parent.name]))
    shutil.copytree(one, one.parents[1] / split / one.name, symlinks=True)
    return [f"{one.relative_to(folder)} also in {split}"]


def _recordings(call: Call, folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob(call.recordings) if path.is_dir()) if call.recordings else []


def _lacking(call: Call, scratch: Path) -> str:
    """Return what of the recordings in the input is not in the dataset, "" where all are."""
    found = _recordings(call, scratch / "in")
    scenes = json.loads((scratch / "out" / "manifest.json").read_text())["scenes"]
    return "" if len(scenes) == len(found) else f"{len(scenes)} scenes of {len(found)} recordings"


def _peak_mb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def _files(folder: Path) -> dict[str, tuple[int, int]]:
    """Return what lies in the folder, with sizes and times; folders count as they are, not what is in them."""
    found = ((str(path.relative_to(folder)), path) for path in folder.rglob("*"))
    return {name: (0, 0) if path.is_dir() else _state(path) for name, path in found}


def _state(path: Path) -> tuple[int, int]:
    return path.lstat().st_size, path.lstat().st_mtime_ns


class Ran(NamedTuple):
    """What came of a command line."""

    code: int
    out: str  # on stdout
    said: str  # on stderr
    slow: bool  # whether the time was over
    trace: str  # of what was not caught


def run_within(arguments: list[str], limit_s: float) -> Ran:
    """Run a command line for at most so many seconds of computing."""
    code, slow, trace = 1, False, ""
    out = io.StringIO()
    with _stderr() as said, warnings.catch_warnings():
        warnings.simplefilter("default", RuntimeWarning)
        warnings.simplefilter("default", UserWarning)
        try:
            with contextlib.redirect_stdout(out), within(limit_s):
                run(arguments)
        except SystemExit as ended:
            code = int(ended.code or 0)
        except Slow:
            slow = True
        except BaseException as error:
            trace = _traceback(error)
    return Ran(code, out.getvalue(), said.getvalue(), slow, trace)


def _traceback(error: BaseException) -> str:
    """Return where in flcav the exception came from, and what it says."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/flcav/" in frame.filename]
    places = [f"{frame.filename.partition('/flcav/')[2]}:{frame.lineno} {frame.name}" for frame in frames[-4:]]
    return f"{' > '.join(places)}\n{type(error).__name__}: {' '.join(str(error).split())[:300]}"


@contextlib.contextmanager
def _stderr() -> Iterator[io.StringIO]:
    """Yield what Python and the libraries below it write to stderr, after the block."""
    said, kept = io.StringIO(), os.dup(2)
    with tempfile.TemporaryFile() as file, io.TextIOWrapper(file, write_through=True) as stream:
        sys.stderr.flush()
        os.dup2(file.fileno(), 2)
        try:
            with contextlib.redirect_stderr(stream):
                yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            said.write(file.read().decode(errors="replace"))
