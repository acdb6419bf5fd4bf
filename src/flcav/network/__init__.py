"""Communication cost: the sizes of messages, the price of a training plan, and the ledger of uplink budgets."""

from typing import TYPE_CHECKING

from flcav.lazy import lazy_names

if TYPE_CHECKING:
    from flcav.network.ledger import Budget, BudgetExceeded, Ledger, LedgerEntry
    from flcav.network.plan import MessageSizes, Price, StagePlan, price

PLACES = {
    "Budget": "flcav.network.ledger",
    "BudgetExceeded": "flcav.network.ledger",
    "Ledger": "flcav.network.ledger",
    "LedgerEntry": "flcav.network.ledger",
    "MessageSizes": "flcav.network.plan",
    "Price": "flcav.network.plan",
    "StagePlan": "flcav.network.plan",
    "price": "flcav.network.plan",
}
__all__ = [*PLACES]  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__, __dir__ = lazy_names(__name__, PLACES)
