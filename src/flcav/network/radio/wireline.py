"""Wireline links between edge servers and the cloud: a rate and a latency."""

from pydantic import Field

from flcav.config import Config, InputError


class Wireline(Config):
    """A cable between an edge server and the cloud, the same in both directions, used by nobody else."""

    rate_mbps: float = Field(default=1000.0, gt=0)
    latency_s: float = Field(default=0.01, ge=0, le=3600)

    def seconds(self, count: int) -> float:
        """Return the time that a message of `count` bytes takes [s]; raises `InputError` for a negative count.

        >>> Wireline(rate_mbps=100, latency_s=0.02).seconds(1_000_000)
        0.1
        """
        if count < 0:
            raise InputError(f"a message of {count} bytes: at least 0 are wanted")
        return self.latency_s + 8 * count / (self.rate_mbps * 1e6)
