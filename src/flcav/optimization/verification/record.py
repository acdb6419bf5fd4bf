"""The record of a verification: what was recomputed, what does not hold, and what had to be trusted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

NEAR = 1e-9  # relative tolerance of what a plan states


@dataclass(frozen=True)
class Verification:
    """The verification of a plan or a placement: cost, objective and bound, recomputed without code of the solvers."""

    objective: float  # error or area, or covered weight
    cost: tuple[float, ...]  # wireless, wireline [MB] and time [s]; or of the sensors
    bound: float | None  # that the dual alone proves; None: the objective has none
    gap: float | None  # between the two, relative to the smaller one
    faults: tuple[str, ...]  # what is stated and does not hold; none: the certificate holds
    trusted: tuple[str, ...]  # what the certificate relies on in addition to the dual
    excluded: float | None = None  # next better sum of weights, or costs: ruled out by the bound; None: no gap, or open

    def lines(self, *, counted: bool = False) -> list[str]:
        """Return the verification in words; `counted`: the cost is a number of sensors."""
        proof = "there is no bound for this objective: nothing is proven"
        if self.bound is not None:
            proof = f"its dual alone proves {self.bound:.9g}, a gap of {100 * (self.gap or 0.0):.3g} %"
        if self.bound is not None and self.excluded is not None:
            more = self.excluded > self.objective
            sums, limit = ("weights above", "least") if more else ("costs below", "most")
            proof = (
                f"its dual alone proves {self.bound:.9g}; sums of the {sums} {self.objective:.9g} are at {limit} "
                f"{self.excluded:.9g}, so that nothing better exists"
            )
        cost = " and ".join(f"{each:.9g}" for each in self.cost)
        spent = f"with {cost} of the sensors" if counted else f"at the cost {cost}"
        return [
            f"recomputed: {self.objective:.9g} {spent}; {proof}",
            *(f"trusted: {each}" for each in self.trusted),
            *(f"does not hold: {each}" for each in self.faults),
        ]


def judge_claims(
    objective: float,
    cost: Iterable[Fraction],
    bound: float | None,
    claims: Mapping[str, bool],
    trusted: Sequence[str],
    excluded: float | None = None,
) -> Verification:
    """Return the verification whose faults are the `claims` that do not hold."""
    gap = None
    if bound is not None:
        apart = abs(objective - bound)
        least = min(abs(objective), abs(bound))
        gap = apart / least if least > 0 else float(apart > 0)
    faults = tuple(claim for claim, holds in claims.items() if not holds)
    return Verification(objective, tuple(map(float, cost)), bound, gap, faults, tuple(trusted), excluded)


def exact(number: float | Fraction) -> Fraction:
    """Return the decimal by which a float is written, exactly; a fraction is returned as it is."""
    return number if isinstance(number, Fraction) else Fraction(repr(float(number)))


def near(one: float, other: float) -> bool:
    """Return whether two numbers are equal to the relative tolerance `NEAR`."""
    return abs(one - other) <= NEAR * max(abs(one), abs(other))
