"""What a plan costs, against a count of its messages one by one."""

from hypothesis import given
from hypothesis import strategies as st

from flcav.network.plan import MessageSizes, StagePlan, price

SMALL = st.integers(0, 6)


@given(samples=SMALL, edge=SMALL, cloud=SMALL, k=st.integers(1, 3), groups=st.lists(st.integers(1, 4), min_size=1))
def test_price_counts_every_message(samples, edge, cloud, k, groups):
    wireless = wireline = 0.0
    for _ in range(samples):  # vehicle -> edge -> cloud
        wireless += 2.0
        wireline += 2.0
    for _ in range(edge):
        for vehicles in groups:
            wireless += 30.0 * vehicles
    for _ in range(cloud):
        for vehicles in groups:
            wireless += 30.0 * vehicles * k
            wireline += 30.0
    plan = StagePlan(samples, edge, cloud, tuple(groups), k)
    cost = price(plan, MessageSizes(sample_mb=2.0, model_mb=30.0))
    assert (cost.wireless_mb, cost.wireline_mb) == (wireless, wireline)
    for labelled in range(edge + 1):  # before each edge round, and once before the first cloud round
        for vehicles in groups if labelled < edge or cloud else ():
            wireless += 4.0 * vehicles
    outputs = price(plan, MessageSizes(sample_mb=2.0, model_mb=30.0, exchange_mb=30.0, labels_mb=4.0))
    assert (outputs.wireless_mb, outputs.wireline_mb) == (wireless, wireline)
    less = price(plan, MessageSizes(sample_mb=2.0, model_mb=30.0, exchange_mb=1.0, labels_mb=4.0))
    assert less.wireless_mb == wireless - 29.0 * sum(groups) * (edge + k * cloud)
    assert less.wireline_mb == wireline
