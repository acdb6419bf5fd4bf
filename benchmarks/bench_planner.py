"""What the planner computes while somebody drags, places and plans: CPU time [ms] of one core, medians, in process.

The aims are those of the page: counts within 50 ms, an optimum within 200 ms for 1,000 errors, a plan within 300 ms.
How long the page takes to draw what it is given is printed by `make test-planner`.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from cpu_time import cpu_ms

from flcav.optimization.graph import load_problem
from flcav.planner.desk import lay_out, with_errors
from flcav.planner.placing import Kinds, Question, Workspace, find_best, find_new_poles, look, trace_curve
from flcav.planner.planning import plan_budgets, plan_more, with_budgets
from flcav.world.map.town import load_town

PROBLEM = Path(__file__).parents[1] / "recipes" / "allocation" / "three_tasks.yaml"
ONE = Question(Kinds(("sensor",), (40.0,), (0.0,)))
THREE = Question(Kinds(("near", "middle", "far"), (30.0, 45.0, 70.0), (1.0, 1.8, 3.5)))


def draw_errors(count: int, path: Path) -> Path:
    """Write errors along the streets of the grid, reproducibly."""
    rng, roads = np.random.default_rng(2), load_town("grid").roads
    lines = ["x,y,z"]
    for _ in range(count):
        road = roads[rng.integers(len(roads))]
        x, y = np.mean(road[rng.integers(len(road), size=2)], axis=0)
        lines.append(f"{x:.2f},{y:.2f},0.8")
    path.write_text("\n".join(lines) + "\n")
    return path


def measure_town(space: Workspace) -> dict[str, float]:
    """Return the CPU time [ms] of each answer about a town with errors."""
    rng, rows = np.random.default_rng(1), list(range(len(space.errors)))

    def drag() -> None:
        x, y = space.sites.xyz[0, :2] + rng.uniform(-15, 15, 2)
        look(space, (x, y, 6.0), 40.0, True)

    works = {
        "a visible area and its errors": drag,
        "the optimum of three": lambda: find_best(space, ONE, count=3),
        "the optimum of three kinds within a cost": lambda: find_best(space, THREE, budget=6.0),
        "the curve": lambda: trace_curve(space, ONE),
        "new poles": lambda: find_new_poles(space, ONE, 0, rows),
    }
    return dict(zip(works, cpu_ms([*works.values()], 7), strict=True))


def main() -> None:
    """Print the times, and that from an empty desk to the first town."""
    start = time.process_time()
    town = load_town("grid")
    print(f"{'the town, from its net':<44}{1e3 * (time.process_time() - start):7.0f} ms")
    with tempfile.TemporaryDirectory() as folder:
        for count in (113, 1000):
            space = with_errors(lay_out(town), draw_errors(count, Path(folder) / f"{count}.csv"))
            for name, taken in measure_town(space).items():
                print(f"{name + f', {count} errors':<58}{taken:7.1f} ms")
    problem = load_problem(PROBLEM)
    wireless, wireline = problem.budgets_mb.wireless, problem.budgets_mb.wireline
    for share in (0.5, 1.0, 2.0):
        budgets = with_budgets(problem, share * wireless, share * wireline, None)
        plan, more = cpu_ms([lambda: plan_budgets(budgets), lambda: plan_more(budgets)], 3)  # noqa: B023
        print(f"{f'a plan of three tasks, {share:g} of the budgets':<58}{plan:7.1f} ms; what more buys {more:.1f} ms")


if __name__ == "__main__":
    main()
