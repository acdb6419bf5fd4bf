"""The registry of a fleet's vehicles (SQLite): their certificates, and an audit trail of every change.

A row of `certificates` is one certificate: in force, revoked, or replaced by that of a newer key. Expiry needs no
change of state. A change and its entry in `audit` are one transaction; entries are never changed.
"""

import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from flcav.config import InputError

State = Literal["registered", "revoked", "replaced"]
SCHEMA = """
CREATE TABLE authority (fingerprint TEXT NOT NULL);
CREATE TABLE certificates (
    fingerprint TEXT PRIMARY KEY,  -- SHA-256 of the certificate, hexadecimal
    vehicle TEXT NOT NULL,
    public_key BLOB NOT NULL UNIQUE,  -- SubjectPublicKeyInfo, DER
    issued INTEGER NOT NULL,  -- seconds since 1970, UTC
    expires INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('registered', 'revoked', 'replaced')),
    node TEXT  -- a number below 2^64, of Flower's SuperLink, where the key is enrolled
);
CREATE UNIQUE INDEX in_force ON certificates (vehicle) WHERE state = 'registered';
CREATE INDEX of_vehicle ON certificates (vehicle);
CREATE TABLE audit (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    time INTEGER NOT NULL,
    action TEXT NOT NULL,
    vehicle TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    reason TEXT NOT NULL
);
CREATE TRIGGER audit_stays BEFORE UPDATE ON audit BEGIN SELECT RAISE(ABORT, 'an audit trail is not changed'); END;
CREATE TRIGGER audit_is_kept BEFORE DELETE ON audit BEGIN SELECT RAISE(ABORT, 'an audit trail is not changed'); END;
"""
REQUESTS = """
CREATE TABLE IF NOT EXISTS requests (
    nonce TEXT PRIMARY KEY,
    vehicle TEXT NOT NULL,
    time REAL NOT NULL,  -- when it came, seconds since 1970
    content BLOB NOT NULL  -- the request as it was sent
);
CREATE INDEX IF NOT EXISTS requests_by_time ON requests (time);
CREATE TABLE IF NOT EXISTS answered (
    nonce TEXT PRIMARY KEY,  -- of a request that a group was formed from
    time REAL NOT NULL  -- when, seconds since 1970
);
"""  # these tables are added when a registry of an earlier version is opened
KEPT_S = 86400.0  # retention of an FL request [s]
WINDOW_S, MOST = 300.0, 60  # rate limit of one vehicle: window [s] and number of requests
BUSY_S = 10.0  # timeout of a registry locked by another process [s]


class RegistryLost(OSError):
    """The registry cannot be read or written: another process holds it, its disk is full, or it is damaged."""


