"""What the proxy counts by vehicle: who came in anew, and who may have lost a message."""

import pytest

from flcav.federation.fleet.traffic import Traffic, read_traffic


@pytest.mark.parametrize(
    ("call", "status", "activations", "lost"),
    [
        ("activate-node", 200, 1, 0),
        ("activate-node", 401, 0, 0),
        ("confirm-message-received", 200, 0, 0),
        ("confirm-message-received", 500, 0, 1),
        ("push-object", 500, 0, 1),
        ("pull-messages", 500, 0, 0),
    ],
)
def test_losses(call, status, activations, lost, tmp_path):
    traffic = Traffic()
    traffic.count("cav-1", call, 1, 2, (10, 20), status)
    traffic.save(tmp_path)
    own = read_traffic(tmp_path).vehicles["cav-1"]
    assert (own.activations, own.lost) == (activations, lost)
