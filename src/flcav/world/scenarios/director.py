"""The director of scripted scenarios: it casts them, and advances their scripts along with SUMO."""

from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from flcav.world.map.roads import read_net
from flcav.world.scenarios import breakdowns, manoeuvres, overtaking, pedestrians
from flcav.world.scenarios.scenario import Kind, Scenario
from flcav.world.scenarios.stage import STEP_S, Stage, State
from flcav.world.trace import Event

Cast = Callable[[Stage, Scenario], Any]  # returns the roles, or None while nobody fits
Act = Callable[[Stage, Scenario, Any], Generator[None, None, None]]  # the script: one step per `yield`

SCRIPTS: dict[Kind, tuple[Cast, Act]] = {
    "cut_in": (manoeuvres.cast_cut_in, manoeuvres.cut_in),
    "overtaking": (overtaking.cast_overtaking, overtaking.overtake),
    "pedestrian_behind_van": (pedestrians.cast_behind_van, pedestrians.run_out),
    "red_light_runner": (manoeuvres.cast_runner, manoeuvres.run_the_light),
    "stalled_vehicle": (breakdowns.cast_stalled, breakdowns.stall),
    "crash": (breakdowns.cast_crash, breakdowns.crash),
}

ALONE_S = 15.0  # time after the start of a scenario during which its ego is not free: see `Stage.free_egos`
LOOKS_AGAIN = 3  # steps between two attempts to cast a scenario


class Director:
    """The director of the scenarios of one SUMO run."""

    def __init__(self, sumo: Any, net: Path, scenarios: list[Scenario]) -> None:
        """Start at the beginning of a run; `sumo` is the libsumo module, `net` the net file."""
        self.stage = Stage(sumo, read_net(net))
        self.events: list[Event] = []  # of scenarios that have begun, in order
        self._busy: set[str] = set()  # actors of a scenario, which do not take part in another
        self._scenarios = scenarios
        self._scripts: list[Generator[None, None, None] | None] = [
            self._play(number, scenario) for number, scenario in enumerate(scenarios)
        ]
        self._needed: dict[int, set[str]] = {}  # number of a running scenario -> vehicles that it needs

    def direct(self) -> None:
        """Advance all scripts by the step that SUMO has just made; end those that need a vehicle that has left."""
        self.stage.look()
        there = set(self.stage.sumo.vehicle.getIDList())
        for i, (scenario, script) in enumerate(zip(self._scenarios, self._scripts)):
            if script is not None and self._needed.get(i, set()) - there:
                self._scripts[i] = None
            elif script is not None and self.stage.step * STEP_S >= scenario.at_s - 1e-6:
                try:
                    next(script)
                except StopIteration:
                    self._scripts[i] = None
        self.stage.react(careless=self._busy)

    def _play(self, number: int, scenario: Scenario) -> Generator[None, None, None]:
        """Try to cast a scenario every `LOOKS_AGAIN` steps, then record its event and run its script."""
        cast, act = SCRIPTS[scenario.kind]
        while (roles := cast(self.stage, scenario)) is None or self._busy & set(list_actors(roles)):
            for _ in range(LOOKS_AGAIN):
                yield
        there, known = set(self.stage.sumo.vehicle.getIDList()), set(self.stage.props)
        playing = act(self.stage, scenario, roles)
        next(playing)
        actors = [name for name in list_actors(roles) if name in there]
        actors += [name for name in self.stage.props if name not in known]
        self._busy |= {name for name in actors if not name.startswith("cav")}
        self._needed[number] = {name for name in actors if name in there and not name.startswith("cav")}
        until = self.stage.step + round(ALONE_S / STEP_S)
        self.stage.engaged |= dict.fromkeys((name for name in actors if name.startswith("cav")), until)
        self.events.append(Event(scenario.kind, round(self.stage.step * STEP_S, 1), tuple(actors)))
        yield
        yield from playing

    def props(self, step: int) -> list[tuple[str, str, State]]:
        """Return names, vehicle types and states of the props that are present at a step."""
        return [(name, kind, states[step]) for name, (kind, states) in self.stage.props.items() if step in states]


def list_actors(roles: Any) -> list[str]:
    """Return the names of vehicles among the roles of a scenario: a name, or a tuple with some."""
    return [roles] if isinstance(roles, str) else [role for role in roles if isinstance(role, str)]
