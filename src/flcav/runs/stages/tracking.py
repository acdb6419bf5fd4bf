"""The step in which a region's vehicles track objects through the sweeps around their training frames, for labels."""

from collections.abc import Iterator, Sequence

from flcav.config import InputError
from flcav.fusion.average import PoseSource
from flcav.perception.tasks import task_named
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames, list_window
from flcav.runs.label_sources import LABEL_SOURCES
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
    tracks = {}
    for done, i in enumerate(frames, start=1):
        seen = [*views.get(spins[i], {}).values()]
        tracks[i] = track_frame(network, split, i, seen, settings.navigation)
        work.report(done, len(frames), "tracks")
    save_tracks(tracks, work.folder)
    TrackedFrames(inputs.region, len(tracks), sum(map(len, tracks.values()))).save(work.folder)


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
            task=task, inputs=inputs, labels=arm.labels[task], navigation=outline.recipe.navigation
        )
        yield make_step(outline.names.tracks(arm.name, region, task), track_step, settings)
