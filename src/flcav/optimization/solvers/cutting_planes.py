"""Integer programs of convex and concave terms under linear budgets, by outer approximation with HiGHS.

The method is that of Duran and Grossmann (1986). Each convex term is bounded from below by linear cuts: tangents, or
secants through neighbouring whole numbers. With the cuts in place of the terms, the problem is a (mixed-integer) linear
program. Its optimum is a proven lower bound, and the next cuts are added at its solution.

Concave terms are functions of one quantity. Every whole number j in its range has a variable w_j in [0, 1]: the w_j sum
to 1, j w_j sums to the quantity, and the term is the sum of its values at j times w_j. For integral w that is exact; in
the continuous relaxation it is the term's convex envelope, and so a lower bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, OptimizeResult, milp
from scipy.sparse import coo_array, csr_array

from flcav.geometry.arrays import Array
from flcav.optimization.solvers.instance import require_optimum

LARGE = 1e4  # size to which the objective is scaled: the solver's tolerances are absolute, around 1e-6


class Line(NamedTuple):
    """A cut: the linear lower bound value + slope . x[of] of a convex term."""

    of: tuple[int, ...]  # indices of the quantities
    slope: tuple[float, ...]  # by each of them
    value: float  # at x[of] = 0


class Term(Protocol):
    """A convex function of some quantities, with its cuts."""

    def value(self, x: Array) -> float:
        """Return the value of the term at x (n,)."""
        ...

    def lines(self, x: Array) -> list[Line]:
        """Return cuts that are tight at x (n,) or at its whole neighbours."""
        ...


class Concave(Protocol):
    """A concave function of one quantity."""

    @property
    def index(self) -> int:
        """Index of the quantity."""
        ...

    def at(self, quantity: Array) -> Array:
        """Return the values of the term (m,) where its quantity is `quantity` (m,)."""
        ...


@dataclass(frozen=True)
class Program:
    """An integer program: minimise the sum of all terms over integers x in [low, high] with x @ cost <= budget."""

    terms: Sequence[Term]
    low: Array  # (n,) least of each quantity
    high: Array  # (n,) most of each quantity
    cost: Array  # (n, L) of one unit under each budget
    budget: Array  # (L,)
    concave: Sequence[Concave] = ()

    def value(self, x: Array) -> float:
        """Return the objective at x (n,)."""
        return sum(term.value(x) for term in self.terms) + sum(float(term.at(x[term.index])) for term in self.concave)


class Cuts:
    """The linear program of the cuts added so far to a `Program`, which bounds it from below."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self._lines: dict[tuple[int, Line], None] = {}
        self._scale = LARGE / max(program.value(program.low), 1e-12)
        self._steps = [np.arange(program.low[term.index], program.high[term.index] + 1) for term in program.concave]

    def add(self, x: Array) -> bool:
        """Add the cuts at x (n,); return whether any was new."""
        known = len(self._lines)
        for number, term in enumerate(self.program.terms):
            self._lines.update(dict.fromkeys((number, line) for line in term.lines(x)))
        return len(self._lines) > known

    def relax(self) -> tuple[Array, float]:
        """Return the optimum x (n,) of the continuous relaxation, and its value; raises `InputError` if HiGHS fails."""
        result = self._minimise(np.zeros(len(self._low())))
        return require_optimum(result)[: len(self.program.low)], float(result.fun) / self._scale

    def solve(self, gap: float) -> tuple[Array, float]:
        """Return the optimal integers x (n,) to a relative `gap`, and the proven lower bound.

        Raises `InputError` where HiGHS fails.
        """
        whole = np.r_[np.ones(len(self.program.low)), np.zeros(len(self.program.terms)), np.ones(self._tabulated)]
        result = self._minimise(whole, gap)
        return np.round(require_optimum(result)[: len(self.program.low)]), float(result.mip_dual_bound) / self._scale

    def _minimise(self, whole: Array, gap: float = 0.0) -> OptimizeResult:
        """Return HiGHS's optimum to a relative `gap`, where `whole` variables are integers."""
        matrix, limit = self._rows()
        equal, total = self._equations()
        constraints = [LinearConstraint(matrix, ub=limit)]  # pyright: ignore[reportArgumentType]
        if equal is not None:
            constraints.append(LinearConstraint(equal, total, total))  # pyright: ignore[reportArgumentType]
        return milp(
            self._objective(),
            integrality=whole,
            bounds=Bounds(self._low(), self._high()),  # pyright: ignore[reportArgumentType]
            constraints=constraints,
            options={"mip_rel_gap": gap},
        )

    @property
    def _tabulated(self) -> int:
        """Number of the variables of concave terms."""
        return sum(map(len, self._steps))

    def _objective(self) -> Array:
        tables = [self._scale * term.at(steps) for term, steps in zip(self.program.concave, self._steps)]
        return np.r_[np.zeros(len(self.program.low)), np.ones(len(self.program.terms)), *tables]

    def _low(self) -> Array:
        return np.r_[self.program.low, np.zeros(len(self.program.terms) + self._tabulated)]

    def _high(self) -> Array:
        return np.r_[self.program.high, np.full(len(self.program.terms), np.inf), np.ones(self._tabulated)]

    def _equations(self) -> tuple[csr_array | None, Array | None]:
        """Return the equations of the concave terms, as a matrix and the right-hand side; None where there are none."""
        if not self._steps:
            return None, None
        column = len(self.program.low) + len(self.program.terms)
        rows = np.zeros((2 * len(self._steps), column + self._tabulated))
        for i, (term, steps) in enumerate(zip(self.program.concave, self._steps)):
            columns = slice(column, column + len(steps))
            rows[2 * i, columns], rows[2 * i + 1, columns] = 1.0, steps
            rows[2 * i + 1, term.index] = -1.0
            column += len(steps)
        return csr_array(rows), np.tile((1.0, 0.0), len(self._steps))

    def _rows(self) -> tuple[csr_array, Array]:
        """Return the constraint matrix over (quantities, terms, variables of concave terms) and its upper limits.

        Its rows are the budgets, scaled to 1, then slope . x - term <= -value for every cut.
        """
        program, n, budgets = self.program, len(self.program.low), len(self.program.budget)
        budget = np.repeat(np.arange(budgets), n)
        quantity = np.tile(np.arange(n), budgets)
        rows, columns, values = [*budget], [*quantity], [*(program.cost / program.budget).T.ravel()]
        for row, (number, line) in enumerate(self._lines, start=budgets):
            rows += [row] * (len(line.of) + 1)
            columns += [*line.of, n + number]
            values += [*(self._scale * slope for slope in line.slope), -1.0]
        limit = np.r_[np.ones(budgets), [-self._scale * line.value for _, line in self._lines]]
        return coo_array((values, (rows, columns)), shape=(len(limit), len(self._low()))).tocsr(), limit


