"""The outline of a run: the settings of its arms, the names of its steps, and inputs common to several steps."""

from collections.abc import Mapping
from pathlib import Path

from flcav.config import InputError, shorten
from flcav.dataset.layout import navigation_path, read_manifest, trace_path
from flcav.federation.strategies import sends_outputs
from flcav.fusion.average import ESTIMATED, NavigationErrors
from flcav.fusion.distillation import Distillation
from flcav.network.clock.rounds import NetworkSettings
from flcav.perception.client import check_network
from flcav.perception.tasks import task_named
from flcav.runs.arms import Names, Setting, name_repeat, resolve_settings
from flcav.runs.driving import fix_throughput
from flcav.runs.frames import count_training_frames
from flcav.runs.label_sources import LABEL_SOURCES, choose_labels
from flcav.runs.labels.tracks import WINDOW_EVERY_S, WINDOW_S
from flcav.runs.recipe import (
    ALL,
    CLOUD,
    EDGE,
    MAIN,
    MORE_EDGE,
    PRETRAIN,
    Region,
    Role,
    RunRecipe,
    SplitName,
    find_path,
)
from flcav.runs.spread import read_spreads
from flcav.runs.stages.settings import FederationSettings, LearningSettings, RegionInputs
from flcav.runs.training.learning import find_start
from flcav.statistics.streams import derive_seed

NAVIGATION_S = 20.0  # duration of navigation logs before the first frame [s]


