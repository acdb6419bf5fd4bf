"""Records of a run's rounds, read from its federations' checkpoints: a table (Parquet) and curves (TensorBoard)."""

import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pyarrow as pa

from flcav.network.ledger import BYTES_PER_MB, Ledger
from flcav.perception.training.run import event_files
from flcav.runs.recipe import CLOUD
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER
from flcav.runs.results.training import FederatedRound, StageResult
from flcav.runs.training.checkpoints import LAST, Checkpoint
from flcav.storage.records import write_any_table

ROUNDS, EVENTS = "rounds.parquet", "events"  # in the folder of a run's results
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("arm", "stage", "task", "server")),
        ("round", pa.int64()),
        ("clients", pa.list_(pa.string())),
        ("failed", pa.list_(pa.string())),  # "client: reason"
        ("samples", pa.int64()),
        ("loss", pa.float64()),
        ("up_bytes", pa.int64()),
        ("down_bytes", pa.int64()),
        ("epsilon", pa.float64()),
        ("seconds", pa.float64()),
        ("empty", pa.bool_()),
    ]
)


def read_rounds(
    folder: Path, region: str | None, before: int, seconds: Mapping[str, Sequence[float]] = {}
) -> tuple[FederatedRound, ...]:
    """Read the rounds of the federation in `folder`, with the bytes of their messages.

    `region`: that of a stage II; None for stage III, where the cloud's rounds precede those of the edge servers.
    `before`: number of ledger entries before the first round. `seconds`: durations of the rounds [s], by server; empty
    without a network.
    """
    if not (folder / LAST).exists():
        return ()
    entries = Ledger.load(folder / LEDGER).entries[before:]
    found = []
    for name, records in Checkpoint.read(folder, LAST).records.items():
        server = region or name.rpartition("/")[2]
        link = "wireline" if server == CLOUD else "wireless"
        for record in records:
            sent = Counter[str]()
            for entry in entries:
                concerned = server == CLOUD or entry.client.startswith(f"{server}/")
                if concerned and (entry.link, entry.round) == (link, record.round):
                    sent[entry.direction] += entry.bytes
            about = (record.clients, record.failed, record.samples, record.loss)
            took = seconds.get(server)
            lasted = took[record.round - 1] if took else None
            measured = (sent["up"], sent["down"], record.epsilon, lasted, record.divergence, record.empty)
            found.append(FederatedRound(server, record.round, *about, *measured))
    return tuple(found)


def list_rounds(run: Run) -> Iterator[tuple[str, StageResult, FederatedRound]]:
    """Yield arm, stage and record of every round of a run; steps that arms share are repeated for all of these."""
    for arm, result in run.arms.items():
        for stage in result.stages:
            for record in stage.records or ():
                yield arm, stage, record


def tabulate_federated_rounds(run: Run) -> pa.Table:
    """Return a table with one row per arm, stage, task, server and round."""
    rows = [
        {
            **vars(record),
            "arm": arm,
            "stage": stage.stage,
            "task": stage.task,
            "failed": [f"{client}: {reason}" for client, reason in record.failed.items()],
        }
        for arm, stage, record in list_rounds(run)
    ]
    return pa.Table.from_pylist(rows, schema=SCHEMA)


def write_rounds(run: Run, out: Path) -> None:
    """Write `tabulate_federated_rounds` to `out`/rounds.parquet, and the curves of every federation to `out`/events.

    There is a folder of TensorBoard event files per arm, stage, task and server.
    """
    write_any_table(tabulate_federated_rounds(run), out / ROUNDS)
    shutil.rmtree(out / EVENTS, ignore_errors=True)
    curves: dict[str, list[FederatedRound]] = {}
    for arm, stage, record in list_rounds(run):
        name = f"{arm}/{stage.stage}/{stage.task.replace(':', '_')}/{record.server}"
        curves.setdefault(name, []).append(record)
    for name, records in curves.items():
        with event_files(out / EVENTS / name) as watch:
            for record in records:
                watch(record.round, scalars(record))


def scalars(record: FederatedRound) -> dict[str, float]:
    """Return the numbers of a round that TensorBoard shows, by name."""
    found = {
        "loss": record.loss,
        "clients": float(len(record.clients)),
        "failed": float(len(record.failed)),
        "uplink_mb": record.up_bytes / BYTES_PER_MB,
        "downlink_mb": record.down_bytes / BYTES_PER_MB,
        "epsilon": record.epsilon,
        "seconds": record.seconds,
    }
    return {name: value for name, value in found.items() if value is not None}
