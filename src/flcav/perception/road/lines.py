"""Lane lines in a picture as polylines: traced from class probabilities row by row, and projected to the ground.

From the lowest row up, the cells of each row in which a lane line is likelier than not form runs. A run continues the
line whose prolongation is nearest, else it begins a line. Lines are as those of the labels: within the reach, long
enough, and leading away from the camera.
"""

from dataclasses import dataclass, field

import numpy as np

from flcav.arrays import Array, Array32, Mask
from flcav.dataset.road_labels import BROKEN, REACH_M, SHORTEST_M, SOLID, leads_away
from flcav.geometry import pose
from flcav.perception.road.model import STRIDE
from flcav.sensors.frame import Frame
from flcav.sensors.lens import unproject_pixels

LIKELY = 0.5  # least probability of a lane line, solid or broken
WIDEST = 14  # cells of the longest run: longer ones are of lines across
MISSED = 6  # rows without a run after which a line has ended
ASIDE = 1.5  # largest distance of a run from a line's prolongation, in cells, and for each row of it the share below
ASIDE_PER_ROW = 0.5
TREND = 5  # rows by which a line is prolonged
SMOOTH = 3  # rows of the moving average along a line


@dataclass(frozen=True)
class TracedLine:
    """A lane line in a picture, from its near end to its far end."""

    pixels: Array  # (K, 2) u, v [px]; the centre of the first pixel is (0, 0)
    solid: bool  # continuous, otherwise broken
    score: float  # mean probability along it
    ground: Array | None = None  # (K, 2) x forward, y left in the agent's frame, on its ground plane [m]; None: unknown


@dataclass(frozen=True)
class GroundPlane:
    """The ground below an agent as the plane z = 0, seen by one of its cameras with the calibration that it assumes."""

    agent_from_camera: Array  # (4, 4) [m]; of a pole, whose origin is its mount, from the ground below it
    intrinsics: Array  # (3, 3) [px]
    distortion: Array  # (5,)

    @classmethod
    def of(cls, frame: Frame, camera: str, height_m: float = 0.0) -> "GroundPlane":
        """Return the plane `height_m` [m] below the origin of a frame's agent, as one of its cameras sees it."""
        assumed = frame.assumed
        raised = pose(0.0, 0.0, height_m) @ assumed.agent_from_sensor[camera]
        return cls(raised, assumed.intrinsics[camera], assumed.distortion[camera])

    def locate(self, pixels: Array) -> Array:
        """Return the points (K, 2) x, y [m] of the plane at pixels (K, 2); NaN at and above the horizon."""
        plane = unproject_pixels(self.intrinsics, self.distortion, pixels)
        rays = np.column_stack((plane, np.ones(len(plane)))) @ self.agent_from_camera[:3, :3].T
        eye = self.agent_from_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            times = np.where(rays[:, 2] * np.sign(eye[2]) < 0, -eye[2] / rays[:, 2], np.nan)
        return (eye + times[:, None] * rays)[:, :2]


@dataclass
class _Chain:
    """A line while it is traced: its runs from the lowest row up."""

    rows: list[int] = field(default_factory=list)
    columns: list[float] = field(default_factory=list)
    solid: float = 0.0  # sum over its cells of the probability of a solid line
    broken: float = 0.0
    peaks: list[float] = field(default_factory=list)  # largest probability of each run

    def prolong(self, row: int) -> tuple[float, float]:
        """Return the column expected in a row, and how many cells a row it moves."""
        if len(self.rows) < 2:
            return self.columns[-1], 0.0
        rows, columns = self.rows[-TREND:], self.columns[-TREND:]
        slope = (columns[-1] - columns[0]) / (rows[-1] - rows[0])
        return columns[-1] + slope * (row - rows[-1]), slope


