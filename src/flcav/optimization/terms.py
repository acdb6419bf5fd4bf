"""The convex terms of an allocation's error, with the straight lines that bound them from below."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flcav.optimization.curves import effective_samples
from flcav.optimization.cutting_planes import Line, Term
from flcav.optimization.instance import Instance

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
    """gain * n^(-b), n the `effective_samples` of x[first : first + 3], t = y + k z; its lines are tangents."""

    first: int
    gain: float
    b: float
    alpha: float
    group: float
    k: int

    def value(self, x: Array) -> float:
        """Return the term at x (n,)."""
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        return self.gain * self._effective(samples, edge_rounds + self.k * cloud_rounds) ** -self.b

    def lines(self, x: Array) -> list[Line]:
        """Return the tangent at x (n,)."""
        samples, edge_rounds, cloud_rounds = x[self.first : self.first + 3]
        t = edge_rounds + self.k * cloud_rounds
        per_round = self.group / (t + 1) ** 2
        fall = self.gain * self.b * self._effective(samples, t) ** (-self.b - 1)
        slope = -fall * np.array((self.alpha, per_round, self.k * per_round))
        index = (self.first, self.first + 1, self.first + 2)
        return [Line(index, tuple(map(float, slope)), self.value(x) - float(slope @ x[self.first : self.first + 3]))]

    def _effective(self, samples: float, t: float) -> float:
        return float(effective_samples(samples, t, self.alpha, self.group))


def terms_of(instance: Instance) -> list[Term]:
    """Return the terms whose sum is the weighted error above the floors."""
    powers, effective = instance.separable, instance.effective
    of = np.arange(len(powers.a)) if powers.of is None else powers.of
    rows = zip(of.tolist(), powers.a.tolist(), powers.b.tolist(), powers.x0.tolist())
    terms: list[Term] = [PowerTerm(*row) for row in rows if row[1] > 0]
    if effective is not None:
        columns = (effective.quantity, effective.gain, effective.b, effective.alpha, effective.group)
        terms += [EffectiveTerm(*row, k=effective.k) for row in zip(*(column[:, 0].tolist() for column in columns))]
    return terms
