"""The clock: times by hand, against small steps of time, and what becomes of clients that drop out."""

import math
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from moving import made_links

from flcav.config import InputError
from flcav.network.clock.records import (
    ClientTiming,
    ClientWork,
    load_rounds,
    save_rounds,
    tabulate_rounds,
    work_of_messages,
)
from flcav.network.clock.rounds import NetworkSettings, RoundRules, simulate_rounds, time_round
from flcav.network.ledger import Direction, LedgerEntry, Link
from flcav.network.radio.links import Wireline

GOOD = 30.0  # dB: 2 bit/s/Hz, 20 Mbit/s of 10 MHz
MB = 1_000_000
NAN = np.nan


def work(name: str, down: int = 5 * MB, compute: float = 1.0, up: int = 10 * MB) -> ClientWork:
    return ClientWork(name, down, compute, up)


def only(links, *works: ClientWork, rules: RoundRules | None = None, start_s: float = 0.0):
    return {timing.client: timing for timing in time_round(links, works, 1, start_s, rules or RoundRules())}


def test_one_vehicle_by_hand():
    """5 MB at 20 Mbit/s take 2 s, 10 MB take 4 s."""
    links = made_links(np.arange(0, 20, 0.5), {"cav0": GOOD})
    timing = only(links, work("cav0"), start_s=3.25)["cav0"]
    assert (timing.download_s, timing.compute_s, timing.upload_s, timing.end_s) == pytest.approx((2, 1, 4, 10.25))
    assert (timing.downloaded_bytes, timing.uploaded_bytes, timing.dropped) == (5 * MB, 10 * MB, "")
    assert (timing.server, timing.round, timing.start_s) == ("pole1", 1, 3.25)


def test_two_vehicles_share_the_band_until_one_is_done():
    """Both download 5 MB at 10 Mbit/s: 4 s. cav1 computes 1 s longer; then 10 MB each, shared while both send."""
    links = made_links(np.arange(0.0, 40.0), {"cav0": GOOD, "cav1": GOOD})
    found = only(links, work("cav0"), work("cav1", compute=2.0))
    assert [found[name].download_s for name in ("cav0", "cav1")] == pytest.approx([4, 4])
    # from 5 s cav0 sends alone: 2.5 MB until 6 s; then 7.5 MB at half the rate: until 12 s
    assert found["cav0"].end_s == pytest.approx(12)
    # cav1 has sent 7.5 MB by then, and needs 1 s more
    assert found["cav1"].end_s == pytest.approx(13)
    assert found["cav1"].upload_s == pytest.approx(7)


def step_by_step(links, works, start_s, span=1e-3):
    """Return the ends of uploads by steps of time, with the rates of each step written out."""
    phase = dict.fromkeys((w.client for w in works), 0)
    left = {w.client: [8.0 * w.download_bytes, w.compute_s, 8.0 * w.upload_bytes] for w in works}
    ends, now = {}, start_s
    noise = 10 ** ((-174 + 9) / 10) * 10e6
    while len(ends) < len(works):
        n = int((links.time_s <= now + 1e-9).sum()) - 1
        sending = [name for name in phase if phase[name] in (0, 2)]
        for name in phase:
            if phase[name] == 3:
                continue
            if phase[name] == 1:
                left[name][1] -= span
            else:
                power = 10 ** ((29 - links.loss_db[n, links.vehicle.index(name), 0]) / 10)
                efficiency = min(0.4 * math.log2(1 + len(sending) * power / noise), 2)
                left[name][phase[name]] -= span * 10e6 / len(sending) * efficiency
        now += span
        for name in phase:
            while phase[name] < 3 and left[name][phase[name]] <= 0:
                phase[name] += 1
                if phase[name] == 3:
                    ends[name] = now
    return ends


