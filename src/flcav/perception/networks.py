"""Training, evaluation and inference of a task's networks, and registration of their mistakes.

In all functions a task is a `Task` or its name on the command line (`flcav.perception.tasks`), data are a dataset or
its folder, and a network is one in memory, a file of weights, or "packaged" (None) for the task's weights in the
package. They compute on one thread unless `threads` says otherwise: another number changes the last bits of weights.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from torch import nn

from flcav.config import DamagedFile, InputError, Json
from flcav.dataset.formats.kitti import read_points
from flcav.dataset.formats.rig import UNSTATED, StatedLidar, find_rig
from flcav.dataset.layout import MANIFEST
from flcav.dataset.store import Dataset
from flcav.interface.notebook import resumable
from flcav.interface.progress import Report, print_progress
from flcav.machine.threads import use_threads
from flcav.perception.agents import FrameSelection, choose_frames
from flcav.perception.device import select_device
from flcav.perception.errors import RegistersErrors, Registry
from flcav.perception.kitti_benchmark import compare_kitti_rig, evaluate_kitti, is_kitti, open_evaluated
from flcav.perception.objects.evaluate import ObjectsEvaluation
from flcav.perception.objects.predict import look_around
from flcav.perception.objects.samples import compare_files_rig, find_rigs
from flcav.perception.objects.task import ObjectsTask
from flcav.perception.objects.truth import narrow_range
from flcav.perception.task import ConfigT, Finding, KnownLidar, NetworkT, SampleT, Scores, Task
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.tracking import evaluate_tracks, group_sequences
from flcav.perception.training.run import WEIGHTS, TrainingRequest, train_network
from flcav.perception.weights import Card, find_recorded_lidar, find_weights, join_lidars, load_network, read_card

Named = str | Task
Data = Dataset | Path | str
Weights = nn.Module | Path | str | None


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network with its model card and its file of weights."""

    network: nn.Module  # in evaluation mode
    card: Card  # data, settings, and metrics on the validation data
    weights: Path  # safetensors file of the network, with the card in its metadata


@dataclass(frozen=True)
class Evaluation:
    """Metrics of a network on a dataset."""

    task: str  # name of the task
    score: float  # the metric that validation maximises, in [0, 1]: accuracy, mAP, AP or another, by task
    chosen: FrameSelection  # the frames that were tested
    numbers: Mapping[str, Json]  # all metrics of the task as JSON values: docs/tasks.md
    lines: tuple[str, ...]  # the metrics in words

    def __str__(self) -> str:
        return "\n".join((self.chosen.sentence, *self.lines))


@dataclass(frozen=True)
class Inference:
    """Findings of a network, computed lazily input by input; they can be iterated once."""

    chosen: Mapping[Path, FrameSelection]  # the selected frames of each input that is a dataset
    findings: Iterator[Finding]
    lidars: Mapping[Path, str]  # folder of point clouds -> what its LiDAR is taken to be, where not as expected

    def __iter__(self) -> Iterator[Finding]:
        return self.findings


@resumable
def train(
    task: Named,
    data: Data | Sequence[Data],
    *,
    out: Path | str,
    validation: Data | None = None,
    network: str | None = None,
    epochs: int = 10,
    patience: int = 5,
    seed: int = 0,
    device: str = "auto",
    agents: str | None = None,
    threads: int = 1,
    progress: Report = print_progress,
) -> TrainedNetwork:
    """Train a network on recorded frames with their ground truth; weights, card and curves are written to `out`.

    An interrupted training is resumed; the result of a finished one is loaded. Raises `InputError` if task, network,
    data, device or agents are unusable, and if `out` holds weights of other settings; `OSError` if `out` cannot be
    written.

    Args:
        task: a name of `TASKS`, `module:NAME`, or the task itself.
        data: dataset or its folder, or several.
        out: folder of weights, card and curves.
        validation: dataset of other scenes, by which the best epoch is kept; None: the last one is.
        network: name of one of the task's configurations; None: its first.
        epochs: number of passes over the samples.
        patience: number of epochs without a better one after which a validated training stops.
        seed: seed of first weights, order and augmentation.
        device: "auto", "cpu" or "cuda".
        agents: whose frames: "vehicles", "poles", "all", or names with commas; None: those that the network fits.
        threads: number of CPU threads; another number gives other weights.
        progress: callback for the epochs done so far and in total.

    >>> from flcav import train
    >>> trained = train("weather", "data", out="networks/weather", epochs=2, seed=1)
    >>> trained.card.samples, trained.weights.name
    (4, 'weights.safetensors')
    """
    use_threads(threads)
    folders = data if isinstance(data, Sequence) and not isinstance(data, str) else [data]
    held = None if validation is None else open_data(validation)
    place = select_device(device)
    request = TrainingRequest(
        [open_data(folder) for folder in folders], held, network, epochs, patience, seed, place, agents
    )
    learned = resolve_task(task)
    weights = Path(out) / WEIGHTS
    card = train_network(learned, request, Path(out), progress)
    return TrainedNetwork(load_network(learned, weights).to(place), card, weights)


