"""The convex terms of an allocation's error, with the straight lines that bound them from below."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.optimization.curves import Effective
from flcav.optimization.cutting_planes import Line, Term
from flcav.optimization.problem import Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PowerTerm:
    """weight * a * (x[index] + x0)^(-b); its lines are secants between neighbouring whole numbers."""

    index: int
    a: float
    b: float
    x0: float

    def value(self, x: Array) -> float:
        """Return the term at x (n,)."""
        return self._at(x[self.index])

    def lines(self, x: Array) -> list[Line]:
        """Return the secants through the whole neighbours of x (n,)."""
        below = np.floor(x[self.index] + 1e-9)
        starts = {below} if x[self.index] - below > 1e-6 else {below, below - 1}
        lines = []
        for start in starts:
            if start + self.x0 > 0:
                slope = self._at(start + 1) - self._at(start)
                lines.append(Line((self.index,), (slope,), self._at(start) - slope * start))
        return lines

    def _at(self, x: float) -> float:
        return float(self.a * (x + self.x0) ** -self.b)


@dataclass(frozen=True)
class EffectiveTerm:
    """The weighted error above its floor of one task, of x[first : first + 3]; its lines are tangents."""

    first: int
    weight: float
    curve: Effective
    k: int

    def value(self, x: Array) -> float:
        """Return the term at x (n,)."""
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        return self.weight * float(self.curve.error(samples, edge_rounds, cloud_rounds, self.k) - self.curve.floor)

    def lines(self, x: Array) -> list[Line]:
        """Return the tangent at x (n,)."""
        counts, curve = x[self.first : self.first + 3], self.curve
        effective = float(curve.effective_samples(counts[0], counts[1], counts[2], self.k))
        per_round = curve.beta * curve.group_samples / (counts[1] + self.k * counts[2] + 1) ** 2
        gain = self.weight * curve.a * curve.b * effective ** (-curve.b - 1)
        slope = -gain * np.array((curve.alpha, per_round, self.k * per_round))
        index = (self.first, self.first + 1, self.first + 2)
        return [Line(index, tuple(map(float, slope)), self.value(x) - float(slope @ counts))]


def terms_of(problem: Problem) -> list[Term]:
    """Return the terms whose sum is the weighted error above the floors."""
    terms: list[Term] = []
    for number, task in enumerate(problem.tasks):
        for learner in task.learners:
            if isinstance(learner.curve, Effective):
                k = problem.edge_rounds_per_cloud_round
                terms.append(EffectiveTerm(3 * number, learner.weight, learner.curve, k))
                continue
            for stage, decay in enumerate(learner.curve.decays()):
                if decay.a > 0:
                    terms.append(PowerTerm(3 * number + stage, learner.weight * decay.a, decay.b, decay.x0))
    return terms