def test_times_are_those_of_small_steps():
    rng = np.random.default_rng(6)
    names = ("cav0", "cav1", "cav2")
    links = made_links(np.arange(0, 60, 0.7), {name: rng.uniform(-5, 18, 86) for name in names})
    works = [work(name, 300_000 * (n + 1), 0.4 * n, 700_000) for n, name in enumerate(names)]
    found = only(links, *works, start_s=1.0)
    assert {name: timing.end_s for name, timing in found.items()} == pytest.approx(
        step_by_step(links, works, 1.0), abs=0.02
    )


def test_a_vehicle_that_leaves_the_town_is_named_and_the_round_goes_on():
    times = np.arange(0.0, 40.0)
    links = made_links(times, {"cav0": np.where(times < 3, GOOD, NAN), "cav1": GOOD})
    found = only(links, work("cav0"), work("cav1"))
    gone = found["cav0"]
    assert (gone.dropped, gone.end_s, gone.download_s, gone.upload_s) == ("left the town", 3.0, 3.0, 0.0)
    assert gone.downloaded_bytes == 3_750_000  # 3 s at 10 Mbit/s
    # cav1: 3.75 MB in 3 s shared, 1.25 MB in .5 s alone, 1 s of computing, 4 s of upload
    assert (found["cav1"].end_s, found["cav1"].dropped) == (pytest.approx(8.5), "")


def test_a_vehicle_that_is_absent_while_it_computes_is_dropped_too():
    times = np.arange(0.0, 40.0)
    links = made_links(times, {"cav0": np.where(times < 3, GOOD, NAN)})
    gone = only(links, work("cav0", compute=9.0))["cav0"]
    assert (gone.dropped, gone.end_s, gone.compute_s) == ("left the town", 3.0, pytest.approx(1.0))


def test_a_short_outage_costs_time_and_a_long_one_the_round():
    times = np.arange(0, 40, 0.5)
    dip = np.where((times >= 1) & (times < 1.5), -40.0, GOOD)
    gone = np.where(times >= 4, -40.0, GOOD)
    assert only(made_links(times, {"cav0": dip}), work("cav0"))["cav0"].end_s == pytest.approx(7.5)
    lost = only(made_links(times, {"cav0": gone}), work("cav0"), rules=RoundRules(outage_s=1.75))["cav0"]
    assert (lost.dropped, lost.end_s, lost.uploaded_bytes) == ("out of coverage", 5.75, 2_500_000)
    silent = only(made_links(times, {"cav0": gone}), work("cav0", compute=30, up=0))["cav0"]
    assert silent.dropped == ""  # it needs no radio there


def test_a_vehicle_that_comes_nearer_to_another_server_is_dropped_there():
    times = np.arange(0.0, 40.0)
    distance = np.stack((50 + 2 * times, 70 - 2 * times), axis=1)  # level at 5 s
    links = made_links(times, {"cav0": np.full((40, 2), GOOD)}, {"cav0": distance})
    moved = only(links, work("cav0"))["cav0"]
    assert (moved.server, moved.dropped, moved.end_s) == ("pole1", "nearer to pole2", 6.0)
    assert only(links, work("cav0"), rules=RoundRules(handover_margin_m=9))["cav0"].dropped == ""
    assert only(links, work("cav0"), start_s=10.0)["cav0"].server == "pole2"


def test_other_servers_vehicles_interfere():
    times = np.arange(0.0, 40.0)
    near = {"cav0": np.tile([1.0, 9.0], (40, 1)), "cav1": np.tile([9.0, 1.0], (40, 1))}
    sinr = {"cav0": np.tile([20.0, 5.0], (40, 1)), "cav1": np.tile([5.0, 20.0], (40, 1))}
    both = only(made_links(times, sinr, near), work("cav0"), work("cav1"))
    efficiency = 0.4 * math.log2(1 + 100 / (1 + 10**0.5))
    assert both["cav0"].download_s == pytest.approx(40e6 / (10e6 * efficiency))
    assert both["cav1"].end_s == pytest.approx(both["cav0"].end_s)
    assert only(made_links(times, sinr, near), work("cav0"))["cav0"].download_s == pytest.approx(2.0)


