"""Planned uploads: the number of samples of each vehicle of the pretraining regions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from flcav.config import Config
from flcav.network.clock.rounds import NetworkSettings
from flcav.optimization.allocation.uploads import UploadDemand, share_by_held, share_by_links
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.prediction import measure_uplinks
from flcav.pipeline.frames import Frames
from flcav.pipeline.results.plans import Plan


class UploadSettings(Config):
    """Settings of planned uploads."""

    regions: tuple[str, ...]  # that pretrain
    network: NetworkSettings | None  # vehicles upload by what their uplinks carry; None: by the frames they have
    range_m: float  # of the traffic that the unit's pole is chosen by [m]


def plan_uploads(work: Work, plan: Plan, pools: Mapping[str, Sequence[str]], how: UploadSettings, seed: int) -> Plan:
    """Return the plan with the number of samples that each vehicle uploads, of every task.

    pools: by task the steps that recorded the pools, of the regions in `how`. With a `network` there, vehicles upload
    by what their uplinks carry, as measured in the pools of the first task; otherwise by the frames they have.
    """
    opened = {
        task: {region: Frames.open(work.inputs[step]) for region, step in zip(how.regions, steps, strict=True)}
        for task, steps in pools.items()
    }
    asked = {}
    for task, splits in opened.items():
        held = {name: len(frames) for region, split in splits.items() for name, frames in list_frames(region, split)}
        asked[task] = UploadDemand(plan.tasks[task].samples, plan.tasks[task].sample_mb, held)
    if how.network is None:
        shares = {task: share_by_held(own) for task, own in asked.items()}
    else:
        mbps: dict[str, float] = {}
        for region, split in next(iter(opened.values())).items():
            found = measure_uplinks(region, split, how.network, how.range_m, seed)
            mbps |= {name: found.get(name, 0.0) for own in asked.values() for name in own.held if _in(name, region)}
        shares = share_by_links(asked, mbps)
    return replace(plan, tasks={task: replace(own, uploads=shares[task]) for task, own in plan.tasks.items()})


def list_frames(region: str, split: Frames) -> list[tuple[str, list[int]]]:
    """Return the frames of each vehicle of a split, "region/vehicle", in the order of their names."""
    found: dict[str, list[int]] = {}
    for frame in split.vehicles:
        found.setdefault(f"{region}/{split.data.keys[frame].agent}", []).append(frame)
    return sorted(found.items())


def _in(vehicle: str, region: str) -> bool:
    return vehicle.startswith(f"{region}/")
