"""Network: message sizes, uplink traffic of a plan, ledger of budgets, radio links, simulated clock of rounds."""

from typing import TYPE_CHECKING

from flcav.interface.fields import lazy_names

if TYPE_CHECKING:
    from flcav.network.clock.records import (
        ClientTiming,
        ClientWork,
        RoundTiming,
        load_rounds,
        save_rounds,
        work_of_messages,
    )
    from flcav.network.clock.rounds import NetworkSettings, RoundRules, simulate_rounds
    from flcav.network.ledger import BudgetExceeded, Ledger, LedgerEntry, LinkMegabytes
    from flcav.network.plan import MessageSizes, StagePlan, price
    from flcav.network.radio.budget import Radio
    from flcav.network.radio.links import RadioLinks, Wireline, link_vehicles
    from flcav.network.radio.measured import Throughput, link_measured, load_throughput
    from flcav.network.radio.recorded import Coverage, RecordedScene, cover_town, link_scene

PLACES = {
    "LinkMegabytes": "flcav.network.ledger",
    "BudgetExceeded": "flcav.network.ledger",
    "Ledger": "flcav.network.ledger",
    "LedgerEntry": "flcav.network.ledger",
    "MessageSizes": "flcav.network.plan",
    "StagePlan": "flcav.network.plan",
    "price": "flcav.network.plan",
    "Radio": "flcav.network.radio.budget",
    "RadioLinks": "flcav.network.radio.links",
    "link_vehicles": "flcav.network.radio.links",
    "Throughput": "flcav.network.radio.measured",
    "link_measured": "flcav.network.radio.measured",
    "load_throughput": "flcav.network.radio.measured",
    "RecordedScene": "flcav.network.radio.recorded",
    "link_scene": "flcav.network.radio.recorded",
    "Coverage": "flcav.network.radio.recorded",
    "cover_town": "flcav.network.radio.recorded",
    "Wireline": "flcav.network.radio.links",
    "ClientWork": "flcav.network.clock.records",
    "work_of_messages": "flcav.network.clock.records",
    "NetworkSettings": "flcav.network.clock.rounds",
    "RoundRules": "flcav.network.clock.rounds",
    "simulate_rounds": "flcav.network.clock.rounds",
    "ClientTiming": "flcav.network.clock.records",
    "RoundTiming": "flcav.network.clock.records",
    "load_rounds": "flcav.network.clock.records",
    "save_rounds": "flcav.network.clock.records",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
