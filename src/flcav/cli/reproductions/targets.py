"""Targets of `flcav reproduce`: their names, the options that each takes, and its number of seeds."""

from collections.abc import Mapping
from enum import StrEnum

from flcav.experiments.studies import STUDIES

RUN = ("jobs", "engine", "stale")  # options of targets that run as steps
STUDY = ("seeds", "scale", *RUN)  # options of targets that run over seeds
REAL = ("kitti", "data", "around", "weights")  # options of sim-to-real
TASK = "task-"  # before the name of a task's study
COMMON_SEEDS = 3


class Target(StrEnum):
    """Targets other than the tasks' studies."""

    corner_cases = "corner-cases"
    demo_arms = "demo-arms"
    distillation = "distillation"
    failure_search = "failure-search"
    federation_asynchrony = "federation-asynchrony"
    federation_exchange = "federation-exchange"
    federation_exchange_objects = "federation-exchange-objects"
    federation_faults = "federation-faults"
    federation_groups = "federation-groups"
    federation_leakage = "federation-leakage"
    federation_mixing = "federation-mixing"
    fig1b = "fig1b"
    fig3a = "fig3a"
    fig3b = "fig3b"
    fig4 = "fig4"
    fig6a_allocation = "fig6a-allocation"
    gap = "gap"
    lifelong = "lifelong"
    networks = "networks"
    placement = "placement"
    redundant_tasks = "redundant-tasks"
    road_average = "road-average"
    road_detector = "road-detector"
    safety_distance = "safety-distance"
    sensor_ranges = "sensor-ranges"
    sim_to_real = "sim-to-real"


RECORDED = (  # recordings, no training
    Target.fig3b,
    Target.fig4,
    Target.road_average,
    Target.road_detector,
    Target.sensor_ranges,
)
EXCHANGES: Mapping[str, str] = {  # recipe of each
    Target.federation_exchange: "exchange",
    Target.federation_exchange_objects: "exchange_objects",
}
DRIVES = (  # one recording or none, several seeds
    Target.federation_asynchrony,
    Target.federation_faults,
    Target.federation_groups,
    Target.federation_leakage,
    Target.federation_mixing,
)


class Scale(StrEnum):
    """Scale of a reproduction."""

    quick = "quick"
    paper = "paper"
    full = "full"


TARGETS: tuple[str, ...] = (*(target.value for target in Target), *(f"{TASK}{name}" for name in STUDIES))
TAKEN: Mapping[str, tuple[str, ...]] = dict.fromkeys(TARGETS, STUDY) | {
    Target.fig1b: (),
    Target.fig3a: (),
    **dict.fromkeys(RECORDED, ()),
    **dict.fromkeys(DRIVES, ("seeds",)),
    Target.failure_search: ("seeds", "scale"),
    Target.safety_distance: ("seeds", "scale", "jobs"),
    Target.sim_to_real: (*RUN, *REAL),
}
SEEDS: Mapping[str, int] = {
    **dict.fromkeys(
        (
            *(Target.demo_arms, Target.failure_search, Target.lifelong, Target.redundant_tasks),
            *(*EXCHANGES, *DRIVES),
        ),
        5,
    ),
    **dict.fromkeys((Target.corner_cases, Target.federation_exchange, Target.placement), 8),
    Target.federation_groups: 10,
}
