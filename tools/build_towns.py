"""Build the road nets of the towns from the nodes and streets defined here, by SUMO's netconvert.

Run with an environment that has `eclipse-sumo` (the extra `towns`):

    python tools/build_towns.py  # writes src/flcav/world/towns/<name>/town.net.xml, and recipes/maps/quarter.xodr

The nets are committed; a town's other properties are in `town.yaml` beside its net. The quarter is a map (OpenDRIVE)
to be imported: streets without sidewalks or crossings, as maps often are. Traffic is right-hand. An edge lists its
lanes from the kerb to the middle: sidewalk, bicycle lane, parking lane (closed to all traffic), driving lanes.
"""

import math
import re
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import sumo  # pyright: ignore[reportMissingImports]  (scratch environment only)

from flcav.world.map.roads import name_streets

TOWNS = Path(__file__).parents[1] / "src/flcav/world/towns"
MAPS = Path(__file__).parents[1] / "recipes/maps"
Point = tuple[float, float]


class Profile(NamedTuple):
    """Cross-section of one direction of a street type [m, m/s]."""

    lanes: int
    lane_m: float
    parking_m: float
    bicycle_m: float
    sidewalk_m: float
    speed: float
    priority: int


@dataclass
class Sketch:
    """A road net under construction: nodes, edges, connections, roundabouts."""

    profiles: dict[str, Profile]
    nodes: dict[str, tuple[Point, str]] = field(default_factory=dict)
    edges: list[str] = field(default_factory=list)
    connections: list[str] = field(default_factory=list)
    roundabouts: list[str] = field(default_factory=list)
    names: dict[str, str] = field(default_factory=dict)  # of streets, by edge

    def node(self, name: str, at: Point, kind: str = "priority") -> None:
        """Add a junction at `at` [m]; `kind`: a SUMO node type."""
        self.nodes[name] = (at, kind)

    def edge(self, name: str, start: str, end: str, kind: str, via: Iterable[Point] = ()) -> None:
        """Add one direction of a street from `start` to `end` through the points `via`; `kind` names a profile."""
        profile = self.profiles[kind]
        shape = [self.nodes[start][0], *via, self.nodes[end][0]]
        text = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape)
        parking = int(profile.parking_m > 0)
        closed = f'<lane index="0" width="{profile.parking_m}" disallow="all"/>' if parking else ""
        self.edges.append(
            f"<edge id={quoteattr(name)} from={quoteattr(start)} to={quoteattr(end)} type={quoteattr(kind)} "
            f'numLanes="{profile.lanes + parking}" shape="{text}">{closed}</edge>'
        )

    def street(self, start: str, end: str, kind: str, via: tuple[Point, ...] = ()) -> None:
        """Add both directions of a street; the edges are named `start_end` and `end_start`."""
        self.edge(f"{start}_{end}", start, end, kind, via)
        self.edge(f"{end}_{start}", end, start, kind, via[::-1])

    def name(self, street: str, *nodes: str) -> None:
        """Give the street along the nodes a name, in both directions."""
        for start, end in pairwise(nodes):
            self.names |= {f"{start}_{end}": street, f"{end}_{start}": street}

    def turning_loop(self, end: str, start: str, kind: str, radius: float = 9.0) -> None:
        """Close the dead end `end` of the street from `start` with a one-way loop wide enough for a bus."""
        (x, y), (x0, y0) = self.nodes[end][0], self.nodes[start][0]
        heading = math.atan2(y - y0, x - x0)
        reach = 1.7 * radius
        centre = (x + reach * math.cos(heading), y + reach * math.sin(heading))
        tangent = math.pi - math.acos(radius / reach)
        far = f"{end}_far"
        self.node(far, on_circle(centre, radius, heading))
        out, back = f"{end}_out", f"{end}_back"
        right = [on_circle(centre, radius, heading - tangent * (1 - k / 8)) for k in range(8)]
        left = [on_circle(centre, radius, heading + tangent * (k + 1) / 8) for k in range(8)]
        self.edge(out, end, far, kind, right)
        self.edge(back, far, end, kind, left)
        self.connections += [
            f'<delete from="{back}" to="{out}"/>',
            f'<delete from="{start}_{end}" to="{end}_{start}"/>',
        ]

    def roundabout(self, name: str, centre: Point, radius: float, arms: dict[str, float], kind: str) -> None:
        """Add a roundabout; `arms` maps the suffix of each of its nodes to the node's bearing [deg], increasing."""
        names = list(arms)
        for suffix, bearing in arms.items():
            self.node(f"{name}{suffix}", on_circle(centre, radius, math.radians(bearing)))
        ring = []
        for here, there in zip(names, [*names[1:], names[0]], strict=True):
            sweep = (arms[there] - arms[here]) % 360
            via = [on_circle(centre, radius, math.radians(arms[here] + sweep * k / 10)) for k in range(1, 10)]
            self.edge(f"{name}_{here}{there}", f"{name}{here}", f"{name}{there}", kind, via)
            ring.append(f"{name}_{here}{there}")
        self.roundabouts.append(
            f'<roundabout nodes="{" ".join(f"{name}{suffix}" for suffix in names)}" edges="{" ".join(ring)}"/>'
        )

    def build(self, out: Path) -> None:
        """Write the sketch as a net, or OpenDRIVE map, to `out`; raises `CalledProcessError` where netconvert fails."""
        types = [
            f'<type id="{kind}" numLanes="{p.lanes}" width="{p.lane_m}" speed="{p.speed}" priority="{p.priority}" '
            + f'sidewalkWidth="{p.sidewalk_m}" '
            + (f'bikeLaneWidth="{p.bicycle_m}" ' if p.bicycle_m else "")
            + "/>"
            for kind, p in self.profiles.items()
        ]
        nodes = [
            f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>' for name, ((x, y), kind) in self.nodes.items()
        ]
        parts = {
            "type": ("types", types),
            "node": ("nodes", nodes),
            "edge": ("edges", self.edges + self.roundabouts),
            "connection": ("connections", self.connections),
        }
        with tempfile.TemporaryDirectory() as folder:
            command = [str(Path(sumo.SUMO_HOME) / "bin/netconvert"), *self._format(out)]
            for option, (tag, rows) in parts.items():
                path = Path(folder) / f"{tag}.xml"
                path.write_text(f"<{tag}>\n" + "\n".join(rows) + f"\n</{tag}>\n")
                command += [f"--{option}-files", str(path)]
            command += ["--offset.disable-normalization", "true", "--no-turnarounds", "true"]
            command += ["--junctions.corner-detail", "8", "--junctions.internal-link-detail", "12"]
            command += ["--tls.default-type", "static", "--tls.cycle.time", "60", "--output.street-names", "false"]
            subprocess.run(command, check=True)
        text = re.sub(r"<!--.*?-->\s*", "", out.read_text(), flags=re.DOTALL)
        if out.suffix == ".xodr":
            text = re.sub(r"\n\s+", "\n", re.sub(r' date="[^"]*"', "", text))  # half as large without indents
        out.write_text(text)
        name_streets(out, lambda edge: self.names.get(edge, ""))

    def _format(self, out: Path) -> list[str]:
        """Return netconvert's output options by the suffix of `out`: an OpenDRIVE map, or a net with crossings."""
        if out.suffix == ".xodr":
            return ["--opendrive-output", str(out)]
        crossings = ["--crossings.guess", "true", "--crossings.guess.speed-threshold", "20", "--walkingareas", "true"]
        return ["--output-file", str(out), *crossings]


