"""Place roadside sensors where a detector errs: greedily, and provably best."""

import numpy as np

from flcav import place


def main() -> None:
    generator = np.random.default_rng(7)
    poles = np.c_[generator.uniform(0, 200, (9, 2)), np.full(9, 3.0)]  # x, y, z [m]
    crossings = generator.uniform(0, 200, (4, 2))
    errors = np.concatenate([spot + generator.normal(0, 15, (40, 2)) for spot in crossings])
    errors = np.c_[errors, np.full(len(errors), 0.8)]
    for method in ("greedy", "exact"):
        found = place(errors, poles, range_m=45.0, count=2, method=method)
        poles_named = " and ".join(str(pole + 1) for pole in found.chosen)
        proof = "optimal" if found.optimal else f"at most {found.upper_bound:.0f} possible"
        print(f"{method}: poles {poles_named} cover {found.covered} of {len(errors)} errors ({proof})")


if __name__ == "__main__":
    main()
