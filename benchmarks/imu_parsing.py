"""IMU decoders: throughput on one core, ten million random bytes, recovery between damage."""

from __future__ import annotations

import argparse
import struct
import time
import tracemalloc

import numpy as np
from vical_drivers.microstrain import mip
from vical_drivers.microstrain import single_byte as sb

DECODERS = {"single-byte": sb.Decoder, "mip": mip.Decoder}


def main(argv: list[str]) -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(prog="benchmarks imu_parsing", description=__doc__)
    parser.add_argument("--random-bytes", type=int, default=10_000_000)
    parser.add_argument("--frames", type=int, default=200_000)
    args = parser.parse_args(argv)
    print("| decoder | stream | MB/s of CPU time | times the wire at 921600 baud |\n|---|---|---|---|")
    for name in DECODERS:
        for chunk in (4096, 64):
            rate = _throughput(name, chunk)
            print(f"| {name} | clean, {chunk} byte reads | {rate:.1f} | {rate / 0.09216:.0f} |", flush=True)
    print("\n| decoder | random bytes | false records | most memory, kB | s |\n|---|---|---|---|---|")
    for name in DECODERS:
        print(_random(name, args.random_bytes), flush=True)
    print("\n| decoder | damage | undamaged frames | recovered | false |\n|---|---|---|---|---|")
    for name in DECODERS:
        for kind in ("garbage between", "lost bytes inside", "flipped bits inside", "cut frames"):
            print(_recovery(name, kind, args.frames), flush=True)
    return 0


def frame(name: str, ticks: int, rng: np.random.Generator) -> bytes:
    """One sample with noisy values, made without the code under test."""
    acc = struct.pack(">3f", *(rng.normal(0, 0.3, 3) - np.array([0.0, 0.0, 1.0])))
    gyro = struct.pack(">3f", *rng.normal(0, 0.5, 3))
    if name == "single-byte":
        body = b"\xc2" + acc + gyro + struct.pack(">I", ticks)
        return body + struct.pack(">H", sum(body) % 65536)
    body = b"\x75\x65\x80\x22\x0e\x04" + acc + b"\x0e\x05" + gyro + b"\x06\x0e" + struct.pack(">I", ticks)
    first = second = 0
    for value in body:
        first = (first + value) & 255
        second = (second + first) & 255
    return body + bytes((first, second))


def ticks_of(record: sb.Record | mip.Packet) -> int | None:
    if isinstance(record, sb.Record):
        return record.ticks if record.kind == 0xC2 else None
    data = record.field(0x0E)
    return None if data is None else int.from_bytes(data, "big")


def _throughput(name: str, chunk: int) -> float:
    rng = np.random.default_rng(0)
    stream = b"".join(frame(name, i * 625, rng) for i in range(2000)) * 10
    best = 0.0
    for _ in range(3):
        decoder, start_s, count = DECODERS[name](), time.process_time(), 0
        for at in range(0, len(stream), chunk):
            count += len(decoder.feed(stream[at : at + chunk]))
        assert count == 20_000
        best = max(best, len(stream) / 1e6 / (time.process_time() - start_s))
    return best


def _random(name: str, size: int) -> str:
    rng = np.random.default_rng(1)
    decoder, records, start_s = DECODERS[name](), 0, time.process_time()
    tracemalloc.start()
    for _ in range(0, size, 10_000):
        records += len(decoder.feed(rng.bytes(10_000)))
    records += len(decoder.finish())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(decoder.pending) < 261
    seconds = time.process_time() - start_s
    return f"| {name} | {size} | {records} | {peak / 1e3:.0f} | {seconds:.0f} |"


def _recovery(name: str, kind: str, count: int) -> str:
    rng = np.random.default_rng(2)
    good: set[int] = set()
    parts: list[bytes] = []
    hit = rng.random(count) < (1.0 if kind == "garbage between" else 0.3)
    for i in range(count):
        data = frame(name, i, rng)
        if hit[i]:
            data, undamaged = _damaged(kind, data, rng)
        else:
            undamaged = True
        if undamaged:
            good.add(i)
        parts.append(data)
    decoder = DECODERS[name]()
    records = decoder.feed(b"".join(parts)) + decoder.finish()
    found = [ticks_of(r) for r in records]
    recovered = len(good & set(found))
    false = sum(1 for t in found if t is None or t not in good)
    return f"| {name} | {kind} | {len(good)} | {100 * recovered / len(good):.4f} % | {false} |"


def _damaged(kind: str, data: bytes, rng: np.random.Generator) -> tuple[bytes, bool]:
    at = int(rng.integers(len(data)))
    if kind == "garbage between":
        return rng.bytes(int(rng.integers(1, 60))) + data, True
    if kind == "lost bytes inside":
        return data[:at] + data[at + 1 :], False
    if kind == "flipped bits inside":
        return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :], False
    return data[:at], False