def on_circle(centre: Point, radius: float, bearing: float) -> Point:
    """Return the point of a circle at a bearing [rad], counter-clockwise from the x axis."""
    return centre[0] + radius * math.cos(bearing), centre[1] + radius * math.sin(bearing)


def suburb() -> Sketch:
    """T-junctions and narrow two-lane streets, axis aligned."""
    town = Sketch(
        {
            "main": Profile(1, 3.1, 2.1, 0, 2.0, 11.11, 3),
            "side": Profile(1, 2.9, 2.1, 0, 1.8, 8.33, 2),
            "loop": Profile(1, 4.0, 0, 0, 1.8, 5.56, 1),
        }
    )
    corners: dict[str, Point] = {"nw": (-135, 90), "ne": (135, 90), "sw": (-135, -95), "se": (135, -95)}
    tees: dict[str, Point] = {
        "w": (-135, 5),
        "e": (135, 5),
        "t1": (-60, 90),
        "t2": (62, 90),
        "m1": (-60, 5),
        "m2": (62, 5),
        "m3": (0, 5),
        "b1": (0, -95),
        "b2": (-75, -95),
    }
    for name, at in corners.items():
        town.node(name, at)
    for name, at in tees.items():
        town.node(name, at, "priority_stop" if name in ("m1", "m2", "m3") else "priority")
    town.node("close", (-75, -130))
    for start, end in ("w", "m1"), ("m1", "m3"), ("m3", "m2"), ("m2", "e"):
        town.street(start, end, "main")
    rim = ("nw", "t1", "t2", "ne", "e", "se", "b1", "b2", "sw", "w")
    across = ("t1", "m1"), ("t2", "m2"), ("m3", "b1"), ("b2", "close")
    for start, end in *zip(rim, (*rim[1:], rim[0])), *across:
        town.street(start, end, "side")
    town.turning_loop("close", "b2", "loop", radius=8.0)
    town.name("Main Street", "w", "m1", "m3", "m2", "e")
    town.name("North Road", "nw", "t1", "t2", "ne")
    town.name("South Road", "sw", "b2", "b1", "se")
    town.name("West Road", "nw", "w", "sw")
    town.name("East Road", "ne", "e", "se")
    town.name("School Lane", "t1", "m1")
    town.name("Church Lane", "t2", "m2")
    town.name("Mill Lane", "m3", "b1")
    town.name("The Close", "b2", "close")
    return town