def test_the_deadline_and_the_end_of_the_trace():
    links = made_links(np.arange(0.0, 10.0), {"cav0": GOOD, "cav1": GOOD})
    late = only(links, work("cav0", 0, 1.0, 0), work("cav1"), rules=RoundRules(deadline_s=2.5))
    assert (late["cav0"].dropped, late["cav0"].end_s) == ("", 1.0)
    assert (late["cav1"].dropped, late["cav1"].end_s) == ("past the deadline", 2.5)
    ended = only(links, work("cav0", compute=99), start_s=8.5)["cav0"]
    assert (ended.dropped, ended.end_s) == ("the trace ends", 9.0)


def test_the_clock_may_count_from_1970():
    since = 1.7e9 + np.arange(0, 20, 0.5)
    links = made_links(since, {"cav0": GOOD, "cav1": GOOD})
    found = only(links, work("cav0"), work("cav1", 5 * MB + 1), start_s=1.7e9)  # done a time apart that is not told
    assert found["cav1"].end_s - 1.7e9 == pytest.approx(4 + 1 + 8, abs=1e-5)


def test_nothing_to_do_takes_no_time():
    links = made_links(np.arange(3.0), {"cav0": -40.0})
    timing = only(links, work("cav0", 0, 0.0, 0), start_s=0.25)["cav0"]
    assert (timing.end_s, timing.dropped) == (0.25, "")


SETTINGS = NetworkSettings(wireline=Wireline(rate_mbps=100, latency_s=0.1))


def test_rounds_follow_one_another_and_cloud_rounds_pay_the_wireline():
    links = made_links(np.arange(0.0, 80.0), {"cav0": GOOD, "cav1": GOOD})
    works = {name: work(name) for name in links.vehicle}
    records = simulate_rounds(links, [works] * 4, SETTINGS, edge_rounds_per_cloud_round=2, model_bytes=5 * MB)
    wire = 0.1 + 0.4
    radio = 4 + 1 + 8.0
    assert [record.wireline_down_s for record in records] == pytest.approx([wire, 0] * 2)
    assert [record.wireline_up_s for record in records] == pytest.approx([0, wire] * 2)
    starts = np.cumsum([0, wire + radio, radio + wire, wire + radio])
    assert [record.start_s for record in records] == pytest.approx(starts)
    assert records[0].clients[0].start_s == pytest.approx(wire)
    assert records[-1].end_s == pytest.approx(4 * (radio + wire))
    edge = simulate_rounds(links, [works] * 2, SETTINGS, start_s=1.0)
    assert edge[-1].end_s == pytest.approx(1 + 2 * radio)
    assert edge[0].wireline_up_s == 0


def test_who_is_in_the_town_takes_part_and_the_last_is_the_straggler():
    times = np.arange(0.0, 60.0)
    links = made_links(times, {"cav0": GOOD, "cav1": np.where(times < 2, GOOD, NAN), "cav2": GOOD})
    works = {"cav0": work("cav0"), "cav1": work("cav1"), "cav2": work("cav2", compute=9)}
    first, second = simulate_rounds(links, [works] * 2, SETTINGS)
    assert [client.client for client in first.clients] == ["cav0", "cav1", "cav2"]
    assert [client.client for client in first.finished] == ["cav0", "cav2"]
    assert [client.client for client in second.clients] == ["cav0", "cav2"]
    assert first.straggler is not None
    assert first.straggler.client == "cav2"
    assert first.end_s == first.straggler.end_s
    nobody = replace(first, clients=tuple(replace(client, dropped="out of coverage") for client in first.clients))
    assert nobody.straggler is None