def evaluate(
    task: Named,
    data: Data,
    network: Weights = None,
    *,
    agents: str | None = None,
    within: str | None = None,
    around: bool = False,
    tracks: bool = False,
    lidar: StatedLidar = UNSTATED,
    device: str = "auto",
    threads: int = 1,
    progress: Report = print_progress,
) -> Evaluation:
    """Evaluate a network on recorded frames by the metrics of its task.

    Raises `InputError` if task, data, weights, device, agents or range are unusable.

    Args:
        task: a name of `TASKS`, `module:NAME`, or the task itself.
        data: dataset or its folder; of the task `objects` also one in KITTI's layout, counted as by its benchmark.
        network: the network or its file of weights; None: that of the package.
        agents: whose frames: "vehicles", "poles", "all", or names with commas; None: those that the network fits.
        within: "AHEAD,SIDE" [m], to which the range is limited; of the task `objects`.
        around: whether to detect in 360°, in four passes over the rotated sweep; of the task `objects`.
        tracks: whether to add the tracking metrics MOTA and AMOTA; of the task `objects`.
        lidar: height and beams of the LiDAR of a folder in KITTI's layout; by default as its sweeps show.
        device: "auto", "cpu" or "cuda".
        threads: number of CPU threads.
        progress: callback for the frames done so far and in total.

    >>> from flcav import evaluate
    >>> found = evaluate("objects", "data")  # the network of the package
    >>> dict(found.chosen.used), 0 <= found.score <= 1
    ({'vehicle': 4}, True)
    """
    use_threads(threads)
    learned = resolve_task(task)
    if tracks and not isinstance(learned, ObjectsTask):
        raise InputError(f"--tracks: only objects have tracks, not '{learned.name}'")
    if within is not None and not isinstance(learned, ObjectsTask):
        raise InputError(f"--range: only objects lie in a range, not '{learned.name}'")
    _check_around(learned, around)
    if isinstance(learned, ObjectsTask) and not isinstance(data, Dataset) and is_kitti(Path(data)):
        given = {"agents": agents, "range": within, "around": around, "tracks": tracks}
        if odd := [name for name, value in given.items() if value]:
            raise InputError(f"{data}: KITTI's benchmark has no use for --{odd[0]}; import the folder for that")
        return _evaluate_benchmark(learned, Path(data), network, device, lidar, progress)
    if lidar != UNSTATED:
        raise InputError(f"{data}: has no use for --lidar-height and --beams, of a folder in KITTI's layout")
    dataset = open_data(data)
    tested = _turned(learned, resolve_network(learned, network, device), around)
    chosen = choose_frames(learned, tested.config, dataset, agents, trained=find_trained_lidar(learned, network))
    narrow = {} if within is None else {"asked": narrow_range(tested.config, within)}
    if tracks:
        group_sequences(dataset, chosen.frames)  # raises before the long work
    evaluated = learned.evaluate(tested, dataset, chosen.frames, **narrow, progress=progress)
    if isinstance(evaluated, ObjectsEvaluation) and tracks:
        tracked = evaluate_tracks(tested, dataset, chosen.frames, **narrow, progress=progress)
        evaluated = replace(evaluated, tracks=tracked)
    return Evaluation(learned.name, evaluated.score, chosen, evaluated.as_json(), tuple(evaluated.lines()))


