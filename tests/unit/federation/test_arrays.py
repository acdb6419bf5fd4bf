"""Arrays of messages beside Flower's and NumPy's conversions, sums beside their formula, memory that is shared."""

import numpy as np
import pytest
from flwr.app import Array, ArrayRecord

from flcav.federation.links.processes import SharedBlock
from flcav.federation.strategies.fedavg import BLOCK, RunningMean
from flcav.federation.wire import to_array_record, to_weights

RNG = np.random.default_rng(0)
WEIGHTS = {
    "matrix": RNG.normal(size=(3, 5)).astype(np.float32),
    "across": RNG.normal(size=(5, 3)).T,  # in Fortran's order
    "half": RNG.normal(size=7).astype(np.float16),
    "count": np.array(5),
    "none": np.zeros((0, 4), np.int8),
}


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return [*one] == [*other] and all(
        (one[name].dtype, one[name].shape, one[name].tobytes()) == (array.dtype, array.shape, array.tobytes())
        for name, array in other.items()
    )


def test_arrays_become_flowers_bytes_and_weights_again():
    record = to_array_record(WEIGHTS)
    for name, array in record.items():
        flowers = Array(np.asarray(WEIGHTS[name], order="C"))
        assert (array.dtype, array.shape, array.stype, array.data) == (
            flowers.dtype,
            flowers.shape,
            flowers.stype,
            flowers.data,
        )
    back = to_weights(record)
    assert same(back, {name: array.numpy() for name, array in record.items()})
    assert all(array.flags.writeable for array in back.values())


def test_arrays_of_other_clients_are_read_as_flower_reads_them():
    sent = {"across": Array(WEIGHTS["across"]), "matrix": Array(WEIGHTS["matrix"])}  # the first in Fortran's order
    assert same(to_weights(ArrayRecord(sent)), {name: WEIGHTS[name] for name in sent})
    whole = Array(WEIGHTS["matrix"])
    for data in (whole.data[:-1], whole.data + b"1234", whole.data[:40], b"", b"no array at all"):
        with pytest.raises((ValueError, EOFError)):
            to_weights(ArrayRecord({"w": Array("float32", (3, 5), whole.stype, data)}))
    with pytest.raises(TypeError):
        to_weights(ArrayRecord({"w": Array("float32", (3, 5), "other", whole.data)}))


def test_a_running_mean_is_its_formula_to_the_bit():
    shares = [3.0, 1.0, 7.0]
    clients = [RNG.normal(size=(2, BLOCK - 5)).astype(np.float32) for _ in shares]  # longer than a block
    mean, total = RunningMean(), np.zeros(clients[0].shape)
    for array, share in zip(clients, shares, strict=True):
        mean.add({"w": array}, share)
        total = total + share * array.astype(np.float64)
    np.testing.assert_array_equal(mean.mean()["w"], (total / 11.0).astype(np.float32))


@pytest.mark.parametrize("size", [0, 100, 10_000])
def test_a_shared_block_returns_what_was_written_whether_it_fits_or_not(size: int):
    block = SharedBlock(size)
    try:
        first = block.read(block.write(WEIGHTS))
        name, second, how = block.read(block.write(("cav0", {"w": np.full(9, 2.0)}, {"steps": 3})))
    finally:
        block.close()
    assert same(first, WEIGHTS), "what was read is a copy"
    assert (name, second["w"].tolist(), how) == ("cav0", [2.0] * 9, {"steps": 3})
