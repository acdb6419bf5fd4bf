"""The section of a run's page about the partition of its vehicles' data."""

from dataclasses import dataclass
from typing import ClassVar

from flcav.runs.extras.partition.rows import Partitioned
from flcav.runs.registry import PageSection
from flcav.runs.results.run import Run


@dataclass(frozen=True)
class PartitionSection(PageSection):
    """Values of the report's section on partitions."""

    template: ClassVar[str] = "partition/section.html.j2"
    chart: ClassVar[str] = "flcav.report.charts.partition:draw_partitions"

    dealt: tuple[tuple[str, str, str, Partitioned], ...]  # arm, region, task


def list_partitions(run: Run) -> tuple[tuple[str, str, str, Partitioned], ...]:
    """Return arm, region, task and partition of all stages II whose samples were dealt."""
    return tuple(
        (name, stage.region or "", stage.task, stage.partition)
        for name, arm in run.arms.items()
        for stage in arm.stages
        if stage.partition is not None
    )


def describe_partitions(run: Run) -> PartitionSection | None:
    """Return the section of a run; None where all vehicles keep what they recorded."""
    dealt = list_partitions(run)
    return PartitionSection(dealt) if dealt else None