def _evaluate_benchmark(
    task: ObjectsTask, folder: Path, network: Weights, device: str, lidar: StatedLidar, progress: Report
) -> Evaluation:
    tested = resolve_network(task, network, device)
    rig = find_rig(open_evaluated(folder)[0].sweeps, read_points, lidar)
    evaluated = evaluate_kitti(tested, folder, rig, progress)
    unlike = compare_kitti_rig(folder, rig, tested.config, find_trained_lidar(task, network))
    chosen = FrameSelection(tuple(range(evaluated.frames)), ("ego",), {"vehicle": evaluated.frames}, {}, unlike)
    return Evaluation(task.name, evaluated.score, chosen, evaluated.as_json(), tuple(evaluated.lines()))


def infer(
    task: Named,
    inputs: Path | str | Sequence[Path | str],
    network: Weights = None,
    *,
    threshold: float | None = None,
    around: bool = False,
    agents: str | None = None,
    lidar: StatedLidar = UNSTATED,
    device: str = "auto",
    threads: int = 1,
) -> Inference:
    """Run a network on files, folders of files, or dataset folders: point clouds or images, by task.

    Raises `InputError` if task, weights, device or agents are unusable, and for a bad file, at the latest when the
    iteration reaches it.

    Args:
        task: a name of `TASKS`, `module:NAME`, or the task itself.
        inputs: files, folders of files, or folders of datasets.
        network: the network or its file of weights; None: that of the package.
        threshold: score below which detections are left out; None: the task's default.
        around: whether to detect in 360°, in four passes over the rotated sweep; of the task `objects`.
        agents: whose frames: "vehicles", "poles", "all", or names with commas; None: those that the network fits.
        lidar: height and beams of the LiDAR of point cloud files; by default as they show.
        device: "auto", "cpu" or "cuda".
        threads: number of CPU threads.

    >>> from flcav import infer
    >>> first = next(iter(infer("objects", "data", threshold=0.5)))
    >>> first.path.name, type(first.marks[0].boxes).__name__  # in the LiDAR's frame
    ('grid-0-000_0000_cav0', 'Boxes')
    """
    use_threads(threads)
    learned = resolve_task(task)
    _check_around(learned, around)
    paths = [Path(inputs)] if isinstance(inputs, Path | str) else list(map(Path, inputs))
    looking = _turned(learned, resolve_network(learned, network, device), around)
    recorded = [path for path in paths if (path / MANIFEST).is_file()]
    if agents is not None and not recorded:
        raise InputError(f"--agents {agents}: only datasets have agents, and none is among the inputs")
    trained = find_trained_lidar(learned, network)
    chosen = {
        path: choose_frames(learned, looking.config, Dataset.open(path), agents, trained=trained) for path in recorded
    }
    driven = isinstance(learned, ObjectsTask) and not looking.config.foreground
    files = [path for path in paths if driven and path not in chosen]
    if lidar != UNSTATED and not files:
        raise InputError("--lidar-height and --beams: only point clouds of a vehicle in files have a use for them")
    rigs = find_rigs(files, looking.config, lidar) if files else {}
    unlike = {
        files[0] if len(files) == 1 else folder: compare_files_rig(rig, lidar, looking.config, trained)
        for folder, rig in rigs.items()
    }
    lowest = threshold_of(learned, threshold)

    def found() -> Iterator[Finding]:
        for path in paths:
            choice, rig = chosen.get(path), rigs.get(path) or rigs.get(path.parent)
            mounted = {} if choice or rig is None else {"mount": rig.agent_from_lidar}
            yield from learned.infer(looking, path, lowest, choice and choice.frames, **mounted)

    return Inference(chosen, found(), {folder: words for folder, words in unlike.items() if words})