def test_records_come_back_from_parquet(tmp_path):
    times = np.arange(0.0, 60.0)
    links = made_links(times, {"cav0": GOOD, "cav1": np.where(times < 2, GOOD, NAN)})
    records = simulate_rounds(links, [{name: work(name) for name in links.vehicle}] * 2, SETTINGS)
    path = tmp_path / "rounds.parquet"
    save_rounds(records, path)
    table = pq.read_table(path)
    assert table["client"].to_pylist() == ["cav0", "cav1", "cav0"]
    assert table["dropped"].to_pylist() == ["", "left the town", ""]
    assert table["uploaded_bytes"].to_pylist() == [10 * MB, 0, 10 * MB]
    assert table["round_end_s"].to_pylist() == [records[0].end_s, records[0].end_s, records[1].end_s]
    assert table.equals(tabulate_rounds(records))
    assert load_rounds(path) == records
    assert isinstance(records[0].clients[0], ClientTiming)
    pq.write_table(table.drop(["dropped"]), path)
    with pytest.raises(InputError, match=r"rounds\.parquet: not a table of rounds"):
        load_rounds(path)
    pq.write_table(table.set_column(1, "server", [[None, "pole1", "pole1"]]).cast(table.schema), path)
    with pytest.raises(InputError, match="an empty field"):
        load_rounds(path)


def test_the_work_of_a_round_is_what_the_ledger_has_of_it():
    def message(direction: Direction, client: str, size: int, link: Link = "wireless", number: int = 3) -> LedgerEntry:
        return LedgerEntry("edge", "objects", link, direction, number, client, size)

    sent = [message("down", "grid/cav0", 700), message("up", "grid/cav0", 90), message("up", "grid/cav0", 5)]
    sent += [message("down", "grid/cav1", 700), message("up", "grid", 10**9, "wireline")]
    assert work_of_messages(sent, {"cav0": 1.5, "cav1": 2.0, "cav2": 9.0}) == {
        "cav0": ClientWork("cav0", 700, 1.5, 95),
        "cav1": ClientWork("cav1", 700, 2.0, 0),
    }
    with pytest.raises(InputError, match="cav1: has no time to compute"):
        work_of_messages(sent, {"cav0": 1.5})
    with pytest.raises(InputError, match="messages of 2 rounds, stages, tasks or regions"):
        work_of_messages([*sent, message("up", "grid/cav1", 1, number=4)], {"cav0": 1.5, "cav1": 2.0})


def test_bad_input_is_one_sentence():
    links = made_links(np.arange(4.0), {"cav0": [NAN, GOOD, GOOD, GOOD]})
    with pytest.raises(InputError, match="cav0: upload_bytes = -1, at least 0 are wanted"):
        work("cav0", up=-1)
    with pytest.raises(InputError, match="compute_s = nan"):
        work("cav0", compute=NAN)
    with pytest.raises(InputError, match="round 1 begins at 3 s, but the trace is from 0 to 3 s"):
        only(links, work("cav0"), start_s=3.0)
    with pytest.raises(InputError, match=r"round 1: 'cav0' is not in the town at 0\.5 s"):
        only(links, work("cav0"), start_s=0.5)
    with pytest.raises(InputError, match="'cav7' is no vehicle of the links"):
        only(links, work("cav7"), start_s=1.0)
    with pytest.raises(InputError, match="'cav0' is no vehicle of the links, or named twice"):
        only(links, work("cav0"), work("cav0"), start_s=1.0)
    with pytest.raises(InputError, match="round 1: no client is in the town at 0 s"):
        simulate_rounds(links, [{"cav0": work("cav0")}] * 1, SETTINGS)
    with pytest.raises(InputError, match="3 edge rounds, 2 to a cloud round"):
        simulate_rounds(links, [{"cav0": work("cav0")}] * 3, SETTINGS, edge_rounds_per_cloud_round=2)
    with pytest.raises(InputError, match="begins at -1 s"):
        simulate_rounds(links, [{"cav0": work("cav0")}] * 1, SETTINGS, start_s=-1.0)
