"""Messages as bytes: what is packed is what is unpacked, and nothing is sent that no budget carries."""

import socket
import threading

import numpy as np
import pytest

from flcav.network import ledger
from flcav.network.ledger import (
    BudgetExceeded,
    Ledger,
    LedgerEntry,
    LinkMegabytes,
    from_names,
    pack_arrays,
    send_message,
    to_names,
    unpack_arrays,
)


def test_arrays_and_names_come_back_as_they_were() -> None:
    arrays = {
        "points": np.arange(8, dtype=np.float32).reshape(2, 4)[:, ::-1],
        "empty": np.zeros((0, 7)),
        "count": np.array(3),
        "free": np.array([[True, False]]),
    }
    read = unpack_arrays(pack_arrays(arrays))
    assert {name: (value.dtype, value.shape) for name, value in read.items()} == {
        name: (value.dtype, value.shape) for name, value in arrays.items()
    }
    assert all(np.array_equal(read[name], value) for name, value in arrays.items())
    for names in ([], ["car"], ["", "two words", "größer"]):
        assert to_names(unpack_arrays(pack_arrays({"names": from_names(names)}))["names"]).tolist() == names


def test_a_message_is_booked_before_it_is_sent_in_the_bytes_that_a_socket_carries(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near, far = socket.socketpair()
    arrived: list[int] = []

    def through_a_socket(message: bytes) -> bytes:
        sender = threading.Thread(target=near.sendall, args=(message,))
        sender.start()
        received = b""
        while len(received) < len(message):
            received += far.recv(65536)
        sender.join()
        arrived.append(len(received))
        return received

    monkeypatch.setattr(ledger, "carry", through_a_socket)
    book = Ledger(LinkMegabytes(wireless_mb=0.5, wireline_mb=0.0))
    sample = {"points": np.random.default_rng(0).normal(size=(10_000, 4)).astype(np.float32)}
    with near, far:
        at_edge = send_message(
            book, pack_arrays(sample), stage="pretrain", task="t", link="wireless", direction="up", client="grid/cav0"
        )
        assert np.array_equal(unpack_arrays(at_edge)["points"], sample["points"])
        with pytest.raises(BudgetExceeded):
            send_message(book, at_edge, stage="pretrain", task="t", link="wireline", direction="up", client="grid")
        send_message(book, at_edge, stage="edge", task="t", link="wireline", direction="down", client="grid", round_=2)
    assert [entry.bytes for entry in book.entries] == arrived == [len(at_edge)] * 2
    assert book.entries[1] == LedgerEntry("edge", "t", "wireline", "down", 2, "grid", len(at_edge))
