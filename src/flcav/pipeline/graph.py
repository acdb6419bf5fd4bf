"""The dependency graph of a run's steps, for every task, region and arm; arms that agree on a step share it.

The order is: plan, pretrain, register errors, place sensors, edge FL, cloud FL, test.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flcav.config import InputError, shorten
from flcav.federation.strategies import sends_outputs
from flcav.pipeline.arms import Names, Setting, name_repeat, resolve_settings
from flcav.pipeline.frames import count_training_frames, hash_manifest, hash_town, recording_fields
from flcav.pipeline.labels import LABEL_SOURCES, choose_labels
from flcav.pipeline.planning import UpdateForm, read_history, update_forms
from flcav.pipeline.recipe import (
    CENTRAL,
    CLOUD,
    EDGE,
    MAIN,
    MORE_EDGE,
    PRETRAIN,
    SPLITS_OF,
    Region,
    RunRecipe,
    SplitName,
    find_path,
)
from flcav.pipeline.seeds.spread import read_spreads
from flcav.pipeline.steps import Step
from flcav.pipeline.work.placing import errors_step, place_step
from flcav.pipeline.work.planning import plan_step, replan_step
from flcav.pipeline.work.recording import deal_step, record_step
from flcav.pipeline.work.testing import look_step, rounds_step, test_step
from flcav.pipeline.work.training import central_step, cloud_step, edge_step, pretrain_step
from flcav.seeds import derive_seed

LOOK, OBJECTS = "look", "objects"


class Graph:
    """The steps of a recipe in topological order: each comes after those it needs.

    `beside` is the folder that towns, datasets and histories are looked for in. Raises `InputError` where a task, its
    labels, a town or a dataset cannot be used.
    """

    def __init__(self, recipe: RunRecipe, beside: Path) -> None:
        self.recipe, self.beside = recipe, beside.absolute()
        labels = {task: choose_labels(task, own.labels) for task, own in recipe.tasks.items()}
        self.settings = resolve_settings(recipe, labels)
        for setting in self.settings.values():
            for task, kind in setting.labels.items():
                choose_labels(task, kind)
        self.names = Names(self.settings)
        self.spreads = read_spreads(recipe.spread, self.beside) if recipe.spread is not None else {}
        self.federating = recipe.with_role("federate")
        self.recorded = {name: self._count_frames(name) for name in self.federating if recipe.regions[name].data}
        self._steps: dict[str, Step] = {}
        self._add_recordings()
        for arm in self.settings.values():
            self._add_start(arm)
        if self.settings[MAIN].replanned:
            self._add_replan(PRETRAIN)
        for region in self.federating:
            for task in recipe.tasks:
                self._add(self._recording(region, EDGE, task, self.sites(region)))
        for arm in self.settings.values():
            self._add_edge(arm)
        if self.settings[MAIN].replanned:
            self._add_replan(EDGE)
        for arm in self.settings.values():
            self._add_further(arm)
            self._add_tests(arm)

    @property
    def steps(self) -> tuple[Step, ...]:
        """Return the steps in topological order."""
        return tuple(self._steps.values())

    def sites(self, region: str) -> tuple[str, ...]:
        """Return the placement steps of a region, of all arms that federate there."""
        placed = [self.names.place(name, region) for name, arm in self.settings.items() if region in arm.regions]
        return tuple(dict.fromkeys(placed))

    def tested(self, arm: Setting) -> list[tuple[str, str, str]]:
        """Return stage, region and task of every test of an arm.

        Pretrained networks (of the run itself, and others) and those of cloud FL are tested in every region, others in
        the regions that federate in the arm. Of a retraining it is what it is of the arm itself.
        """
        tests, main = [], name_repeat(MAIN, arm.repeat)
        for task in self.recipe.tasks:
            if arm.name == main or self.names.pretrain(arm.name, task) != self.names.pretrain(main, task):
                tests += [(PRETRAIN, region, task) for region in self.recipe.regions]
            for stage in arm.stages:
                where = tuple(self.recipe.regions) if stage == CLOUD else arm.regions
                tests += [(stage, region, task) for region in where]
        return tests

    def models(self, arm: Setting, stage: str) -> tuple[str | None, ...]:
        """Return whose models a stage ends with: None for the federation's, and regions that keep arrays."""
        return (None, *arm.regions) if stage == CLOUD and arm.federation.personal else (None,)

    def watched(self) -> list[tuple[str, str, str]]:
        """Return stage, region and task of what is validated in each federating region: the main arm's stages."""
        main = self.settings[MAIN]
        stages = (PRETRAIN, *main.stages)
        return [(stage, region, task) for task in self.recipe.tasks for stage in stages for region in main.regions]

    def _add_watched(self, stage: str, task: str) -> list[str]:
        """Add the validations of a stage in the federating regions, and return their names."""
        added = []
        for region in self.settings[MAIN].regions:
            trained = self.names.stage(MAIN, stage, region, task)
            frames = self.names.recording(region, "validation", task)
            training, start = self.settings[MAIN].training[task], self.names.pretrain(MAIN, task)
            watched = {"task": task, "region": region, "stage": stage, "start": start, "trained": trained}
            share = training.start_share if stage == EDGE else 0.0
            arguments = watched | {"frames": frames, "averaged": training.average_rounds, "share": share}
            added.append(self.names.rounds(trained, region))
            self._add(_step(added[-1], rounds_step, arguments, [start, trained, frames]))
        return added

    def _add(self, step: Step) -> None:
        self._steps.setdefault(step.name, step)

    def _add_recordings(self) -> None:
        for region, own in self.recipe.regions.items():
            for split in SPLITS_OF[own.role]:
                for task in self.recipe.tasks:
                    if split == "registry" and task not in self.recipe.placement.tasks and not self._first(task):
                        continue
                    if split != EDGE:
                        self._add(self._recording(region, split, task, ()))

    def _first(self, task: str) -> bool:
        """Return whether the traffic recorded for this task is the one whose density the placement uses."""
        return task == (self.recipe.placement.tasks or tuple(self.recipe.tasks))[0]

    def _recording(self, region: str, split: SplitName, task: str, places: Sequence[str]) -> Step:
        own, name = self.recipe.regions[region], self.names.recording(region, split, task)
        if own.data is not None:
            path = self._folder_of(own, split)
            dealt = {"path": str(path), "split": split, "role": own.role, "seed": self.recipe.seed}
            whole = isinstance(own.data, Mapping)
            return _step(name, deal_step, dealt | {"whole": whole, "version": hash_manifest(path)}, ())
        fields = recording_fields(self.recipe, region, split, task)
        helped = any(LABEL_SOURCES[arm.labels[task]].from_poles for arm in self.settings.values())
        seen = list(places) if helped else []
        version = hash_town(fields["town"], self.beside)
        beside = str(self.beside) if version else ""  # a town of the package depends on no folder
        arguments = {"fields": fields, "beside": beside, "places": seen, "version": version}
        return _step(name, record_step, arguments, seen)

    def _count_frames(self, region: str) -> dict[str, int]:
        own = self.recipe.regions[region]
        return count_training_frames(self._folder_of(own, EDGE), self.recipe.seed, isinstance(own.data, Mapping))

    def _folder_of(self, region: Region, split: SplitName) -> Path:
        named = region.data[split] if isinstance(region.data, Mapping) else str(region.data)
        found = find_path(named, self.beside)
        if found is None or not found.is_dir():
            raise InputError(f"regions: there is no dataset folder {shorten(named)} in {self.beside}")
        return found.absolute()

    def _air(self) -> dict[str, Any]:
        """Return what a plan within a horizon predicts times on the network from; nothing without a network."""
        network = self.recipe.federation.network
        if network is None or self.recipe.horizon_s is None:
            return {}
        first = next(task for task in self.recipe.tasks if self._first(task))
        drives = {region: self.names.recording(region, "registry", first) for region in self.federating}
        how = {"network": network.model_dump(mode="json"), "range_m": self.recipe.placement.range_m}
        return {"air": how | {"drives": drives}}

    def _histories(self) -> dict[str, str]:
        """Return the learning history (CSV) of each task that has one, as text: another text, another plan."""
        own = {name: task.history for name, task in self.recipe.tasks.items()}
        return {name: read_history(name, history, self.beside) for name, history in own.items() if history is not None}

    def _learning(self, arm: Setting, task: str) -> dict[str, Any]:
        """Return the settings of `flcav.pipeline.stages.Learning`; a retraining has a seed of its own."""
        seed = self.recipe.seed
        return {
            "task": task,
            "network": self.recipe.tasks[task].network,
            "training": arm.training[task].model_dump(mode="json"),
            "seed": derive_seed(seed, "retraining", arm.repeat) if arm.repeat else seed,
        }

    @property
    def _budget_mb(self) -> list[float]:
        return [self.recipe.budgets_mb.wireless, self.recipe.budgets_mb.wireline]

    def _add_start(self, arm: Setting) -> None:
        """Add the steps before a federation: plan, stage I, registration of errors, placement of sensors."""
        recipe, names = self.recipe, self.names
        starts = recipe.with_role("pretrain")
        pools = {task: [names.recording(region, "pool", task) for region in starts] for task in recipe.tasks}
        others = {
            "retrainings",
            "spread",
            "test_draw",
            "replan",
            "uploads",
            "arms",
            "training",
            "recording",
            "placement",
            "distillation",
        }
        asked = recipe.model_dump(mode="json", exclude=others)
        asked["splits"] = recipe.sized_splits.model_dump(mode="json")
        asked["placement"] = {"tasks": []}  # not part of the plan; the default would depend on objects
        asked["federation"] = {"edge_rounds_per_cloud_round": recipe.federation.edge_rounds_per_cloud_round}
        planned = {"recipe": asked, "rule": arm.plan, "pools": pools, "histories": self._histories()}
        if (forms := update_forms(self.settings.values())) != [UpdateForm()]:
            planned["updates"] = [form.model_dump(mode="json") for form in forms]
        if recipe.uploads == "planned":
            network = recipe.model_dump(mode="json")["federation"]["network"]
            planned["uploads"] = {"regions": starts, "network": network, "range_m": recipe.placement.range_m}
        if self.recorded:
            planned["recorded"] = self.recorded
        planned |= self._air()
        plan = names.plan(arm.name)
        needs = [step for steps in pools.values() for step in steps]
        needs += planned["air"]["drives"].values() if "air" in planned else ()
        self._add(_step(plan, plan_step, planned, needs))
        for task in recipe.tasks:
            own = {region: names.recording(region, "pool", task) for region in starts}
            validation = [names.recording(region, "validation", task) for region in starts]
            thresholded = any(LABEL_SOURCES[each.labels[task]].from_detections for each in self.settings.values())
            arguments = {"plan": plan, "pools": own, "validation": validation, "budget_mb": self._budget_mb}
            step = names.pretrain(arm.name, task)
            arguments |= {"thresholded": thresholded, **self._learning(arm, task), "upload_seed": recipe.seed}
            self._add(_step(step, pretrain_step, arguments, [plan, *own.values(), *validation]))
        for region in arm.regions:
            self._add_placement(arm, region)

    def _add_replan(self, stage: str) -> None:
        """Add the step that plans the rest of the run anew after stage I or II, from what the run itself reached."""
        names, main = self.names, self.settings[MAIN]
        tasks = [name for name, task in self.recipe.tasks.items() if task.history is not None]
        watched = {task: self._add_watched(stage, task) for task in tasks}
        books = {task: [names.pretrain(MAIN, task)] for task in tasks}
        if stage == EDGE:
            for task, steps in books.items():
                steps += [names.edge(MAIN, region, task) for region in main.regions]
        first, plan = names.plan(MAIN), names.plan(MAIN, stage)
        arguments: dict[str, Any] = {"first": first, "plan": plan, "stage": stage, "watched": watched, "books": books}
        if stage == EDGE and main.by_round:
            arguments["edges"] = {task: [names.edge(MAIN, region, task) for region in main.regions] for task in tasks}
        needs = [first, plan, *(step for each in (watched, books) for steps in each.values() for step in steps)]
        self._add(_step(names.plan(MAIN, CLOUD if stage == EDGE else EDGE), replan_step, arguments, needs))

    def _replan(self, arm: Setting, task: str, stage: str, region: str | None, own: str) -> dict[str, Any]:
        """Return how the step `own` plans its rest anew after each round; nothing where it does not.

        The run itself plans, of stage II each region for itself; others keep to its rounds: further edge rounds to the
        number of its stage III.
        """
        if not arm.by_round or self.recipe.tasks[task].history is None:
            return {}
        names = self.names
        how: dict[str, Any] = {"vehicles": self._vehicles(), "headroom": self.recipe.headroom}
        ours = names.edge(MAIN, region, task) if stage == EDGE and region else names.cloud(MAIN, task)
        if own != ours:
            return {"replan": how | {"follows": ours}}
        watched = {name: names.recording(name, "validation", task) for name in ([region] if region else arm.regions)}
        return {"replan": how | {"first": names.plan(MAIN), "frames": watched}}

    def _add_placement(self, arm: Setting, region: str) -> None:
        names, errors = self.names, {}
        for task in arm.placement.tasks:
            pretrained, registry = names.pretrain(arm.name, task), names.recording(region, "registry", task)
            errors[task] = names.errors(arm.name, region, task)
            plan, own = names.plan(arm.name), {"vehicles": self._vehicles(), "budget_mb": self._budget_mb}
            arguments = {"task": task, "region": region, "pretrained": pretrained, "registry": registry, "plan": plan}
            self._add(_step(errors[task], errors_step, arguments | own, [pretrained, registry, plan]))
        first = (self.recipe.placement.tasks or tuple(self.recipe.tasks))[0]
        registry = names.recording(region, "registry", first)
        edge = names.recording(region, EDGE, first) if self.recipe.regions[region].data is not None else None
        if edge is not None:
            self._add(self._recording(region, EDGE, first, ()))
        weights = {task: self.recipe.tasks[task].weight for task in errors}
        arguments = {
            "region": region,
            "how": arm.placement.model_dump(mode="json", exclude=None if arm.placement.poles else {"poles"}),
            "errors": errors,
            "weights": weights,
            "registry": registry,
            "edge": edge,
        }
        if arm.placement.rule == "random":
            arguments["seed"] = self.recipe.seed
        needs = [*errors.values(), registry, *([edge] if edge else [])]
        self._add(_step(names.place(arm.name, region), place_step, arguments, needs))

    def _rests_on(self, arm: Setting, region: str, task: str, stage: str) -> dict[str, Any]:
        """Return the steps and settings that a stage and its labelled samples depend on, see `flcav.pipeline.work`."""
        names = self.names
        helped = any(LABEL_SOURCES[each.labels[task]].from_poles for each in self.settings.values())
        reported = {"errors": names.errors(arm.name, region, task)} if task in arm.placement.tasks else {}
        if sends_outputs(arm.federation.strategy):
            reported |= {"pools": self._pools(task)}  # shared frames are drawn from them
        return reported | {
            "plan": names.plan(arm.name, stage),
            "pretrain": names.pretrain(arm.name, task),
            "frames": names.recording(region, EDGE, task),
            "place": names.place(arm.name, region),
            "sites": list(self.sites(region)) if helped else [],
            "group_range_m": self.recipe.placement.group_range_m,
            "recorded": self.recipe.regions[region].data is not None,
        }

    def _federation(self, arm: Setting, task: str, stage: str) -> dict[str, Any]:
        """Return the settings that a federated stage of a task depends on."""
        federation = (arm.federation if stage == CLOUD else arm.edge_federation).model_dump(mode="json")
        own = {"labels": arm.labels[task], "federation": federation, "budget_mb": self._budget_mb}
        if LABEL_SOURCES[arm.labels[task]].averaged:
            own["distillation"] = arm.distillation.model_dump(mode="json")
        if arm.federation.network is not None:
            given = {name: self.recipe.regions[name].speed for name in self.recipe.with_role("federate")}
            speeds = {f"{region}/{vehicle}": speed for region in given for vehicle, speed in given[region].items()}
            own |= {"train_s": self.recipe.tasks[task].train_s, "speeds": speeds}
        return self._learning(arm, task) | own

    def _add_edge(self, arm: Setting) -> None:
        """Add stage II of an arm, or its centralised training."""
        for task in self.recipe.tasks:
            for region in arm.regions:
                if arm.central:
                    self._add(self._central(arm, region, task))
                    continue
                steps = self._rests_on(arm, region, task, EDGE)
                name = self.names.edge(arm.name, region, task)
                own: dict[str, Any] = {"region": region, "vehicles": self._vehicles(), "steps": steps}
                own |= self._replan(arm, task, EDGE, region, name)
                if self._scored(task):
                    own["scored"] = True
                self._add(_step(name, edge_step, self._federation(arm, task, EDGE) | own, _named_in(steps, own)))

    def _scored(self, task: str) -> bool:
        """Return whether labels are compared with ground truth: in runs with an arm of federated distillation."""
        return any(LABEL_SOURCES[arm.labels[task]].averaged for arm in self.settings.values())

    def _add_further(self, arm: Setting) -> None:
        """Add what follows stage II: stage III or further edge rounds."""
        names = self.names
        for task in self.recipe.tasks:
            last = next((stage for stage in (CLOUD, MORE_EDGE) if stage in arm.stages), None)
            if last is None:
                continue
            edges = {
                region: self._rests_on(arm, region, task, last) | {"edge": names.edge(arm.name, region, task)}
                for region in arm.regions
            }
            if last == CLOUD:
                needs = [step for steps in edges.values() for step in _named_in(steps)]
                arguments = self._federation(arm, task, last) | {"regions": edges}
                arguments |= self._replan(arm, task, CLOUD, None, names.cloud(arm.name, task))
                needs += _named_in({}, arguments)
                self._add(_step(names.cloud(arm.name, task), cloud_step, arguments, needs))
                continue
            for region, steps in edges.items():
                name, own = names.more_edge(arm.name, region, task), self._federation(arm, task, last)
                more = own | {"region": region, "vehicles": self._vehicles(), "steps": steps}
                more |= self._replan(arm, task, MORE_EDGE, region, name)
                self._add(_step(name, edge_step, more, _named_in(steps, more)))

    def _central(self, arm: Setting, region: str, task: str) -> Step:
        steps = self._rests_on(arm, region, task, CENTRAL)
        pools = self._pools(task)
        arguments = {
            **self._learning(arm, task),
            "region": region,
            "vehicles": self._vehicles()[region],
            "source": arm.central,
            "steps": steps | {"pools": pools},
        }
        by_round = arm.by_round and self.recipe.tasks[task].history is not None
        follows = {"follows": self.names.edge(MAIN, region, task)} if by_round else {}
        arguments |= follows
        needs = [*_named_in(steps), *pools.values(), *follows.values()]
        return _step(self.names.central(arm.name, region, task), central_step, arguments, needs)

    def _pools(self, task: str) -> dict[str, str]:
        """Return the steps that record a task's candidates for upload, by region."""
        return {region: self.names.recording(region, "pool", task) for region in self.recipe.with_role("pretrain")}

    @property
    def shown(self) -> tuple[str, str] | None:
        """Return the region and the stage whose sweep is shown before and after; None where no objects are learned."""
        main = self.settings[MAIN]
        return (main.regions[0], main.stages[-1]) if OBJECTS in self.recipe.tasks else None

    def _vehicles(self) -> dict[str, int]:
        known = {region: len(vehicles) for region, vehicles in self.recorded.items()}
        return {region: known.get(region) or self.recipe.vehicles(region) for region in self.federating}

    def _add_tests(self, arm: Setting) -> None:
        for stage, region, task in self.tested(arm):
            trained = self.names.stage(arm.name, stage, region, task)
            frames = self.names.recording(region, "test", task)
            arguments = {"task": task, "region": region, "trained": trained, "frames": frames}
            arguments |= {"seed": self.recipe.seed}
            for model in self.models(arm, stage):
                step = self.names.test(trained, region, model)
                self._add(_step(step, test_step, arguments | {"model": model}, [trained, frames]))
        if arm.name == MAIN:
            if self.shown is not None:
                region, stage = self.shown
                before, after = (self.names.stage(MAIN, each, region, OBJECTS) for each in (PRETRAIN, stage))
                frames = self.names.recording(region, "test", OBJECTS)
                arguments = {"before": before, "after": after, "frames": frames}
                self._add(_step(LOOK, look_step, arguments, [before, after, frames]))
            for stage in (PRETRAIN, *arm.stages):
                for task in self.recipe.tasks:
                    self._add_watched(stage, task)


def _step(name: str, function: Callable[..., None], arguments: Mapping[str, Any], needs: Sequence[str]) -> Step:
    return Step(name, function, dict(arguments), tuple(dict.fromkeys(needs)))


def _named_in(steps: Mapping[str, Any], arguments: Mapping[str, Any] = {}) -> list[str]:
    """Return the names of the steps in what `Graph._rests_on` returned; for stage III also that of stage II.

    Of a step's arguments also those in `replan`.
    """
    one = [steps[key] for key in ("plan", "pretrain", "errors", "frames", "place", "edge") if key in steps]
    replan: Mapping[str, Any] = arguments.get("replan", {})
    replanned = [replan[key] for key in ("first", "follows") if key in replan]
    given = (*steps.get("sites", ()), *steps.get("pools", {}).values())
    return [*one, *given, *replanned, *replan.get("frames", {}).values()]