def grid() -> Sketch:
    """Multi-lane cross-roads in three rows and three columns, sheared and turned in the world."""
    town = Sketch(
        {
            "boulevard": Profile(2, 3.4, 2.6, 1.6, 3.0, 11.11, 3),
            "avenue": Profile(3, 3.2, 2.6, 1.6, 2.6, 13.89, 4),
            "street": Profile(2, 3.2, 2.6, 0, 2.4, 13.89, 3),
            "bend": Profile(1, 3.8, 0, 0, 2.4, 8.33, 2),
            "stub": Profile(1, 3.8, 0, 0, 2.2, 8.33, 2),
            "loop": Profile(1, 4.2, 0, 0, 2.2, 6.94, 1),
        }
    )
    shear, turn = 0.17, math.radians(23.0)

    def world(x: float, y: float) -> Point:
        x += shear * y
        return x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)

    columns, rows = (-112.0, 0.0, 86.0), (-86.0, 0.0, 82.0)
    for i, x in enumerate(columns):
        for j, y in enumerate(rows):
            town.node(f"x{i}{j}", world(x, y), "traffic_light")
    for j in range(3):
        for i in range(2):
            kind = "avenue" if j == 1 else "boulevard" if (i, j) == (0, 2) else "street"
            town.street(f"x{i}{j}", f"x{i + 1}{j}", kind)
    for i in range(3):
        for j in range(2):
            town.street(f"x{i}{j}", f"x{i}{j + 1}", "street")
    reach = 40.0
    for name, start, (x, y) in (
        ("west", "x01", (columns[0] - reach, rows[1])),
        ("east", "x21", (columns[2] + reach, rows[1])),
        ("south", "x10", (columns[1], rows[0] - reach)),
        ("north", "x12", (columns[1], rows[2] + reach)),
    ):
        town.node(name, world(x, y))
        town.street(start, name, "stub")
        town.turning_loop(name, start, "loop")
    for i, j in ((0, 0), (2, 0), (0, 2), (2, 2)):
        side, up, radius = i - 1, j - 1, 21.0
        petal = [on_circle((radius, radius), radius, math.radians(angle)) for angle in range(-90, 181, 15)]
        shape = [world(columns[i] + side * x, rows[j] + up * y) for x, y in petal]
        here, middle, half = f"x{i}{j}", f"petal{i}{j}", len(shape) // 2
        town.node(middle, shape[half])
        town.edge(f"{here}_{middle}_a", here, middle, "bend", shape[:half])
        town.edge(f"{middle}_{here}_a", middle, here, "bend", shape[half - 1 :: -1])
        town.edge(f"{here}_{middle}_b", here, middle, "bend", shape[:half:-1])
        town.edge(f"{middle}_{here}_b", middle, here, "bend", shape[half + 1 :])
    town.name("South Street", "x00", "x10", "x20")
    town.name("Market Avenue", "west", "x01", "x11", "x21", "east")
    town.name("Park Boulevard", "x02", "x12", "x22")
    town.name("West Street", "x00", "x01", "x02")
    town.name("Station Street", "south", "x10", "x11", "x12", "north")
    town.name("East Street", "x20", "x21", "x22")
    return town