def register_errors(
    task: Named,
    data: Data,
    network: Weights = None,
    *,
    threshold: float | None = None,
    around: bool = False,
    agents: str | None = None,
    device: str = "auto",
    threads: int = 1,
    progress: Report = print_progress,
) -> Registry:
    """Return the mistakes of a network on recorded frames with their positions in the town, each once.

    Raises `InputError` for a task whose mistakes have no position, and if data, weights, device or agents are unusable.

    Args:
        task: a name of `TASKS`, `module:NAME`, or the task itself.
        data: dataset or its folder.
        network: the network or its file of weights; None: that of the package.
        threshold: score below which detections are ignored; None: the task's default.
        around: whether to detect in 360°, in four passes over the rotated sweep; of the task `objects`.
        agents: whose frames: "vehicles", "poles", "all", or names with commas; None: those that the network fits.
        device: "auto", "cpu" or "cuda".
        threads: number of CPU threads.
        progress: callback for the frames done so far and in total.

    >>> from flcav import register_errors
    >>> errors = register_errors("objects", "data")
    >>> errors.positions.shape == (len(errors), 3)  # world [m]
    True
    >>> set(errors.kinds) <= {"miss", "false_positive"}
    True
    """
    use_threads(threads)
    learned = resolve_task(task)
    _check_around(learned, around)
    dataset = open_data(data)
    if not isinstance(learned, RegistersErrors):
        able = [name for name in TASKS if isinstance(task_named(name), RegistersErrors)]
        raise InputError(f"task '{learned.name}': its mistakes have no place in a town; choose {', '.join(able)}")
    tested = _turned(learned, resolve_network(learned, network, device), around)
    chosen = choose_frames(learned, tested.config, dataset, agents, trained=find_trained_lidar(learned, network))
    lowest = threshold_of(learned, threshold)
    return replace(learned.register_errors(tested, dataset, chosen.frames, lowest, progress), chosen=chosen)


def resolve_task(task: Named) -> Task:
    """Return the task, looked up if a name is given; raises `InputError` for an unknown name."""
    return task_named(task) if isinstance(task, str) else task


def open_data(data: Data) -> Dataset:
    """Return the dataset, opened if a folder is given; raises `InputError` as `Dataset.open` does."""
    return data if isinstance(data, Dataset) else Dataset.open(data)


def resolve_network(task: Task[ConfigT, NetworkT, SampleT], network: Weights, device: str = "cpu") -> NetworkT:
    """Return a network in memory as it is; otherwise load a file of weights (None: the package's) on `device`.

    Raises `InputError` for a file of another task, and for None if the task has no weights in the package.
    """
    if isinstance(network, nn.Module):
        return cast(NetworkT, network)  # the caller answers for its type
    return load_network(task, find_weights(task, network)).to(select_device(device))


def _turned(task: Task, network: Any, around: bool) -> Any:
    """Return the network of `task`; with `around`, one that looks to all four sides."""
    return look_around(network) if around and isinstance(task, ObjectsTask) else network


def _check_around(task: Task, around: bool) -> None:
    if around and not isinstance(task, ObjectsTask):
        raise InputError(f"--around: only objects are looked for to all sides, not '{task.name}'")


def find_trained_lidar(task: Task, network: Weights) -> KnownLidar:
    """Return the LiDARs that a network was trained with, as far as its card says."""
    card = None if isinstance(network, nn.Module) else _find_card(find_weights(task, network))
    if card is None:
        return KnownLidar()
    return join_lidars([find_recorded_lidar(entry.recipe, entry.agents) for entry in card.data])


def threshold_of(task: Task, threshold: float | None) -> float:
    """Return the score threshold: `threshold`, for None the task's default, or 0 for a task without scores."""
    default = task.threshold if isinstance(task, Scores) else 0.0
    return default if threshold is None else threshold


@dataclass(frozen=True)
class Origin:
    """Origin of a network: its configuration, the seed of its training, and its file of weights."""

    network: str | None  # name of the configuration; None without a card
    seed: int | None  # None without a card
    weights: str  # path of the file

    def __str__(self) -> str:
        card = "without a card" if self.network is None else f"{self.network}, seed {self.seed}"
        return f"network: {card}, {self.weights}"


def origin_of(task: Task, weights: Path | None) -> Origin:
    """Return the origin of the network in a file of weights (None: the package's), read from its card.

    Raises `InputError` for None if the task has no weights in the package.
    """
    path = find_weights(task, weights)
    card = _find_card(path)
    return Origin(None, None, str(path)) if card is None else Origin(card.network, card.seed, str(path))


def _find_card(path: Path) -> Card | None:
    """Return the card in a file of weights; None without one. Raises `DamagedFile` for a damaged file or card."""
    try:
        return read_card(path)
    except DamagedFile:
        raise
    except InputError:
        return None