def continuous_optimum(
    program: Program, starts: Sequence[Array], gap: float, floor: float = 0.0
) -> tuple[Array, float, Cuts]:
    """Return the optimum of the continuous relaxation, its proven lower bound, and the cuts that prove the bound.

    The cuts at `starts` come first. It ends within a tenth of `gap` of the bound, relative to the bound plus `floor`,
    when no cut is new, or after 40 rounds of cuts. Raises `InputError` where HiGHS fails.
    """
    cuts = Cuts(program)
    for x in starts:
        cuts.add(x)
    x, bound = cuts.relax()
    for _ in range(40):
        if program.value(x) - bound <= 0.1 * gap * (bound + floor) or not cuts.add(x):
            break
        x, bound = cuts.relax()
    return x, bound, cuts


def outer_approximation(
    program: Program, starts: Sequence[Array], gap: float, floor: float = 0.0
) -> tuple[list[Array], float]:
    """Return the integer points (n,) that outer approximation visited, and a proven lower bound.

    It ends when the best point is within `gap` of the bound, relative to the bound plus `floor`; when a point adds no
    cut, which proves it optimal; or after 40 points. A point may exceed a budget by the solver's tolerance (1e-7 of
    it), so that the caller has to trim it. Raises `InputError` where HiGHS fails.
    """
    _, bound, cuts = continuous_optimum(program, starts, gap, floor)
    visited: list[Array] = []
    best = np.inf
    for _ in range(40):
        x, below = cuts.solve(gap / 2)
        visited.append(x)
        bound = max(bound, below)
        best = min(best, program.value(x))
        if best - bound <= gap * (bound + floor) or not cuts.add(x):
            break
    return visited, bound
