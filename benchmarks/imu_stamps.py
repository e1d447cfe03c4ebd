"""IMU time stamps against the emulated device's true sampling instants, and what other drivers do."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from vical_drivers.clock import DeviceClock
from vical_drivers.microstrain import single_byte as sb
from vical_drivers.microstrain.port import ArrivalLog
from vical_mocks.clock import SkewedClock, make_link
from vical_mocks.gx3_device import Gx3Device
from vical_mocks.gx3_state import Settings

WANDER_PPM = 3.0
"""Amplitude of a sine over ten minutes, on top of the constant skew."""
LINKS = {"usb": "native USB, 1-2 ms polls", "ftdi": "FTDI, 16 ms timer", "uart": "RS-232"}
SETTLE_S = 10.0


@dataclass(frozen=True)
class Run:
    """One simulated recording, shape (n,) each, seconds of the host's clock."""

    true_s: np.ndarray
    arrival_s: np.ndarray
    ours_s: np.ndarray
    sigma_s: np.ndarray
    device_s: np.ndarray
    wire_s: float
    lost: int


def main(argv: list[str]) -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(prog="benchmarks imu_stamps", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="simulated, not waited for")
    parser.add_argument("--rates", default="100,1000", help="Hz")
    parser.add_argument("--links", default="usb,ftdi,uart")
    parser.add_argument("--skews", default="-100,100", help="ppm")
    args = parser.parse_args(argv)
    print(
        f"{args.seconds:g} s simulated, wander {WANDER_PPM:g} ppm in 600 s; errors after {SETTLE_S:g} s, us."
    )
    print('"PR2" is the 100-sample mean followed by an alpha-beta filter, "EMA" an exponential mean, 0.99.')
    print("The last column gives the others *our* wire time for nothing.\n")
    head = "link|Hz|skew ppm|ours RMS|max|RMS / sigma|naive|PR2|EMA|best other / ours|wire given"
    print(f"|{head}|\n|{'---|' * len(head.split('|'))}")
    for link in args.links.split(","):
        for rate_hz in (int(r) for r in args.rates.split(",")):
            for skew_ppm in (float(s) for s in args.skews.split(",")):
                run = simulate(link, rate_hz, skew_ppm, args.seconds)
                print(_row(link, rate_hz, skew_ppm, run), flush=True)
    return 0


def simulate(link_kind: str, rate_hz: int, skew_ppm: float, seconds: float, seed: int = 1) -> Run:
    """Run device, link, decoder and clock over simulated time; every byte is made and parsed."""
    baud = 115_200 if rate_hz <= 250 else 921_600
    eeprom = Settings(decimation=1000 // rate_hz, flags=0x0D00, baud=baud)
    clock = SkewedClock(50.0, skew_ppm, WANDER_PPM)
    device = Gx3Device(clock=clock, eeprom=eeprom, seed=seed, first_ticks=4_000_000_000)
    link = make_link(link_kind, np.random.default_rng(seed), baud)
    byte_ns = 1e10 / baud if link_kind in ("uart", "ftdi") else 0.0
    mapped = DeviceClock(sb.TICK_HZ, rate_hz=rate_hz)
    decoder, arrivals = sb.Decoder(), ArrivalLog()
    device.receive(bytes.fromhex("C4C129C2"), 50.0)
    truth: dict[int, float] = {}
    rows: list[tuple[float, float, float, float, float]] = []
    for t_s in np.arange(50.0, 50.0 + seconds, 0.02):
        for ready_s, data in device.advance(float(t_s)):
            link.push(data, ready_s)
        while device.sent:
            ticks, true_s = device.sent.popleft()
            truth[ticks] = true_s
        for arrival_s, data in link.poll(float(t_s)):
            arrivals.add(len(data), round(arrival_s * 1e9))
            samples = [record for record in decoder.feed(data) if record.kind == 0xC2]
            rows += [_stamped(record, arrivals, byte_ns, mapped, truth) for record in samples]
    columns = np.array(rows).T
    return Run(*columns, wire_s=31 * byte_ns * 1e-9, lost=mapped.lost)


def _stamped(
    record: sb.Record, arrivals: ArrivalLog, byte_ns: float, mapped: DeviceClock, truth: dict[int, float]
) -> tuple[float, float, float, float, float]:
    t_arrival_ns = arrivals.arrival_ns(record.end, byte_ns)
    device_time = mapped.add(record.ticks or 0, t_arrival_ns)
    assert device_time is not None
    stamp = mapped.stamp(device_time)
    ours_s = stamp.t_device_event_ns * 1e-9 - 31 * byte_ns * 1e-9
    true_s = truth.pop(record.ticks or 0)
    return true_s, t_arrival_ns * 1e-9, ours_s, stamp.t_sigma_ns * 1e-9, device_time.ticks / sb.TICK_HZ


def alpha_beta(device_s: np.ndarray, arrival_s: np.ndarray) -> np.ndarray:
    """Stamps of the PR2-era driver: mean offset of 100 samples, then an alpha-beta filter on the offset."""
    offset = device_s - arrival_s
    estimate, rate = float(np.mean(offset[:100])), 0.0
    out = np.empty_like(device_s)
    for i, measured in enumerate(offset):
        if i >= 100:
            estimate += rate
            error = measured - estimate
            estimate += 0.00995031 * error
            rate += 4.97506e-5 * error
        out[i] = device_s[i] - estimate
    return out


def exponential(device_s: np.ndarray, arrival_s: np.ndarray) -> np.ndarray:
    """Stamps of the vendor's hybrid clock: mean offset of 10 samples, then an exponential average of 0.99."""
    offset = arrival_s - device_s
    estimate = float(np.mean(offset[:10]))
    out = np.empty_like(device_s)
    for i, measured in enumerate(offset):
        if i >= 10:
            estimate = 0.99 * estimate + 0.01 * measured
        out[i] = device_s[i] + estimate
    return out


def _row(link: str, rate_hz: int, skew_ppm: float, run: Run) -> str:
    late = run.true_s - run.true_s[0] > SETTLE_S
    ours = (run.ours_s - run.true_s)[late]
    others = {
        "naive": run.arrival_s,
        "PR2": alpha_beta(run.device_s, run.arrival_s),
        "EMA": exponential(run.device_s, run.arrival_s),
    }
    errors = {name: _rms_us((stamps - run.true_s)[late]) for name, stamps in others.items()}
    given = min(_rms_us((s - run.wire_s - run.true_s)[late]) for s in others.values())
    best = min(errors.values())
    rms_us = _rms_us(ours)
    ratio = _rms_us(ours / run.sigma_s[late]) * 1e-6
    assert run.lost == 0
    cells = (
        *(LINKS[link], rate_hz, f"{skew_ppm:+.0f}", f"{rms_us:.1f}", f"{np.abs(ours).max() * 1e6:.0f}"),
        *(f"{ratio:.2f}", *(f"{e:.0f}" for e in errors.values())),
        *(f"{best / rms_us:.0f} x", f"{given / rms_us:.0f} x"),
    )
    return "| " + " | ".join(str(c) for c in cells) + " |"


def _rms_us(values: Iterator[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) * 1e6
