"""Traffic lights: the programs of a SUMO net, phases of fixed durations that repeat, and what overrides them.

Format: https://sumo.dlr.de/docs/Simulation/Traffic_Lights.html
"""

from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError, read_xml, shorten

LETTERS = frozenset("GgyruosO")  # SUMO's states of a link


@dataclass(frozen=True)
class LightProgram:
    """The program of one junction's lights."""

    junction: str
    durations_s: tuple[float, ...]  # of each phase
    states: tuple[str, ...]  # of each phase, one of `LETTERS` for each link
    offset_s: float  # the first phase begins at this time

    def at(self, time_s: float) -> str:
        """Return the letters of the links at a time."""
        left = (time_s - self.offset_s) % sum(self.durations_s)
        for duration, state in zip(self.durations_s, self.states):
            if left < duration - 1e-6:
                return state
            left -= duration
        return self.states[0]


class Lights:
    """The lights of a town, which follow their programs unless they are set or frozen."""

    def __init__(self, programs: tuple[LightProgram, ...], time_s: float) -> None:
        """Start at a time of the programs [s]."""
        self.frozen = False
        self._programs = {each.junction: each for each in programs}
        self._time_s = time_s
        self._set: dict[str, str] = {}

    def advance(self, dt_s: float) -> None:
        """Let the programs go on by `dt_s` [s], unless they are frozen."""
        if not self.frozen:
            self._time_s += dt_s

    def states(self) -> dict[str, str]:
        """Return the letters of the links of each junction."""
        return {name: self._set.get(name) or each.at(self._time_s) for name, each in self._programs.items()}

    def set(self, junction: str, state: str | None) -> None:
        """Let a junction show these letters, or its program again (None); raises `InputError` for others."""
        if junction not in self._programs:
            raise InputError(f"light {shorten(junction)}: the town has no such junction with lights")
        if state is None:
            self._set.pop(junction, None)
            return
        links = len(self._programs[junction].states[0])
        if len(state) != links or not set(state) <= LETTERS:
            letters = "".join(sorted(LETTERS))
            raise InputError(f"light {shorten(junction)}: {shorten(state)} must be {links} of the letters {letters}")
        self._set[junction] = state


def read_light_programs(net: Path) -> tuple[LightProgram, ...]:
    """Return the first program of each junction with lights; none where there is no net file.

    Phases of programs that react to traffic keep their nominal durations. Raises `InputError` for a damaged net.
    """
    if not net.exists():
        return ()
    found: dict[str, LightProgram] = {}
    try:
        for row in read_xml(net, "a SUMO net").iterfind("tlLogic"):
            name, phases = row.attrib["id"], row.findall("phase")
            durations = tuple(float(phase.attrib["duration"]) for phase in phases)
            states = tuple(phase.attrib["state"] for phase in phases)
            if not 0 < sum(durations) < 1e6 or len({len(state) for state in states}) != 1:
                raise ValueError(f"the phases of light {name}")
            found.setdefault(name, LightProgram(name, durations, states, float(row.get("offset", "0"))))
    except (LookupError, ValueError) as error:
        raise InputError(f"{net}: not a SUMO net ({type(error).__name__}: {error})") from None
    return tuple(found[name] for name in sorted(found))
