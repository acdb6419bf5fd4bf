"""Split 4 GB of wireless and 4 GB of wireline uplink over the three training stages of one task, then double both."""

from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.curves.curves import Additive, Decay
from flcav.optimization.problem import AllocationTask, Budgets, Limits, Problem

CURVE = Additive(
    floor=0.05,
    pretrain=Decay(a=0.51, b=0.10),  # error left after so many samples
    edge=Decay(a=0.20, b=0.50, x0=1),  # ... edge rounds
    cloud=Decay(a=0.10, b=0.50, x0=1),  # ... cloud rounds
)


def problem(budget_mb: float) -> Problem:
    task = AllocationTask(
        name="objects",
        sample_mb=1.6,
        model_mb=60,
        edge_groups=(4, 3),  # vehicles per edge server
        limits=Limits(samples=(100, 5000), edge_rounds=(0, 100), cloud_rounds=(0, 100)),
        curve=CURVE,
    )
    return Problem(budgets_mb=Budgets(wireless=budget_mb, wireline=budget_mb), tasks=(task,))


def main() -> None:
    for budget_mb in (4000, 8000):
        plan = allocate(problem(budget_mb))
        task = plan.tasks[0]
        print(
            f"{budget_mb} MB per link: {task.samples} samples, {task.edge_rounds} edge rounds, "
            f"{task.cloud_rounds} cloud rounds; error {plan.objective:.4f}, proven within {plan.gap:.1e}"
        )


if __name__ == "__main__":
    main()