def ring() -> Sketch:
    """A roundabout, three T-junctions on a curved outer road, and a cross-road."""
    town = Sketch(
        {
            "arm": Profile(1, 3.4, 2.4, 1.5, 2.4, 11.11, 3),
            "outer": Profile(1, 3.4, 2.4, 0, 2.2, 11.11, 2),
            "circle": Profile(1, 5.0, 0, 0, 2.2, 6.94, 5),
            "stub": Profile(1, 3.8, 0, 0, 2.2, 8.33, 2),
            "loop": Profile(1, 4.2, 0, 0, 2.2, 6.94, 1),
        }
    )
    town.roundabout("r", (0, 0), 22.0, {"e": 8.0, "n": 97.0, "w": 196.0, "s": 281.0}, "circle")
    town.node("x", (122, 22), "traffic_light")
    town.node("tn", (-14, 118))
    town.node("tw", (-128, -34))
    town.node("ts", (26, -122))
    town.node("end", (168, 34))
    town.street("re", "x", "arm", ((60, 6),))
    town.street("rn", "tn", "arm", ((-8, 70),))
    town.street("rw", "tw", "arm", ((-70, -22),))
    town.street("rs", "ts", "arm", ((12, -70),))
    town.street("tn", "x", "outer", ((30, 121), (70, 116), (98, 100), (112, 74)))
    town.street("x", "ts", "outer", ((131, -25), (126, -62), (108, -92), (72, -114)))
    town.street("ts", "tw", "outer", ((-22, -130), (-66, -126), (-102, -104), (-120, -72)))
    town.street("tw", "tn", "outer", ((-136, 10), (-126, 56), (-96, 92), (-58, 112)))
    town.street("x", "end", "stub")
    town.turning_loop("end", "x", "loop")
    town.name("Ring Road", "tn", "x", "ts", "tw", "tn")
    town.name("Station Road", "re", "x", "end")
    town.name("Hill Road", "rn", "tn")
    town.name("Mill Road", "rw", "tw")
    town.name("Bridge Road", "rs", "ts")
    return town


