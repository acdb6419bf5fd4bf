"""Errors of vehicles' poses, clocks and messages, drawn for the sightings of one scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flcav.fusion.average import Navigation, Sighting
from flcav.geometry import pose


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the errors of vehicles, and what the radio does to messages of all agents."""

    position_m: float = 0.0  # along x and along y, redrawn at each spin
    constant_m: float = 0.0  # along x and along y, the same all along
    heading_deg: float = 0.0  # redrawn at each spin
    latency_s: float = 0.0  # delay of every message
    loss: float = 0.0  # probability that a message is lost
    clock_s: float = 0.0  # offset of a vehicle's clock, the same all along

    @property
    def navigation(self) -> Navigation:
        """Return what the navigation of a vehicle states of its accuracy: at least a centimetre and .05 degrees."""
        sigma_m = np.hypot(self.position_m, self.constant_m)
        return Navigation(max(float(sigma_m), 0.01), max(float(np.radians(self.heading_deg)), 0.001))


def apply_errors(sightings: Sequence[Sighting], errors: Errors, rng: np.random.Generator) -> list[Sighting]:
    """Return the sightings of a scene as they arrive: poses and clocks of vehicles off, some messages lost.

    The same generator draws the same numbers whatever the errors' sizes, so that sizes can be compared.
    """
    agents = sorted({each.agent for each in sightings})
    constant = {agent: rng.standard_normal(3) for agent in agents}
    arrived = []
    for each in sightings:
        drawn, lost = rng.standard_normal(3), rng.random() < errors.loss
        if lost:
            continue
        if each.navigation is not None:
            own = constant[each.agent]
            dx, dy = errors.position_m * drawn[:2] + errors.constant_m * own[:2]
            turned = pose(0, 0, 0, float(np.radians(errors.heading_deg) * drawn[2]))
            off = each.world_from_agent @ turned
            off[:2, 3] = each.world_from_agent[:2, 3] + (dx, dy)
            clock_s = each.time_s + errors.clock_s * float(own[2])
            each = replace(each, world_from_agent=off, time_s=clock_s, navigation=errors.navigation)
        arrived.append(each)
    return arrived