def trace_lines(shares: Array32, plane: GroundPlane | None = None) -> list[TracedLine]:
    """Return the lane lines in class probabilities (classes, h, w) of cells of `STRIDE` pixels, longest first.

    With the `plane` they also have their places on the ground, end at the reach, and short ones are left out.
    """
    likely = shares[SOLID] + shares[BROKEN]
    chains: list[_Chain] = []
    for row in range(likely.shape[0] - 1, -1, -1):
        _continue(chains, row, likely[row], shares[SOLID, row], shares[BROKEN, row])
    found = [line for chain in chains if (line := _as_line(chain, plane)) is not None]
    return sorted(found, key=lambda line: -len(line.pixels))


def _continue(chains: list[_Chain], row: int, likely: Array32, solid: Array32, broken: Array32) -> None:
    """Add the runs of a row to the chains that they continue, or begin chains with them."""
    runs = _runs(likely > LIKELY)
    if not runs:
        return
    centres = [_centre(likely, first, last) for first, last in runs]
    open_chains = [chain for chain in chains if chain.rows[-1] - row <= MISSED]
    pairs = []
    for number, chain in enumerate(open_chains):
        wanted, slope = chain.prolong(row)
        ahead = chain.rows[-1] - row
        for run, (first, last) in enumerate(runs):
            outside = max(first - wanted, wanted - last, 0.0)
            if outside <= ASIDE + ASIDE_PER_ROW * (ahead - 1) + (0.0 if slope else 1.0):
                pairs.append((abs(centres[run] - wanted), number, run))
    taken: dict[int, _Chain] = {}
    used = set[int]()
    for _, number, run in sorted(pairs):
        if run not in taken and number not in used:
            taken[run] = open_chains[number]
            used.add(number)
    for run, (first, last) in enumerate(runs):
        chain = taken.get(run)
        if chain is None:
            chain = _Chain()
            chains.append(chain)
        chain.rows.append(row)
        chain.columns.append(centres[run])
        chain.solid += float(solid[first : last + 1].sum())
        chain.broken += float(broken[first : last + 1].sum())
        chain.peaks.append(float(likely[first : last + 1].max()))


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Return the first and last index of each run of True that is not longer than `WIDEST`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return [(first, last - 1) for first, last in edges.reshape(-1, 2).tolist() if last - first <= WIDEST]


def _centre(likely: Array32, first: int, last: int) -> float:
    """Return the centre of a run, weighted by probability, with the cell on either side of it."""
    cells = np.arange(max(first - 1, 0), min(last + 2, len(likely)))
    return float(cells @ likely[cells] / likely[cells].sum())


def _as_line(chain: _Chain, plane: GroundPlane | None) -> TracedLine | None:
    """Return a chain as a line; None where it is too short or leads across."""
    if len(chain.rows) < 2:
        return None
    rows = np.array(chain.rows, np.float64)
    columns = _smooth(np.array(chain.columns))
    cells = np.column_stack((rows, columns))
    first, last = ((cells[end] + (cells[end] - cells[inner]) / 2) for end, inner in ((0, 1), (-1, -2)))
    cells = np.vstack((first, cells, last))  # half a row further at both ends, to the borders of their cells
    pixels = (cells[:, ::-1] + 0.5) * STRIDE - 0.5
    ground = None
    if plane is not None:
        ground = plane.locate(pixels)
        eye = plane.agent_from_camera[:2, 3]
        kept = np.hypot(*(ground - eye).T) <= REACH_M  # False for NaN
        pixels, ground = pixels[kept], ground[kept]
        if len(ground) < 2 or np.hypot(*(ground[-1] - ground[0])) < SHORTEST_M:
            return None
    if not leads_away(pixels):
        return None
    return TracedLine(pixels, chain.solid >= chain.broken, float(np.mean(chain.peaks)), ground)


def _smooth(values: Array) -> Array:
    """Return the moving average over `SMOOTH` values, of fewer at the ends, symmetric about each."""
    out = values.copy()
    for number in range(1, len(values) - 1):
        out[number] = values[number - SMOOTH // 2 : number + SMOOTH // 2 + 1].mean()
    return out