@contextmanager
def _registry_errors(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into `RegistryLost`, with a sentence."""
    try:
        yield
    except sqlite3.Error as error:
        held = "another process holds it; try again" if "locked" in str(error) else str(error)
        raise RegistryLost(f"{path}: the registry cannot be used ({held})") from None


@dataclass(frozen=True)
class RegisteredVehicle:
    """A registered certificate of a vehicle."""

    name: str  # unique identifier
    fingerprint: str  # SHA-256 of the certificate, hexadecimal
    public_key: bytes  # SubjectPublicKeyInfo, DER
    issued: int  # [s since 1970, UTC]
    expires: int  # [s since 1970, UTC]
    state: State = "registered"
    node: int | None = None  # id at the SuperLink

    def describe_state(self, now: float | None = None) -> str:
        """Return the state in a word, "expired" for an expired certificate; now: [s since 1970]."""
        expired = (time.time() if now is None else now) >= self.expires
        return "expired" if expired and self.state == "registered" else self.state


@dataclass(frozen=True)
class AuditEntry:
    """The audit entry of one change of the registry."""

    number: int
    time: int  # [s since 1970, UTC]
    action: str
    vehicle: str
    fingerprint: str
    reason: str


class VehicleRegistry:
    """The registry in an SQLite file; every call is one transaction, so that several processes can use it.

    All calls raise `RegistryLost` where the file cannot be used.
    """

    def __init__(self, path: Path, busy_s: float = BUSY_S) -> None:
        self.path = path
        with _registry_errors(path):
            self._connection = sqlite3.connect(path, timeout=busy_s, isolation_level=None, check_same_thread=False)

    @classmethod
    def create(cls, path: Path, authority: str) -> "VehicleRegistry":
        """Return a new, empty registry of the authority with this fingerprint."""
        made = cls(path)
        with _registry_errors(path):
            made._connection.execute("PRAGMA journal_mode=WAL")
            made._connection.executescript(f"BEGIN; {SCHEMA} {REQUESTS} COMMIT;")
        with made._change() as cursor:
            cursor.execute("INSERT INTO authority VALUES (?)", (authority,))
            made._note(cursor, "found", "", authority, "")
        return made

    @classmethod
    def open(cls, path: Path, authority: str, busy_s: float = BUSY_S) -> "VehicleRegistry":
        """Return the registry at `path`; raises `InputError` where there is none, or another authority's.

        busy_s: timeout of its calls where another process has locked it [s].
        """
        if not path.exists():
            raise InputError(f"{path}: no such registry")
        found = cls(path, busy_s)
        try:
            found._check(authority)
        except BaseException:
            found.close()
            raise
        return found

    def _check(self, authority: str) -> None:
        with _registry_errors(self.path):
            try:
                row = self._connection.execute("SELECT fingerprint FROM authority").fetchone()
            except sqlite3.DatabaseError as error:
                if "locked" in str(error):
                    raise
                raise InputError(f"{self.path}: is no registry of a fleet") from None
        if row != (authority,):
            raise InputError(f"{self.path}: is the registry of another authority than {self.path.parent / 'ca.crt'}")
        if len(self._read("SELECT name FROM sqlite_master WHERE name IN ('requests_by_time', 'answered')")) < 2:
            with _registry_errors(self.path):
                self._connection.executescript(f"BEGIN; {REQUESTS} COMMIT;")

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def register(self, vehicle: RegisteredVehicle) -> None:
        """Register a new vehicle; raises `InputError` where its identifier or its key is known."""
        with self._change() as cursor:
            known = cursor.execute("SELECT 1 FROM certificates WHERE vehicle = ?", (vehicle.name,)).fetchone()
            if known:
                raise InputError(
                    f"vehicle '{vehicle.name}': is registered already; flcav fleet rotate gives it a new key"
                )
            self._insert(cursor, vehicle, "register")

    def rotate(self, vehicle: RegisteredVehicle) -> None:
        """Register the certificate of a vehicle's new key, in place of the one in force or a revoked one.

        Raises `InputError` where the vehicle is not registered, or the key is known.
        """
        with self._change() as cursor:
            if not cursor.execute("SELECT 1 FROM certificates WHERE vehicle = ?", (vehicle.name,)).fetchone():
                raise InputError(f"vehicle '{vehicle.name}': is not registered")
            cursor.execute(
                "UPDATE certificates SET state = 'replaced' WHERE vehicle = ? AND state = 'registered'", (vehicle.name,)
            )
            self._insert(cursor, vehicle, "rotate")

    def revoke(self, name: str, reason: str = "") -> None:
        """Revoke a vehicle's certificate at once; raises `InputError` where none is in force."""
        with self._change() as cursor:
            row = cursor.execute(
                "SELECT fingerprint FROM certificates WHERE vehicle = ? AND state = 'registered'", (name,)
            ).fetchone()
            if row is None:
                raise InputError(f"vehicle '{name[:80]}': has no certificate in force")
            cursor.execute("UPDATE certificates SET state = 'revoked' WHERE fingerprint = ?", row)
            self._note(cursor, "revoke", name, row[0], reason)

    def set_node(self, fingerprint: str, node: int | None) -> None:
        """Set the node id of a certificate's key at the SuperLink; None: it is no longer enrolled."""
        with self._change() as cursor:
            cursor.execute(
                "UPDATE certificates SET node = ? WHERE fingerprint = ?",
                (None if node is None else str(node), fingerprint),
            )
            name = cursor.execute("SELECT vehicle FROM certificates WHERE fingerprint = ?", (fingerprint,)).fetchone()[
                0
            ]
            self._note(cursor, "enrol" if node is not None else "strike", name, fingerprint, "")

    def find(self, fingerprint: str) -> RegisteredVehicle | None:
        """Return the vehicle whose certificate has this SHA-256 fingerprint; None if it is not registered."""
        found = [*self._select("WHERE fingerprint = ?", (fingerprint,))]
        return found[0] if found else None

    def list_vehicles(self) -> list[RegisteredVehicle]:
        """Return the latest certificate of every vehicle, ordered by identifier."""
        latest = "WHERE rowid IN (SELECT max(rowid) FROM certificates GROUP BY vehicle) ORDER BY vehicle"
        return [*self._select(latest)]

    def list_enrolled(self) -> list[RegisteredVehicle]:
        """Return every certificate whose key has a node at the SuperLink, in force or not."""
        return [*self._select("WHERE node IS NOT NULL")]

    def take_request(self, vehicle: str, nonce: str, content: bytes, now: float) -> str | None:
        """Store a vehicle's FL request for a day; return a sentence if it is a replay or exceeds the rate limit.

        now: [s since 1970].
        """
        with self._change() as cursor:
            cursor.execute("DELETE FROM requests WHERE time < ?", (now - KEPT_S,))
            cursor.execute("DELETE FROM answered WHERE nonce NOT IN (SELECT nonce FROM requests)")
            if cursor.execute("SELECT 1 FROM requests WHERE nonce = ?", (nonce,)).fetchone():
                return "a request with this nonce came before"
            since = vehicle, now - WINDOW_S
            (count,) = cursor.execute("SELECT count(*) FROM requests WHERE vehicle = ? AND time > ?", since).fetchone()
            if count >= MOST:
                return f"{MOST} requests within {WINDOW_S:.0f} s are enough"
            cursor.execute("INSERT INTO requests VALUES (?, ?, ?, ?)", (nonce, vehicle, now, content))
        return None

    def list_requests(self, most: int) -> list[tuple[str, float, bytes]]:
        """Return vehicle, time of arrival [s since 1970] and content of the last `most` requests, latest last."""
        query = "SELECT vehicle, time, content FROM requests ORDER BY time DESC LIMIT ?"
        return self._read(query, (most,))[::-1]

    def list_open_requests(self, since: float) -> list[tuple[str, bytes]]:
        """Return vehicle and content of the unanswered requests after `since` [s since 1970], latest last."""
        query = "SELECT vehicle, content FROM requests WHERE time > ? AND nonce NOT IN (SELECT nonce FROM answered)"
        return self._read(f"{query} ORDER BY time", (since,))

    def answer_requests(self, nonces: Iterable[str], now: float) -> None:
        """Mark the requests with these nonces as answered by a group at the time `now` [s since 1970]."""
        with self._change() as cursor:
            cursor.executemany("INSERT OR IGNORE INTO answered VALUES (?, ?)", [(nonce, now) for nonce in nonces])

    def list_answered(self) -> set[str]:
        """Return the nonces of the answered requests."""
        return {nonce for (nonce,) in self._read("SELECT nonce FROM answered")}

    def count_changes(self) -> int:
        """Return the number of changes of the registry so far."""
        return self._read("SELECT coalesce(max(number), 0) FROM audit")[0][0]

    def list_audit(self, vehicle: str | None = None) -> list[AuditEntry]:
        """Return the audit trail of one vehicle or of all, oldest entry first."""
        rows = self._read("SELECT * FROM audit WHERE ?1 IS NULL OR vehicle = ?1 ORDER BY number", (vehicle,))
        return [AuditEntry(*row) for row in rows]

    def _select(self, where: str, values: tuple[str, ...] = ()) -> Iterator[RegisteredVehicle]:
        columns = "vehicle, fingerprint, public_key, issued, expires, state, node"
        for *row, node in self._read(f"SELECT {columns} FROM certificates {where}", values):
            yield RegisteredVehicle(*row, node=None if node is None else int(node))

    def _read(self, sql: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        with _registry_errors(self.path):
            return self._connection.execute(sql, values).fetchall()

    @contextmanager
    def _change(self) -> Iterator[sqlite3.Cursor]:
        with _registry_errors(self.path):
            cursor = self._connection.cursor()
            # takes the write lock at once: what is read within the change stays true until its end
            cursor.execute("BEGIN IMMEDIATE")
            try:
                yield cursor
                cursor.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:  # on a full disk SQLite has rolled back already
                    cursor.execute("ROLLBACK")
                raise

    def _insert(self, cursor: sqlite3.Cursor, vehicle: RegisteredVehicle, action: str) -> None:
        row = (
            vehicle.fingerprint,
            vehicle.name,
            vehicle.public_key,
            vehicle.issued,
            vehicle.expires,
            "registered",
            None,
        )
        try:
            cursor.execute("INSERT INTO certificates VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        except sqlite3.IntegrityError:
            raise InputError(f"vehicle '{vehicle.name}': its key is in the registry already; make a new one") from None
        self._note(cursor, action, vehicle.name, vehicle.fingerprint, "")

    @staticmethod
    def _note(cursor: sqlite3.Cursor, action: str, vehicle: str, fingerprint: str, reason: str) -> None:
        entry = int(time.time()), action, vehicle, fingerprint, reason[:500]
        cursor.execute("INSERT INTO audit (time, action, vehicle, fingerprint, reason) VALUES (?, ?, ?, ?, ?)", entry)
