"""A sensor spoken to in MIP: identify, configure, stream, stop. Serves GX3 (2.x) to CV7."""

from __future__ import annotations

import contextlib
import struct
import time

from vical_drivers.errors import DeviceRefusedError, DriverError
from vical_drivers.microstrain import mip
from vical_drivers.microstrain import mip_fields as fields
from vical_drivers.microstrain.mip_link import REPLY_TIMEOUT_S, TRIES, MipLink, UnknownCommandError
from vical_drivers.microstrain.port import BytePort, timeout
from vical_drivers.microstrain.session import Applied, ImuSettings, RawSample, group_delay_s, raise_baud
from vical_drivers.samples import DeviceInfo

_BAUDS = (115_200, 230_400, 460_800, 921_600)
_BUSY_WIRE = 0.9
"""Share of a UART that a stream may fill; a saturated one drops packets silently."""
_FLAGS_INERTIAL_ONLY = 0x0D00
"""Signal conditioning of the GX3: no orientation, no magnetometer, no compensations."""
_LEGACY_STREAM, _SENSOR_STREAM = 1, mip.SET_SENSOR
_SAVE = 3
"""Function selector that writes the EEPROM; only `store_gyro_bias` uses it."""


class MipSession:
    """See `session.Session`. The port stays the caller's."""

    protocol = "mip"

    def __init__(self, port: BytePort) -> None:
        self._port = port
        self._link = MipLink(port, self._keep)
        self._baud_found = port.baud
        self._backlog: list[RawSample] = []
        self._known: frozenset[int] = frozenset()
        self._time: fields.TimeField | None = None
        self._stream = _LEGACY_STREAM

    @property
    def reply_timeout_s(self) -> float:
        """How long one try waits for a reply, s; more for a device that samples at 1 Hz."""
        return self._link.reply_timeout_s

    @reply_timeout_s.setter
    def reply_timeout_s(self, timeout_s: float) -> None:
        self._link.reply_timeout_s = timeout_s

    @property
    def checksum_errors(self) -> int:
        """Damaged packets."""
        return self._link.stream.checksum_errors

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belong to no packet."""
        return self._link.stream.skipped_bytes

    def probe(self, timeout_s: float) -> bool:
        """Tell whether a sensor answers here in MIP."""
        with contextlib.suppress(DriverError):
            self._link.transact(mip.SET_BASE, 0x01, b"", timeout_s=timeout_s, tries=1)
            return True
        return False

    def quiet(self) -> None:
        """Stop whatever streams and wait until it is silent."""
        self._link.quiet()
        self._backlog = []

    def identify(self) -> DeviceInfo:
        """See `Session.identify`."""
        text = fields.identity(self._link.ask(mip.SET_BASE, 0x03, 0x81, size=82))
        self._known = self._descriptors()
        return DeviceInfo(
            kind="imu",
            model=text["model_name"] or text["model_number"] or "MIP sensor",
            serial_number=text["serial_number"],
            firmware=text["firmware"],
            path=self._port.name,
            protocol=self.protocol,
            details={k: text[k] for k in ("model_number", "options", "lot")},
        )

    def _descriptors(self) -> frozenset[int]:
        """Every descriptor the device knows, as set << 8 | descriptor; empty where it will not say."""
        known: set[int] = set()
        for command, reply, tries in ((0x04, 0x82, TRIES), (0x07, 0x86, 1)):
            with contextlib.suppress(DriverError):
                data = self._link.transact(mip.SET_BASE, command, b"", reply=reply, tries=tries).data or b""
                known.update(struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))
        return frozenset(known)

    def configure(self, settings: ImuSettings) -> Applied:
        """See `Session.configure`."""
        base_hz = self._base_rate_hz()
        decimation = max(1, round(base_hz / settings.rate_hz))
        delay_s, taps = self._set_filter(settings.taps)
        self._time = self._set_format(decimation)
        record_bytes = 6 + 14 + 14 + (2 + _size_of(self._time) if self._time else 0)
        self._choose_baud(settings, record_bytes * base_hz / decimation)
        return Applied(
            rate_hz=base_hz / decimation,
            group_delay_s=delay_s,
            record_bytes=record_bytes,
            tick_hz=self._time.tick_hz if self._time else 0.0,
            tick_bits=self._time.tick_bits if self._time else None,
            filter_width=taps,
        )

    def _base_rate_hz(self) -> float:
        """Base rate of the inertial data; newer devices want the data set named."""
        for command, reply, ask in ((0x06, 0x83, b""), (0x0E, 0x8E, bytes([mip.SET_SENSOR]))):
            with contextlib.suppress(DriverError):
                data = self._link.ask(mip.SET_3DM, command, reply, ask)
                rate = int.from_bytes(data[-2:], "big")
                if rate:
                    return float(rate)
        raise DeviceRefusedError(f"{self._port.name}: the device has no inertial data rate; is it an IMU?")

    def _set_filter(self, taps: int) -> tuple[float, int | None]:
        """Set the GX3's signal conditioning; other models keep theirs, whose delay is not known."""
        if self._known and mip.SET_3DM << 8 | 0x35 not in self._known:
            return 0.0, None
        wanted = struct.pack(">HHBBHHBH", 10, _FLAGS_INERTIAL_ONLY, taps, 17, 10, 10, 1, 0)
        try:
            self._link.command(mip.SET_3DM, 0x35, bytes([mip.APPLY]) + wanted)
        except DriverError:
            return 0.0, None
        in_force = self._link.ask(mip.SET_3DM, 0x35, 0x86, bytes([mip.READ]))
        if len(in_force) >= 5 and in_force[4] != taps:
            raise DeviceRefusedError(
                f"{self._port.name}: the device did not take its settings: "
                f"filter_width is {in_force[4]}, not {taps}"
            )
        return group_delay_s(taps), taps

    def _set_format(self, decimation: int) -> fields.TimeField | None:
        """Ask for gyro, accelerometer and the best time field the device has; read back and compare."""
        candidates = [t for t in fields.TIME_FIELDS if self._has(t.descriptor)]
        for time_field in (*candidates, None):
            wanted = [*([time_field.descriptor] if time_field else []), fields.ACCEL, fields.GYRO]
            try:
                self._write_format(wanted, decimation)
            except DriverError:
                if time_field is None:
                    raise
                continue
            return time_field
        raise AssertionError("the loop ends by return or raise")

    def _has(self, descriptor: int) -> bool:
        return not self._known or mip.SET_SENSOR << 8 | descriptor in self._known

    def _write_format(self, descriptors: list[int], decimation: int) -> None:
        items = b"".join(struct.pack(">BH", d, decimation) for d in descriptors)
        body = bytes([len(descriptors)]) + items
        try:
            self._link.command(mip.SET_3DM, 0x08, bytes([mip.APPLY]) + body)
            in_force = self._link.ask(mip.SET_3DM, 0x08, 0x80, bytes([mip.READ]))
        except UnknownCommandError:
            self._link.command(mip.SET_3DM, 0x0F, bytes([mip.APPLY, mip.SET_SENSOR]) + body)
            in_force = self._link.ask(mip.SET_3DM, 0x0F, 0x8F, bytes([mip.READ, mip.SET_SENSOR]))[1:]
        if _items(in_force) != _items(body):
            raise DeviceRefusedError(
                f"{self._port.name}: the device did not take its message format: "
                f"{in_force.hex()}, not {body.hex()}"
            )

    def _choose_baud(self, settings: ImuSettings, bytes_per_s: float) -> None:
        wanted = settings.baud
        if wanted is None and bytes_per_s * 10 > _BUSY_WIRE * self._port.baud:
            wanted = next((b for b in _BAUDS if bytes_per_s * 10 <= _BUSY_WIRE * b), _BAUDS[-1])
        if wanted is not None and wanted != self._port.baud:
            raise_baud(self._port, wanted, self.change_baud, explicit=settings.baud is not None)

    def change_baud(self, baud: int) -> None:
        """Change both sides' baud until the device's next power-up."""
        try:
            self._link.command(mip.SET_3DM, 0x40, struct.pack(">BI", mip.APPLY, baud))
        except UnknownCommandError:
            self._link.command(mip.SET_BASE, 0x09, struct.pack(">BBI", mip.APPLY, 1, baud))
        self._port.set_baud(baud)
        time.sleep(0.05)
        self._link.stream.restart()
        self._backlog = []
        if not any(self.probe(REPLY_TIMEOUT_S) for _ in range(3)):
            raise timeout(self._port, f"the change to {baud} baud")

    def start(self) -> None:
        """See `Session.start`."""
        newer = mip.SET_3DM << 8 | 0x0F in self._known
        ids = (_SENSOR_STREAM, _LEGACY_STREAM) if newer else (_LEGACY_STREAM, _SENSOR_STREAM)
        for stream in ids:
            try:
                self._link.command(mip.SET_3DM, 0x11, bytes([mip.APPLY, stream, 1]))
            except DeviceRefusedError:
                if stream == ids[-1]:
                    raise
                continue
            self._stream = stream
            break
        # Idle, which found the device, suspends streams on some models until they are resumed.
        with contextlib.suppress(DriverError):
            self._link.transact(mip.SET_BASE, 0x06, b"", tries=1)

    def read(self, timeout_s: float) -> list[RawSample]:
        """See `Session.read`."""
        if self._backlog:
            out, self._backlog = self._backlog, []
            return out
        out = []
        for packet in self._link.stream.receive(timeout_s):
            if (sample := self._sample(packet)) is not None:
                out.append(sample)
        return out

    def _sample(self, packet: mip.Packet) -> RawSample | None:
        if packet.descriptor_set != mip.SET_SENSOR:
            return None
        accel, gyro = packet.field(fields.ACCEL), packet.field(fields.GYRO)
        if accel is None or gyro is None or len(accel) != 12 or len(gyro) != 12:
            return None
        ax, ay, az = (v * fields.STANDARD_GRAVITY_MPS2 for v in _THREE.unpack(accel))
        wx, wy, wz = _THREE.unpack(gyro)
        total = ax + ay + az + wx + wy + wz
        if total - total != 0.0:  # NaN or infinity: the device is idle or over range
            return None
        date = packet.field(self._time.descriptor) if self._time else None
        ticks = self._time.ticks(date) if self._time and date is not None else None
        arrival_ns = self._link.stream.arrival_ns(packet.end)
        return RawSample(ticks, (wx, wy, wz), (ax, ay, az), arrival_ns)

    def _keep(self, packet: mip.Packet) -> None:
        if (sample := self._sample(packet)) is not None:
            self._backlog.append(sample)

    def stop(self) -> None:
        """See `Session.stop`; a temporary baud is put back so that other software finds the device."""
        with contextlib.suppress(DriverError):
            self.quiet()
            self._link.transact(mip.SET_3DM, 0x11, bytes([mip.APPLY, self._stream, 0]), tries=2)
            if self._port.baud != self._baud_found:
                self.change_baud(self._baud_found)

    def capture_gyro_bias(self, duration_s: float) -> tuple[float, float, float]:
        """See `Session.capture_gyro_bias`."""
        duration_ms = min(max(round(duration_s * 1e3), 1000), 30_000)
        answer = self._link.transact(
            mip.SET_3DM, 0x39, struct.pack(">H", duration_ms),
            reply=0x9B, timeout_s=duration_ms / 1e3 + 3.0, tries=1,
        )  # fmt: skip
        if answer.data is None or len(answer.data) != 12:
            raise DeviceRefusedError(f"{self._port.name}: the device returned no gyro bias")
        x, y, z = _THREE.unpack(answer.data)
        return x, y, z

    def poll(self, kind: int) -> dict[str, object]:
        """See `Session.poll`. The data follow the ACK in a packet of their own."""
        wanted = bytes([0, 1, kind, 0, 0])
        answer = self._link.transact(mip.SET_3DM, 0x01, wanted, also=(mip.SET_SENSOR, kind))
        field = mip.Field(kind, answer.data or b"")
        return {"kind": "0x80", **fields.describe(mip.Packet(mip.SET_SENSOR, (field,)))}

    def store_gyro_bias(self) -> None:
        """See `Session.store_gyro_bias`."""
        self._link.command(mip.SET_3DM, 0x38, bytes([_SAVE]))

    def settings(self) -> dict[str, object]:
        """See `Session.settings`."""
        base_hz = self._base_rate_hz()
        out: dict[str, object] = {"base_rate_hz": base_hz}
        with contextlib.suppress(DriverError):
            data = self._link.ask(mip.SET_3DM, 0x08, 0x80, bytes([mip.READ]))
            items = [struct.unpack_from(">BH", data, 1 + 3 * i) for i in range(len(data) // 3)]
            out["message"] = {f"0x{d:02X}": base_hz / max(1, decimation) for d, decimation in items}
        return out

    def self_test(self) -> dict[str, bool]:
        """See `Session.self_test`; takes some seconds on a GX3-35."""
        answer = self._link.transact(mip.SET_BASE, 0x05, b"", reply=0x83, timeout_s=10.0, tries=1)
        flags = int.from_bytes(answer.data or b"\xff", "big")
        return {f"built-in test (0x{flags:08X})": flags == 0}


def _items(message_format: bytes) -> list[bytes]:
    """Descriptor and decimation of each field of a message format, in any order."""
    return sorted(message_format[i : i + 3] for i in range(1, len(message_format), 3))


_THREE = struct.Struct(">3f")


def _size_of(time_field: fields.TimeField) -> int:
    return {fields.TICKS: 4, fields.REFERENCE_TIME: 8, fields.PPS_TIME: 9}.get(time_field.descriptor, 12)
