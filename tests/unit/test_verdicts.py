import pytest

from flcav.verdicts import HELD, NOT_HELD, UNDECIDED, explain_verdict, signed, verdict


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.01, 0.02, HELD),
        (-0.02, -0.01, NOT_HELD),
        (-0.01, 0.02, UNDECIDED),
        (0.0, 0.02, UNDECIDED),
        (-1, 0, UNDECIDED),
    ],
)
def test_only_an_interval_without_zero_decides(low: float, high: float, said: str) -> None:
    assert verdict(low, high) == said


def test_without_an_interval_nothing_is_decided() -> None:
    assert verdict(None, None) == UNDECIDED


def test_the_words_say_what_was_decided():
    assert explain_verdict(UNDECIDED) == "this run does not decide"
    assert explain_verdict(NOT_HELD) == "the claim did not hold in this run"
    assert (signed(-0.0125), signed(2, 1)) == ("−0.013", "+2.0")
