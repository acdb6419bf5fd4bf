"""The loop as an animation: misses of a drive, the road sensor that sees most of them, rounds, and what they brought.

Eight seconds in four acts. The map is drawn once; what moves on it is drawn at twice the size and scaled down.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from flcav.arrays import Array
from flcav.report import style
from flcav.report.pictures.changes import FALSE, GONE, ErrorChanges
from flcav.report.pictures.maps import draw_town
from flcav.world.trace import Trace, find_instant

WIDTH, HEIGHT, SIZE = 960, 540, 540  # of the picture, and of the square map in it [px]
PER_SECOND = 12
ACTS = (26, 14, 42, 14)  # frames of the drive, the sensor, the rounds, the outcome
FINE = 2  # times the size at which is drawn
ROOM_M = 14.0  # around the streets
POP = 0.06  # share of the first act that a miss takes to pop up
LEFT, RIGHT = SIZE + 28, WIDTH - 28  # of the column beside the map [px]
LINKS: tuple[str, ...] = ("wireless", "wireline")
Colour = str | tuple[int, int, int, int]


@dataclass(frozen=True)
class LoopRound:
    """A moment of the run: pretraining, or a round of one of its stages."""

    name: str
    score: float | None  # of the region's validation; None: not known
    sent_mb: dict[str, float]  # upwards until then, by link
    clients: tuple[str, ...]  # vehicles of the region that take part
    cloud: bool  # whether the region's edge server exchanges models with the cloud


@dataclass(frozen=True)
class Loop:
    """The content of a run's animation: one region's errors before and after, by time."""

    region: str
    task: str
    measure: str
    frames: int  # of the validation
    changes: ErrorChanges  # the region's errors before and after, its poles and what they see
    share: Array  # (E,) when each error is made, in [0, 1] of its drive
    drives: int  # in which errors were registered
    drive: Trace  # one of them
    learning: Trace  # a drive of the vehicles that learn
    rounds: tuple[LoopRound, ...]  # the first is pretraining
    budgets_mb: dict[str, float]


def draw_loop(loop: Loop) -> Iterator[Image.Image]:
    """Yield the frames of the animation, `PER_SECOND` of them a second."""
    view = _View.around(loop.changes.town.roads)
    ground, area = _draw_ground(loop, view), _draw_area(loop, view)
    for act, steps in enumerate(ACTS):
        for step in range(steps):
            canvas = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), "white")
            canvas.paste(ground)
            part = (step + 1) / steps
            _Frame(loop, view, canvas, act, part).draw(area)
            yield canvas.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


@dataclass(frozen=True)
class _View:
    """The square of the world that the map shows."""

    left: float  # x of its west side [m]
    top: float  # y of its north side [m]
    metres: float  # length of a side

    @classmethod
    def around(cls, roads: Sequence[Array]) -> "_View":
        points = np.concatenate([road[:, :2] for road in roads])
        low, high = points.min(axis=0) - ROOM_M, points.max(axis=0) + ROOM_M
        side, (x, y) = float((high - low).max()), (low + high) / 2
        return cls(x - side / 2, y + side / 2, side)

    def place(self, at: Array) -> tuple[float, float]:
        """Return the place on the fine canvas [px] of x, y [m]."""
        scale = SIZE * FINE / self.metres
        return float((at[0] - self.left) * scale), float((self.top - at[1]) * scale)

    def axes(self, *, clear: bool):
        figure = Figure(figsize=(SIZE / 100, SIZE / 100), dpi=100 * FINE)
        figure.patch.set_alpha(0.0 if clear else 1.0)
        return figure, figure.add_axes((0.0, 0.0, 1.0, 1.0))

    def fit(self, axes) -> None:
        axes.set(xlim=(self.left, self.left + self.metres), ylim=(self.top - self.metres, self.top), aspect="auto")
        axes.set_axis_off()


def _as_image(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba()).copy())


@style.styled
def _draw_ground(loop: Loop, view: _View) -> Image.Image:
    figure, axes = view.axes(clear=False)
    draw_town(axes, loop.changes.town)
    for name, (x, y, _) in loop.changes.poles.items():
        if name not in loop.changes.viewsheds:
            axes.plot(x, y, "o", markersize=4, color="white", markeredgecolor=style.MUTED, zorder=4)
    view.fit(axes)
    return _as_image(figure).convert("RGB")


@style.styled
def _draw_area(loop: Loop, view: _View) -> Image.Image:
    """Return what the placed sensors see, transparent elsewhere."""
    figure, axes = view.axes(clear=True)
    for shed in loop.changes.viewsheds.values():
        grid = (shed.x, shed.y, gaussian_filter(shed.seen.astype(np.float64), 1.0))
        axes.contourf(*grid, [0.5, 1.5], colors=[style.BLUE], alpha=0.26)
        axes.contour(*grid, [0.5], colors=[style.BLUE], linewidths=1.2)
    view.fit(axes)
    return _as_image(figure)


@cache
def _font(size: int, bold: bool) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(findfont(FontProperties("DejaVu Sans", weight="bold" if bold else "normal")), size * FINE)


class _Frame:
    """One frame while it is drawn: `part` of its act has passed."""

    def __init__(self, loop: Loop, view: _View, canvas: Image.Image, act: int, part: float) -> None:
        self.loop, self.view, self.canvas, self.act, self.part = loop, view, canvas, act, part
        self.pen = ImageDraw.Draw(canvas, "RGBA")
        steps = len(loop.rounds) - 1
        passed = part * steps if act == 2 else (0 if act < 2 else steps)
        self.now = min(int(np.ceil(passed - 1e-9)), steps)  # the round that is under way
        self.within = passed - max(self.now - 1, 0) if act == 2 else 1.0  # share of it that has passed
        self.ended = self.now if self.within > 0.95 or act != 2 else self.now - 1  # the last round whose score is known

    def draw(self, area: Image.Image) -> None:
        """Draw the map and the column beside it."""
        if self.act > 0:
            grown = min(self.part * 1.6, 1.0) if self.act == 1 else 1.0
            layer = area if grown == 1 else Image.blend(Image.new("RGBA", area.size), area, grown)
            self.canvas.paste(layer, (0, 0), layer)
        self._draw_errors()
        vehicles = self._draw_traffic()
        if self.act == 2:
            self._draw_messages(vehicles)
        if self.act > 0:
            self._draw_sensors()
        self._tell()
        self._draw_scores()
        self._draw_links()

    def _dot(self, at: tuple[float, float], radius: float, fill: Colour, outline: Colour | None = None) -> None:
        x, y, r = *at, radius * FINE
        self.pen.ellipse((x - r, y - r, x + r, y + r), fill=fill, outline=outline, width=FINE)

    def _text(self, at: tuple[float, float], text: str, size: int = 14, *, bold: bool = False, **look: str) -> None:
        x, y = at
        fill, anchor = look.get("fill", style.INK), look.get("anchor", "ls")
        self.pen.text((x * FINE, y * FINE), text, font=_font(size, bold), fill=fill, anchor=anchor)

    def _draw_errors(self) -> None:
        changes, part = self.loop.changes, self.part if self.act == 0 else 2.0
        for at, kind, share, remains, seen in zip(
            changes.errors, changes.kind, self.loop.share, changes.remains, changes.seen, strict=True
        ):
            age = part - share
            if age < 0:
                continue
            colour = style.BLUE if seen and self.act in (1, 2) else style.ORANGE
            colour = GONE if self.act == 3 and not remains else colour
            place = self.view.place(at)
            if age < POP:
                self._dot(place, 4 + 12 * age / POP, (230, 159, 0, int(180 * (1 - age / POP))))
            self._mark(place, kind, colour)
        if self.act == 3:
            for at, kind in zip(changes.new, changes.new_kind, strict=True):
                self._mark(self.view.place(at), kind, style.VERMILLION)

    def _mark(self, at: tuple[float, float], kind: str, colour: str) -> None:
        """Draw an error: a cross for a false positive, else a dot."""
        if kind != FALSE:
            self._dot(at, 4, colour, "white")
            return
        x, y, r = *at, 3.4 * FINE
        for slope in (1, -1):
            self.pen.line((x - r, y - slope * r, x + r, y + slope * r), fill=colour, width=2 * FINE)

    def _draw_traffic(self) -> dict[str, tuple[float, float]]:
        """Draw the road users at their recorded poses, and return the places of the vehicles that learn."""
        trace = self.loop.drive if self.act < 2 else self.loop.learning
        part = {0: self.part, 1: 1.0, 2: self.part, 3: 1.0}[self.act]
        row = min(int(part * (len(trace.time_s) - 1)), len(trace.time_s) - 1)
        places: dict[str, tuple[float, float]] = {}
        for number in np.flatnonzero(trace.present[row]).tolist():
            name, at = str(trace.actor[number]), trace.position[row, number]
            place, own = self.view.place(at), name.startswith("cav")
            if own:
                places[name] = place
            if trace.category[number] == "pedestrian":
                self._dot(place, 1.2, style.MUTED)
            else:
                self._box(place, trace.size[number], float(trace.yaw[row, number]), own)
        return places

    def _box(self, at: tuple[float, float], size: Array, yaw: float, own: bool) -> None:
        scale = SIZE * FINE / self.view.metres * (1.5 if own else 1.0)
        length, width = max(size[0] * scale, 12 * FINE * own), max(size[1] * scale, 6 * FINE * own)
        ahead, left = np.array((np.cos(yaw), -np.sin(yaw))), np.array((np.sin(yaw), np.cos(yaw)))
        corners = [
            tuple((np.array(at) + u * length / 2 * ahead + v * width / 2 * left).tolist())
            for u, v in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
        colour: Colour = style.GREEN if own else (107, 107, 107, 150)
        self.pen.polygon(corners, fill=colour, outline="white" if own else None, width=FINE)

    def _draw_sensors(self) -> None:
        for name in self.loop.changes.viewsheds:
            x, y = self.view.place(self.loop.changes.poles[name])
            falls = max(1 - 3 * self.part, 0.0) if self.act == 1 else 0.0
            y -= 90 * FINE * falls**2
            self._dot((x, y), 11, style.BLUE, "white")
            self._text((x / FINE, y / FINE), name, 11, bold=True, fill="white", anchor="mm")

    def _draw_messages(self, vehicles: dict[str, tuple[float, float]]) -> None:
        """Draw the model on its way down in the first half of a round, and updates on their way up in the second."""
        moment, sheds = self.loop.rounds[self.now], self.loop.changes.viewsheds
        poles = [self.view.place(self.loop.changes.poles[name]) for name in sheds]
        server = poles[0] if poles else (SIZE * FINE / 2, SIZE * FINE / 2)
        ends = [(server, vehicles[name], style.BLUE) for name in moment.clients if name in vehicles]
        cloud = (float((SIZE - 40) * FINE), float(24 * FINE))
        if moment.cloud:
            ends.append((cloud, server, style.PURPLE))
        down = self.within < 0.5
        gone = min((self.within if down else self.within - 0.5) * 2.2, 1.0)
        for start, end, colour in ends:
            self.pen.line((*start, *end), fill=colour, width=FINE)
            a, b = np.array(start if down else end), np.array(end if down else start)
            x, y = (a + (b - a) * gone).tolist()
            self._dot((x, y), 5.5, colour, "white")
        if moment.cloud:
            x, y = cloud
            self.pen.rounded_rectangle(
                (x - 32 * FINE, y - 12 * FINE, x + 32 * FINE, y + 12 * FINE), 12 * FINE, style.PURPLE
            )
            self._text((x / FINE, y / FINE), "cloud", 12, bold=True, fill="white", anchor="mm")

    def _tell(self) -> None:
        """Write what happens, in two lines."""
        loop, changes = self.loop, self.loop.changes
        shown = int((loop.share <= self.part).sum()) if self.act == 0 else len(changes.errors)
        poles = " and ".join(changes.viewsheds) or "no"
        seen, whole = int(changes.seen.sum()), len(changes.errors)
        drives = f"of {loop.drives} drives, one is shown" if loop.drives > 1 else "of a drive"
        first, second = (
            (f"1  The network errs: {shown} of {whole}", f"dots are missed, crosses false; {drives}"),
            (f"2  A sensor on pole {poles}", f"has {seen} of them in sight past the houses"),
            (f"3  {loop.rounds[self.now].name}", "the model goes down, updates come up"),
            (
                f"4  {changes.gone} of {whole} errors are gone",
                f"green; orange are left, and {len(changes.new)} in red are new",
            ),
        )[self.act]
        self._text((LEFT, 52), first, 19, bold=True)
        self._text((LEFT, 78), second, 13, fill=style.MUTED)

    def _draw_scores(self) -> None:
        """Draw the validation score by round, up to the last one that has ended."""
        loop, (low_y, high_y) = self.loop, (322, 142)
        known = [each.score for each in loop.rounds if each.score is not None]
        if not known:
            return
        low, high = np.floor(min(known) * 20) / 20, np.ceil(max(known) * 20) / 20
        high = high if high > low else low + 0.05
        rounds = max(len(loop.rounds) - 1, 1)

        def place(number: int, score: float) -> tuple[float, float]:
            return LEFT + 34 + (RIGHT - LEFT - 50) * number / rounds, low_y - (low_y - high_y) * (score - low) / (
                high - low
            )

        self._text((LEFT, high_y - 22), f"{loop.measure} of {loop.task} in {loop.region}, by round", 13, bold=True)
        for score in np.arange(low, high + 1e-9, 0.05 if high - low < 0.31 else 0.1):
            _, y = place(0, score)
            self.pen.line(((LEFT + 34) * FINE, y * FINE, RIGHT * FINE, y * FINE), fill=style.RULE, width=1)
            self._text((LEFT + 28, y), f"{score:.2f}", 11, fill=style.MUTED, anchor="rm")
        points = [
            (*place(n, each.score), each.score)
            for n, each in enumerate(loop.rounds)
            if each.score is not None and n <= self.ended
        ]
        self.pen.line([(x * FINE, y * FINE) for x, y, _ in points], fill=style.BLUE, width=2 * FINE)
        for x, y, _ in points:
            self._dot((x * FINE, y * FINE), 3.2, style.BLUE, "white")
        x, y, score = points[-1]
        self._text(
            (min(max(x, LEFT + 56), RIGHT - 20), y - 12), f"{score:.3f}", 14, bold=True, fill=style.BLUE, anchor="ms"
        )
        self._text((LEFT + 34, low_y + 20), "pretrained", 11, fill=style.MUTED)
        self._text((RIGHT, low_y + 20), loop.rounds[-1].name, 11, fill=style.MUTED, anchor="rs")

    def _draw_links(self) -> None:
        """Draw the megabytes that were sent, beside what the budgets allow."""
        for row, link in enumerate(LINKS):
            before, after = (self.loop.rounds[max(n, 0)].sent_mb[link] for n in (self.now - 1, self.now))
            sent = before + (after - before) * min(max(2 * self.within - 1, 0.0), 1.0)
            budget, y = self.loop.budgets_mb[link], 384 + 58 * row
            self._text((LEFT, y), f"{link}: {sent:.1f} of {budget:g} MB", 13, bold=True)
            box = (LEFT * FINE, (y + 9) * FINE, RIGHT * FINE, (y + 21) * FINE)
            self.pen.rounded_rectangle(box, 6 * FINE, "#ececea")
            end = box[0] + (box[2] - box[0]) * min(sent / max(budget, 1e-9), 1.0)
            if end > box[0] + 12 * FINE:
                self.pen.rounded_rectangle(
                    (*box[:2], end, box[3]), 6 * FINE, style.BLUE if link == LINKS[0] else style.PURPLE
                )
        note = f"{self.loop.frames} validation frames, first training;"
        self._text((LEFT, 508), note, 11, fill=style.MUTED)
        self._text((LEFT, 523), "poses as recorded; sums of all regions in MB", 11, fill=style.MUTED)


def find_shares(traces: dict[str, Trace], scenes: Sequence[str], tracks: Sequence[str], at: Array) -> Array:
    """Return when errors were made (E,), in [0, 1] of their drives: their road users were nearest to them then.

    `at` (E, >=2) [m]. Without the drive or the road user, they are spread evenly.
    """
    shares = np.linspace(0.05, 0.95, len(scenes))
    for row, (scene, track) in enumerate(zip(scenes, tracks, strict=True)):
        trace = traces.get(scene)
        instant = None if trace is None else find_instant(trace, track, at[row])
        if trace is not None and instant is not None:
            shares[row] = 0.95 * instant / max(len(trace.time_s) - 1, 1)
    return shares
