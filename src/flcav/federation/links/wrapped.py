"""A Flower grid that wraps another one and delegates to it what a subclass does not override."""

from collections.abc import Iterable

from flwr.app import Message, RecordDict
from flwr.serverapp import Grid


class WrappedGrid(Grid):
    """Grid that passes on nodes, messages and the run of the grid `_grid`."""

    _grid: Grid

    def get_node_ids(self) -> list[int]:
        """Return the node ids of the inner grid."""
        return list(self._grid.get_node_ids())

    def create_message(
        self, content: RecordDict, message_type: str, dst_node_id: int, group_id: str, ttl: float | None = None
    ) -> Message:
        """Return a message of the inner grid."""
        return self._grid.create_message(content, message_type, dst_node_id, group_id, ttl)

    def set_run(self, run) -> None:
        """Set Flower's record of the run, in the inner grid."""
        self._grid.set_run(run)

    @property
    def run(self):
        """Return Flower's record of the run."""
        return self._grid.run

    def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
        """Send messages through the inner grid; return their ids."""
        return self._grid.push_messages(messages)

    def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
        """Return the replies that the inner grid has to these messages."""
        return self._grid.pull_messages(message_ids)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        """Return the inner grid's replies to messages."""
        return self._grid.send_and_receive(messages, timeout=timeout)