def arterial() -> Sketch:
    """A village street between two lights, crossed by roads of 60 km/h, in a fast road that leads around it."""
    town = Sketch(
        {
            "fast": Profile(1, 3.6, 0, 0, 1.8, 25.0, 5),
            "through": Profile(1, 3.3, 2.2, 0, 2.0, 16.67, 3),
            "lane": Profile(1, 3.0, 0, 0, 1.8, 8.33, 1),
        }
    )
    junctions: dict[str, tuple[Point, str]] = {
        "w": ((-172, 0), "traffic_light"),
        "n1": ((-86, 125), "priority_stop"),
        "n2": ((0, 125), "priority"),
        "n3": ((86, 125), "traffic_light"),
        "e": ((172, 0), "priority"),
        "s3": ((86, -125), "priority_stop"),
        "s2": ((0, -125), "priority_stop"),
        "s1": ((-86, -125), "traffic_light"),
        "c1": ((-86, 0), "traffic_light"),
        "c2": ((0, 0), "priority"),
        "c3": ((86, 0), "traffic_light"),
    }
    for name, (at, kind) in junctions.items():
        town.node(name, at, kind)
    corner = 60.0
    bends = {"w": (-172, 125), "n3": (172, 125), "e": (172, -125), "s1": (-172, -125)}
    rim = ("w", "n1", "n2", "n3", "e", "s3", "s2", "s1")
    for start, end in zip(rim, (*rim[1:], rim[0])):
        via: tuple[Point, ...] = ()
        if start in bends:
            x, y = bends[start]
            centre = (x - math.copysign(corner, x), y - math.copysign(corner, y))
            first = {"w": 180, "n3": 90, "e": 0, "s1": 270}[start]
            via = tuple(on_circle(centre, corner, math.radians(first - 10 * k)) for k in range(10))
        town.street(start, end, "fast", via)
    for start, end in ("w", "c1"), ("c3", "e"), ("n1", "c1"), ("c1", "s1"), ("n3", "c3"), ("c3", "s3"):
        town.street(start, end, "through")
    for start, end in ("c1", "c2"), ("c2", "c3"), ("n2", "c2"), ("c2", "s2"):
        town.street(start, end, "lane")
    town.name("Bypass", *rim, rim[0])
    town.name("Village Street", "w", "c1", "c2", "c3", "e")
    town.name("Mill Road", "n1", "c1", "s1")
    town.name("Church Lane", "n2", "c2", "s2")
    town.name("Station Road", "n3", "c3", "s3")
    return town


def quarter() -> Sketch:
    """A main street with two lights, crossed by narrow streets, two of them curved; no dead ends."""
    town = Sketch({"main": Profile(1, 3.4, 0, 0, 0, 13.89, 3), "side": Profile(1, 3.0, 0, 0, 0, 8.33, 1)})
    town.node("a1", (-95, 0), "traffic_light")
    town.node("a2", (10, 8), "traffic_light")
    others: dict[str, Point] = {
        "a3": (110, 0),
        "b1": (-95, -90),
        "b2": (15, -95),
        "c2": (5, 95),
        "west": (-180, -6),
        "mill": (-170, -100),
        "hill": (-105, 90),
    }
    for name, at in others.items():
        town.node(name, at)
    for start, end in ("west", "a1"), ("a1", "a2"), ("a2", "a3"):
        town.street(start, end, "main")
    around = ("west", "mill", "b1", "b2", "a2", "c2", "hill", "a1", "b1")
    for start, end in pairwise(around):
        town.street(start, end, "side")
    x0, y0 = others["a3"]
    for start in "c2", "b2":  # a quarter of an ellipse each
        x, y = others[start]
        bends = [math.radians(angle) for angle in range(8, 90, 8)]
        via = tuple((x + (x0 - x) * math.sin(bend), y0 + (y - y0) * math.cos(bend)) for bend in bends)
        town.street(start, "a3", "side", via)
    return town


if __name__ == "__main__":
    for name, sketch in {"suburb": suburb(), "grid": grid(), "ring": ring(), "arterial": arterial()}.items():
        sketch.build(TOWNS / name / "town.net.xml")
    quarter().build(MAPS / "quarter.xodr")
