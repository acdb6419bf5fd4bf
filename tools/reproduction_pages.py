"""Fill the tables of a reproduction's page from its numbers: python tools/reproduction_pages.py reproductions/NAME.

A page (README.md) marks a table's place by `<!-- NAME -->` and `<!-- end -->`; the text between is replaced by the
table of that name, made from the folder's result.json, or from results.json where the page is of a run (`flcav run`);
where it is of a run's seeds, from theirs and summary.json. All other text stays.
"""

import functools
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from flcav.config import InputError, Json, read_json
from flcav.experiments import run_tables, seed_tables
from flcav.experiments.arms import tables as arms_tables
from flcav.experiments.arms.run import ArmsResult
from flcav.experiments.asynchrony.run import AsynchronyResult
from flcav.experiments.asynchrony.tables import asynchrony_tables
from flcav.experiments.attacks import tables as attack_tables
from flcav.experiments.attacks.faults import FaultsResult
from flcav.experiments.attacks.leakage import LeakageResult
from flcav.experiments.attacks.withstood import WithstoodResult
from flcav.experiments.corner_cases.run import CornerCaseResult
from flcav.experiments.corner_cases.tables import corner_case_tables
from flcav.experiments.distillation import tables as distillation_tables
from flcav.experiments.distillation.run import DistillationResult
from flcav.experiments.exchanges import tables as exchange_tables
from flcav.experiments.exchanges.run import ExchangeResult
from flcav.experiments.failure_search.run import FailureSearchResult
from flcav.experiments.failure_search.tables import failure_search_tables
from flcav.experiments.fig3a import tables as fig3a_tables
from flcav.experiments.fig3a.run import Fig3a
from flcav.experiments.fig3b import tables as fig3b_tables
from flcav.experiments.fig3b.run import Fig3b
from flcav.experiments.fig6a import tables as fig6a_tables
from flcav.experiments.fig6a.results import AllocationResult
from flcav.experiments.gap.run import GapResult
from flcav.experiments.gap.tables import gap_tables
from flcav.experiments.groups.run import GroupsResult
from flcav.experiments.groups.tables import groups_tables
from flcav.experiments.lifelong.run import LifelongResult
from flcav.experiments.lifelong.tables import lifelong_tables
from flcav.experiments.networks.run import NetworksResult
from flcav.experiments.networks.tables import networks_tables
from flcav.experiments.placement import tables as placement_tables
from flcav.experiments.placement.run import PlacementProof
from flcav.experiments.redundant_tasks.run import RedundantTasksResult
from flcav.experiments.redundant_tasks.tables import redundant_tasks_tables
from flcav.experiments.roadside import tables as roadside_tables
from flcav.experiments.roadside.average import RoadAverageResult
from flcav.experiments.roadside.detector import RoadDetectorResult
from flcav.experiments.roadside.fig4 import Fig4
from flcav.experiments.roadside.ranges import SensorRanges
from flcav.experiments.safety_distance.run import SafetyDistance
from flcav.experiments.safety_distance.tables import safety_tables
from flcav.experiments.sim_to_real import tables as sim_to_real_tables
from flcav.experiments.sim_to_real.run import SimToReal
from flcav.experiments.studies import objects, signs, trajectory, weather
from flcav.experiments.studies import objects as objects_tables
from flcav.experiments.studies import signs as signs_tables
from flcav.experiments.studies import trajectory as trajectory_tables
from flcav.experiments.studies import weather as weather_tables
from flcav.experiments.studies.run import EvaluationT, Study, StudyResult, results_of_json
from flcav.runs.results.run import Run, Summary
from flcav.runs.running import RESULTS, seed_folders
from flcav.storage.files import write_bytes
from flcav.storage.records import from_json

Tables = Mapping[str, str]
T = TypeVar("T")


def _told(kind: type[T], tables: Callable[[T], Tables]) -> Callable[[Json, str], Tables]:
    return lambda values, origin: tables(from_json(kind, values, origin))


def _of_study(
    study: Study[EvaluationT], tables: Callable[[StudyResult[EvaluationT]], Tables]
) -> Callable[[Json, str], Tables]:
    return lambda values, origin: tables(results_of_json(study, values, origin))


