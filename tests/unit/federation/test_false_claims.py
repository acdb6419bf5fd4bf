"""Keys, shares, reports and arrays that are not what they claim to be: each is refused."""

from dataclasses import replace

import numpy as np
import pytest
from flwr.app import Array, ConfigRecord, RecordDict

from flcav.federation.acceptance import ReplyRefused
from flcav.federation.secure.messages import read_keys, read_shares
from flcav.federation.secure.parties import SecureClient
from flcav.federation.wire import ASK, CIPHERS, MASKS, NAMES, SHARES, to_numpy
from flcav.fleet.releases import MOST, ShadowReport


@pytest.mark.parametrize("bad", [CIPHERS, MASKS])
def test_both_public_keys_of_a_round_are_checked(bad: str):
    keys = SecureClient.draw("a").keys
    record = ConfigRecord({CIPHERS: keys.cipher, MASKS: keys.mask})
    assert read_keys(RecordDict({ASK: record}))[0] == keys
    record[bad] = b"\0" * len(keys.mask)
    with pytest.raises(ReplyRefused, match="nobody can agree"):
        read_keys(RecordDict({ASK: record}))


@pytest.mark.parametrize("share", [b"1234567", b"123456789", "12345678"])
def test_a_share_of_another_size_is_refused(share: bytes | str):
    good = RecordDict({ASK: ConfigRecord({NAMES: ["a", "b"], SHARES: [b"12345678", b"87654321"]})})
    assert read_shares(good, ["a", "b"], 8) == {"a": b"12345678", "b": b"87654321"}
    shares = [b"12345678", share] if isinstance(share, bytes) else [share, share]  # a record holds one type
    with pytest.raises(ReplyRefused, match="not of 8 bytes"):
        read_shares(RecordDict({ASK: ConfigRecord({NAMES: ["a", "b"], SHARES: shares})}), ["a", "b"], 8)  # pyright: ignore


@pytest.mark.parametrize("field", ["frames", "driving_found", "candidate_found", "agreed"])
@pytest.mark.parametrize("number", [-1, MOST])
def test_a_shadow_run_has_possible_numbers(field: str, number: int):
    report = ShadowReport("a", "objects", "0" * 64, "1" * 64, 3, 2, 2, 1)
    report.check()
    with pytest.raises(ValueError, match="below 0, or too large"):
        replace(report, **{field: number}).check()


@pytest.mark.parametrize("kind", ["O", "object", "|S8", "datetime64[s]"])
def test_an_array_of_no_numbers_is_refused_by_its_type(kind: str):
    whole = Array(np.zeros(2))
    with pytest.raises(ValueError, match="is no type of numbers"):
        to_numpy(Array(kind, whole.shape, whole.stype, whole.data))
