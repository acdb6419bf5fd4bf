"""The network: sizes of messages, the price of a plan, the ledger of budgets, radio links, the clock of rounds."""

from typing import TYPE_CHECKING

from flcav.interface.lazy import lazy_names

if TYPE_CHECKING:
    from flcav.network.clock.records import ClientTiming, RoundTiming, load_rounds, save_rounds
    from flcav.network.clock.rounds import NetworkSettings, RoundRules, simulate_rounds
    from flcav.network.clock.work import ClientWork, work_of_messages
    from flcav.network.ledger import BudgetExceeded, Ledger, LedgerEntry, LinkMegabytes
    from flcav.network.plan import MessageSizes, StagePlan, price
    from flcav.network.radio.budget import Radio
    from flcav.network.radio.coverage import Coverage, cover_town
    from flcav.network.radio.links import RadioLinks, link_vehicles
    from flcav.network.radio.recorded import RecordedScene, link_scene
    from flcav.network.radio.wireline import Wireline

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
    "RecordedScene": "flcav.network.radio.recorded",
    "link_scene": "flcav.network.radio.recorded",
    "Coverage": "flcav.network.radio.coverage",
    "cover_town": "flcav.network.radio.coverage",
    "Wireline": "flcav.network.radio.wireline",
    "ClientWork": "flcav.network.clock.work",
    "work_of_messages": "flcav.network.clock.work",
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