class Outline:
    """The outline of a run: settings, names of steps, and common inputs.

    Towns, datasets and histories are searched in the folder `beside`. Raises `InputError` where a task, its network,
    its labels or a dataset cannot be used.
    """

    def __init__(self, recipe: RunRecipe, beside: Path) -> None:
        self.beside = beside.absolute()
        self.recipe = recipe = _fix_throughput(recipe, self.beside)
        for task, entry in recipe.tasks.items():
            check_network(task_named(task), entry.network)
        self.starts = {task: find_start(task_named(task), entry, self.beside) for task, entry in recipe.tasks.items()}
        self.settings = resolve_settings(recipe)
        for setting in self.settings.values():
            for task, kind in setting.labels.items():
                choose_labels(task, kind)
        self.names = Names(self.settings)
        self.spreads = read_spreads(recipe.spread, self.beside) if recipe.spread is not None else {}
        self.federating = recipe.with_role("federate")
        self.recorded = {name: self._count_frames(name) for name in self.federating if recipe.regions[name].data}
        for name in self.recorded if any(map(self.estimates, recipe.tasks)) else ():
            self._check_logs(recipe.regions[name])
        for name in self.recorded if any(map(self.hears, recipe.tasks)) else ():
            self._check_traffic(recipe.regions[name])

    def tested(self, arm: Setting) -> list[tuple[str, str, str]]:
        """Return stage, region and task of every test of an arm.

        Pretrained networks (of the run itself, and of arms with another one) and networks for all regions, by cloud FL
        or centralised training, are tested in every region; others in the regions that federate in the arm. The tests
        of a retraining are those of the arm itself.
        """
        tests = []
        main = name_repeat(MAIN, arm.repeat)
        for task in self.recipe.tasks:
            if arm.name == main or self.names.pretrain(arm.name, task) != self.names.pretrain(main, task):
                tests += [(PRETRAIN, region, task) for region in self.recipe.regions]
            for stage in arm.stages:
                where = tuple(self.recipe.regions) if stage == CLOUD or arm.central == ALL else arm.regions
                tests += [(stage, region, task) for region in where]
        return tests

    def models(self, arm: Setting, stage: str) -> tuple[str | None, ...]:
        """Return the models that a stage ends with: None for the common one, and regions with a personalised model."""
        return (None, *arm.regions) if stage == CLOUD and arm.federation.personal else (None,)

    def watched(self) -> list[tuple[str, str, str]]:
        """Return stage, region and task of the validations: of the main arm's stages in the federating regions."""
        main = self.settings[MAIN]
        stages = (PRETRAIN, *main.stages)
        return [(stage, region, task) for task in self.recipe.tasks for stage in stages for region in main.regions]

    @property
    def vehicles(self) -> dict[str, int]:
        """The number of vehicles by federating region."""
        known = {region: len(vehicles) for region, vehicles in self.recorded.items()}
        return {region: known.get(region) or self.recipe.vehicles(region) for region in self.federating}

    @property
    def placing_task(self) -> str:
        """The task whose recordings give the traffic density for the placement."""
        return (self.recipe.placement.tasks or tuple(self.recipe.tasks))[0]

    def sites(self, region: str) -> tuple[str, ...]:
        """Return the placement steps of a region, of all arms that federate there."""
        placed = [self.names.place(name, region) for name, arm in self.settings.items() if region in arm.regions]
        return tuple(dict.fromkeys(placed))

    def helped(self, task: str) -> bool:
        """Return whether the labels of a task come from roadside sensors in any arm."""
        return any(LABEL_SOURCES[arm.labels[task]].from_poles for arm in self.settings.values())

    def averaging(self, task: str) -> list[Distillation]:
        """Return the averaging of a task's labels, by arm that federates with the road average."""
        arms = [arm for arm in self.settings.values() if arm.central is None]
        return [arm.distillation for arm in arms if LABEL_SOURCES[arm.labels[task]].averaged]

    def tracks(self, task: str) -> bool:
        """Return whether vehicles label frames of a task by tracks in any arm."""
        return any(LABEL_SOURCES[arm.labels[task]].tracked for arm in self.settings.values())

    def hears(self, task: str) -> bool:
        """Return whether labels of a task come from vehicles that announce themselves in any arm."""
        return any(LABEL_SOURCES[arm.labels[task]].heard for arm in self.settings.values())

    def estimates(self, task: str) -> bool:
        """Return whether labels of a task are placed in vehicles' frames by estimated poses in any arm."""
        placed = any(LABEL_SOURCES[arm.labels[task]].placed for arm in self.settings.values())
        return placed and self.recipe.navigation == ESTIMATED

    def window_s(self, task: str) -> float:
        """Return the half width of the window recorded around a task's training frames for labels [s]; 0: none is.

        Raises `InputError` where arms have different windows, other than 0, and a region is recorded in a town.
        """
        tracked = {WINDOW_S} if self.tracks(task) else set[float]()
        windows = sorted(({average.window_s for average in self.averaging(task)} | tracked) - {0.0})
        # Arms share the recordings of a town, which have one window; in recorded data a window is chosen when read.
        if len(windows) > 1 and len(self.recorded) < len(self.federating):
            listed = " and ".join(f"{window_s:g} s" for window_s in windows)
            why = f" (labels by tracks: {WINDOW_S:g} s)" if tracked else ""
            raise InputError(f"distillation.window_s: arms have {listed}{why}; in a town all have one window, or 0")
        return max(windows, default=0.0)

    def window(self, task: str, role: Role, split: SplitName) -> Mapping[str, float]:
        """Return the fields of `flcav.sources.recipe.Recipe` for what a split records around its frames for labels.

        Apart from training frames, these are the validation frames of pretraining towns, by which the score threshold
        of tracks is chosen.
        """
        if not (split == EDGE or (self.tracks(task) and role == "pretrain" and split == "validation")):
            return {}
        window = {"window_s": self.window_s(task)}
        if split == EDGE and self.estimates(task):
            window |= {"navigation_s": NAVIGATION_S}
        if self.tracks(task):
            window |= {"window_every_s": WINDOW_EVERY_S}
            if split == EDGE and self.helped(task):
                window |= {"window_range_m": self.recipe.placement.group_range_m}
        return window

    def pools(self, task: str) -> dict[str, str]:
        """Return the names of the steps that record a task's candidates for upload, by region."""
        return {region: self.names.recording(region, "pool", task) for region in self.recipe.with_role("pretrain")}

    def learning(self, arm: Setting, task: str) -> LearningSettings:
        """Return the settings of an arm's training of a task; a retraining has another seed."""
        seed = self.recipe.seed
        return LearningSettings(
            task=task,
            network=self.recipe.tasks[task].network,
            training=arm.training[task],
            seed=derive_seed(seed, "retraining", arm.repeat) if arm.repeat else seed,
        )

    def inputs(self, arm: Setting, region: str, task: str, stage: str) -> RegionInputs:
        """Return the steps that a stage of a task in a region depends on; `stage` may also be TRACKING."""
        names = self.names
        tracked = LABEL_SOURCES[arm.labels[task]].tracked and stage in (EDGE, CLOUD, MORE_EDGE)
        return RegionInputs(
            region=region,
            plan=names.plan(arm.name, stage),
            pretrain=names.pretrain(arm.name, task),
            frames=names.recording(region, EDGE, task),
            place=names.place(arm.name, region),
            errors=names.errors(arm.name, region, task) if task in arm.placement.tasks else None,
            edge=names.edge(arm.name, region, task) if stage in (CLOUD, MORE_EDGE) else None,
            tracks=names.tracks(arm.name, region, task) if tracked else None,
            sites=self.sites(region) if self.helped(task) else (),
            group_range_m=self.recipe.placement.group_range_m,
            recorded=self.recipe.regions[region].data is not None,
            pools=self.pools(task) if sends_outputs(arm.federation.strategy) else {},
        )

    def federation(self, arm: Setting, task: str, stage: str) -> FederationSettings:
        """Return the settings that the federations of a stage of a task have in common."""
        recipe = self.recipe
        timed = arm.federation.network is not None
        given = {name: recipe.speeds(name) for name in self.federating}
        speeds = {f"{region}/{vehicle}": speed for region in given for vehicle, speed in given[region].items()}
        return FederationSettings(
            learning=self.learning(arm, task),
            federation=arm.federation if stage == CLOUD else arm.edge_federation,
            budgets_mb=recipe.budgets_mb,
            vehicles=self.vehicles,
            labels=arm.labels[task],
            fault=arm.fault,
            distillation=arm.distillation if LABEL_SOURCES[arm.labels[task]].averaged else None,
            messages=arm.messages if LABEL_SOURCES[arm.labels[task]].heard else None,
            navigation=recipe.navigation if LABEL_SOURCES[arm.labels[task]].placed else NavigationErrors(),
            train_s=recipe.tasks[task].train_s if timed else 0.0,
            speeds=speeds if timed else {},
        )

    def find_data(self, region: Region, split: SplitName) -> Path:
        """Return the folder of a region's recorded dataset for a split; raises `InputError` where there is none."""
        named = region.data[split] if isinstance(region.data, Mapping) else str(region.data)
        found = find_path(named, self.beside)
        if found is None or not found.is_dir():
            raise InputError(f"regions: there is no dataset folder {shorten(named)} in {self.beside}")
        return found.absolute()

    def _check_logs(self, region: Region) -> None:
        """Raise `InputError` where a scene of a region's training data has no navigation logs."""
        path = self.find_data(region, EDGE)
        for scene in read_manifest(path).scenes:
            if not (path / navigation_path(scene)).is_file():
                raise InputError(
                    f"{path}: navigation 'estimated' needs navigation logs, and '{scene}' has none; record with "
                    "'navigation_s', or state errors instead"
                )

    def _check_traffic(self, region: Region) -> None:
        """Raise `InputError` where a scene of a region's training data has no traffic whose vehicles send messages."""
        path = self.find_data(region, EDGE)
        for scene in read_manifest(path).scenes:
            if not (path / trace_path(scene)).is_file():
                raise InputError(
                    f"{path}: labels by messages need the traffic of a simulated town, and '{scene}' has none; take "
                    "other labels"
                )

    def _count_frames(self, region: str) -> dict[str, int]:
        place = self.recipe.regions[region]
        return count_training_frames(self.find_data(place, EDGE), self.recipe.seed, isinstance(place.data, Mapping))


def _fix_throughput(recipe: RunRecipe, beside: Path) -> RunRecipe:
    """Return the recipe with absolute paths and hashes of all files of measured rates, see `fix_throughput`."""

    def fix(network: NetworkSettings | None) -> NetworkSettings | None:
        return network and fix_throughput(network, beside)

    arms = dict(recipe.arms)
    for name, arm in arms.items():
        if arm.federation.get("network"):
            given = fix(NetworkSettings.model_validate(arm.federation["network"]))
            federation = {**arm.federation, "network": given and given.model_dump(mode="json")}
            arms[name] = arm.model_copy(update={"federation": federation})
    federation = recipe.federation.model_copy(update={"network": fix(recipe.federation.network)})
    return recipe.model_copy(update={"federation": federation, "arms": arms})