TABLES: Mapping[str, Callable[[Json, str], Tables]] = {  # by folder: tables of (content of its result.json, path)
    "asynchrony": _told(AsynchronyResult, asynchrony_tables),
    "corner-cases": _told(CornerCaseResult, corner_case_tables),
    "demo": _told(ArmsResult, arms_tables.tables),
    "gap": _told(GapResult, gap_tables),
    "distillation": _told(DistillationResult, distillation_tables.tables),
    "exchange": _told(ExchangeResult, exchange_tables.tables),
    "exchange-objects": _told(ExchangeResult, exchange_tables.tables),
    "failure-search": _told(FailureSearchResult, failure_search_tables),
    "faults": _told(FaultsResult, attack_tables.fault_tables),
    "fig3a": _told(Fig3a, fig3a_tables.tables),
    "fig3b": _told(Fig3b, fig3b_tables.tables),
    "fig4": _told(Fig4, roadside_tables.fig4_tables),
    "fig6a-allocation": _told(AllocationResult, fig6a_tables.tables),
    "groups": _told(GroupsResult, groups_tables),
    "lifelong": _told(LifelongResult, lifelong_tables),
    "leakage": _told(LeakageResult, attack_tables.leakage_tables),
    "mixing": _told(WithstoodResult, attack_tables.withstood_tables),
    "networks": _told(NetworksResult, networks_tables),
    "placement": _told(PlacementProof, placement_tables.tables),
    "redundant-tasks": _told(RedundantTasksResult, redundant_tasks_tables),
    "road-average": _told(RoadAverageResult, roadside_tables.average_tables),
    "road-detector": _told(RoadDetectorResult, roadside_tables.detector_tables),
    "safety-distance": _told(SafetyDistance, safety_tables),
    "sensor-ranges": _told(SensorRanges, roadside_tables.range_tables),
    "sim-to-real": _told(SimToReal, sim_to_real_tables.tables),
    "task-objects": _of_study(objects.STUDY, objects_tables.tables),
    "task-objects-streets": _of_study(objects.STREETS, objects_tables.tables),
    "task-signs": _of_study(signs.STUDY, signs_tables.tables),
    "task-trajectory": _of_study(trajectory.STUDY, trajectory_tables.tables),
    "task-trajectory-cameras": _of_study(trajectory.CAMERAS, trajectory_tables.tables),
    "task-weather": _of_study(weather.STUDY, weather_tables.tables),
}
_SPAN = re.compile(r"<!-- (?P<name>[a-z ]+) -->\n.*?<!-- end -->", re.DOTALL)


def fill(page: str, tables: Tables) -> str:
    """Return `page` with the text between marks replaced by the named tables; raises `InputError` for unknown names."""

    def filled(span: re.Match[str]) -> str:
        name = span["name"]
        if name not in tables:
            raise InputError(f"page: no table {name!r}, only {', '.join(tables)}")
        return f"<!-- {name} -->\n{tables[name]}\n<!-- end -->"

    return _SPAN.sub(filled, page)


@functools.cache
def tables_of(folder: Path) -> Tables:
    """Return the tables of a reproduction's folder as Markdown, by name."""
    if (folder / RESULTS).is_file():
        return run_tables.tables(Run.load(folder, RESULTS))
    if (folder / Summary.file).is_file():
        return seed_tables.tables(
            [Run.load(each) for _, each in sorted(seed_folders(folder).items())], Summary.load(folder)
        )
    path = folder / "result.json"
    return TABLES[folder.name](read_json(path), str(path))


def fill_folder(folder: Path) -> str:
    """Return the page of a reproduction with its tables filled in."""
    return fill((folder / "README.md").read_text(encoding="utf-8"), tables_of(folder))


def main(folders: Sequence[str]) -> None:
    """Fill the tables of the folders' pages."""
    for folder in map(Path, folders):
        write_bytes(folder / "README.md", fill_folder(folder).encode())


if __name__ == "__main__":
    main(sys.argv[1:])
