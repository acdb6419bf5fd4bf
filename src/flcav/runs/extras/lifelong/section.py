"""Section of a run's page about lifelong learning."""

from dataclasses import dataclass
from typing import ClassVar

from flcav.runs.extras.lifelong.rows import LifelongArm, Passed
from flcav.runs.registry import Section
from flcav.runs.results.run import Run


@dataclass(frozen=True)
class LifelongSection(Section):
    """The values of the section."""

    template: ClassVar[str] = "lifelong/section.html.j2"
    chart: ClassVar[str] = "flcav.report.charts.lifelong:draw_lifelong"

    arms: tuple[LifelongArm, ...]
    conditions: tuple[tuple[LifelongArm, Passed], ...]  # in which vehicles asked


def describe_lifelong(run: Run) -> LifelongSection | None:
    """Return the section of a run; None where it has no lifelong learning."""
    if not run.lifelong:
        return None
    passed = tuple((arm, each) for arm in run.lifelong for each in arm.passed if each.asked)
    return LifelongSection(run.lifelong, passed)
