"""The step in which a region's vehicles track objects through the sweeps around their training frames, for labels."""

from collections.abc import Iterator, Sequence

from flcav.config import InputError
from flcav.fusion.average import PoseSource
from flcav.geometry import Boxes
from flcav.network.awareness import MessageSettings
from flcav.perception.tasks import task_named
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames, list_window
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.labels.heard import HeardMessages, hear_messages
from flcav.runs.labels.pseudo_labels import road_views
from flcav.runs.labels.tracks import WINDOW_S, save_tracks, track_frame
from flcav.runs.recipe import TRACKING
from flcav.runs.results.training import TrackedFrames
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.regions import choose_poles, select_group
from flcav.runs.stages.settings import RegionInputs, StepSettings, make_step
from flcav.runs.training.learning import load_stage_network


class TrackSettings(StepSettings):
    """Settings of the tracks of a region's vehicles."""

    task: str
    inputs: RegionInputs
    labels: str  # kind of labels, see `LABEL_SOURCES`
    messages: MessageSettings | None = None  # of the vehicles that announce themselves; None: none does
    navigation: PoseSource  # of the vehicles

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return self.inputs.needs


def track_step(work: Work, settings: TrackSettings) -> None:
    """Track the objects around the training frames of a region's vehicles, by detections of the pretrained network."""
    inputs = settings.inputs
    kind = LABEL_SOURCES[settings.labels]
    split = Frames.open(work.inputs[inputs.frames])
    network = load_stage_network(task_named(settings.task), work.inputs[inputs.pretrain])
    frames = select_group(work, split, inputs)
    poles = choose_poles(work, split, inputs, kind)
    check_windows(split, frames, inputs.region)
    spins = {i: (split.data.keys[i].scene, split.data.keys[i].index) for i in frames}
    views = road_views(split, poles, kind.trained, set(spins.values()))
    tracks, heard = dict[int, Boxes](), dict[int, HeardMessages]()
    for done, i in enumerate(frames, start=1):
        seen = [*views.get(spins[i], {}).values()]
        if settings.messages is not None:
            heard[i] = hear_messages(split, i, settings.messages, network)
        announced = heard[i].announced if i in heard else None
        tracks[i] = track_frame(network, split, i, seen, settings.navigation, announced, kind.from_detections)
        work.report(done, len(frames), "tracks")
    save_tracks(tracks, work.folder, {i: own.bytes for i, own in heard.items()})
    count = sum(own.count for own in heard.values())
    TrackedFrames(inputs.region, len(tracks), sum(map(len, tracks.values())), count).save(work.folder)


def check_windows(split: Frames, frames: Sequence[int], region: str) -> None:
    """Raise `InputError` where none of a region's `frames` has a second sweep of its vehicle nearby, to track through.

    Frames of a simulated town have such sweeps; a recorded or imported dataset has them if it holds sequences.
    """
    if frames and all(len(list_window(split, (i,), WINDOW_S)) == 1 for i in frames):
        raise InputError(
            f"{region}: labels by tracks need sweeps within {WINDOW_S:g} s of one another, with the vehicle's poses, "
            "and all sweeps of this dataset stand alone; take a sequence, or other labels"
        )


def list_tracks(outline: Outline, arm: Setting, task: str) -> Iterator[Step]:
    """Yield the tracking steps of an arm for a task, by region, if its labels come from tracks."""
    for region in arm.regions if LABEL_SOURCES[arm.labels[task]].tracked else ():
        inputs = outline.inputs(arm, region, task, TRACKING)
        settings = TrackSettings(
            task=task,
            inputs=inputs,
            labels=arm.labels[task],
            messages=arm.messages if LABEL_SOURCES[arm.labels[task]].heard else None,
            navigation=outline.recipe.navigation,
        )
        yield make_step(outline.names.tracks(arm.name, region, task), track_step, settings)
