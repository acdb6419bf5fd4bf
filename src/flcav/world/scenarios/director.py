"""Runs the scripts of the scenarios along with SUMO."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

from flcav.world.roads import read_net
from flcav.world.scenarios.scenario import Scenario
from flcav.world.scenarios.scripts import SCRIPTS
from flcav.world.scenarios.stage import STEP_S, Stage, State


class Director:
    """The scenarios of one run."""

    def __init__(self, sumo: Any, net: Path, scenarios: list[Scenario]) -> None:
        """Stand at the start of a run; `sumo` is the libsumo module."""
        self.stage = Stage(sumo, read_net(net))
        self.begun: dict[int, int] = {}  # scenario -> step
        self._scenarios = scenarios
        self._scripts: list[Generator[None, None, None] | None] = [
            self._play(i, scenario) for i, scenario in enumerate(scenarios)
        ]

    def direct(self) -> None:
        """Advance every script by the step that SUMO just made."""
        self.stage.look()
        for i, (scenario, script) in enumerate(zip(self._scenarios, self._scripts)):
            if script is not None and self.stage.step * STEP_S >= scenario.at_s - 1e-6:
                try:
                    next(script)
                except StopIteration:
                    self._scripts[i] = None

    def _play(self, number: int, scenario: Scenario) -> Generator[None, None, None]:
        cast, act = SCRIPTS[scenario.kind]
        while (roles := cast(self.stage, scenario)) is None:
            yield
        self.begun[number] = self.stage.step
        yield from act(self.stage, scenario, roles)

    def props(self, step: int) -> list[tuple[str, str, State]]:
        """Return name, vehicle type and state of every prop at a step."""
        return [(name, kind, states[step]) for name, (kind, states) in self.stage.props.items() if step in states]
