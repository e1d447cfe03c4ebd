"""A 3DM-GX3 spoken to in the single-byte protocol: identify, configure, stream, stop."""

from __future__ import annotations

import contextlib
import logging
import math
import time

from vical_drivers.errors import DeviceRefusedError, DriverError
from vical_drivers.microstrain import single_byte as sb
from vical_drivers.microstrain import single_byte_commands as cmd
from vical_drivers.microstrain.port import BytePort, timeout, wait_for_silence
from vical_drivers.microstrain.record_stream import RecordStream
from vical_drivers.microstrain.session import Applied, ImuSettings, RawSample, group_delay_s, raise_baud
from vical_drivers.samples import DeviceInfo

_log = logging.getLogger(__name__)
_REPLY_TIMEOUT_S = 0.5
_TRIES = 3
_STREAMED = 0xC2
_G = sb.STANDARD_GRAVITY_MPS2
_SELF_TEST_PARTS = {
    0: "3 V supply",
    1: "5 V supply",
    2: "external oscillator",
    3: "internal oscillator",
    4: "PLL",
    6: "gyro x",
    7: "gyro y",
    8: "gyro z",
    9: "accelerometer x",
    10: "accelerometer y",
    11: "accelerometer z",
    20: "system tick",
}
_NEEDED_STRINGS = 3
_IDENTITY = ("model number", "serial number", "model name", "options", "lot")


class SingleByteSession:
    """See `session.Session`. The port stays the caller's.

    Attributes:
        reply_timeout_s: How long one try waits for a reply; more for a device that samples at 1 Hz.
    """

    protocol = "single-byte"

    def __init__(self, port: BytePort) -> None:
        self._port = port
        self.reply_timeout_s = _REPLY_TIMEOUT_S
        self._stream: RecordStream[sb.Record] = RecordStream(port, sb.Decoder)
        self._baud_found = port.baud
        self._backlog: list[RawSample] = []
        self._firmware = cmd.FIRST_VOLATILE_FIRMWARE

    @property
    def checksum_errors(self) -> int:
        """Damaged records."""
        return self._stream.checksum_errors

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belong to no record."""
        return self._stream.skipped_bytes

    def probe(self, timeout_s: float) -> bool:
        """Tell whether a GX3 answers here in this protocol."""
        with contextlib.suppress(DriverError):
            self._transact(cmd.GET_FIRMWARE, 0xE9, timeout_s, tries=1)
            return True
        return False

    def quiet(self) -> None:
        """Stop whatever streams and wait until it is silent."""
        self._port.write(cmd.STOP_STREAM * 2)
        wait_for_silence(self._port, quiet_s=0.1, limit_s=1.0)
        self._restart()

    def identify(self) -> DeviceInfo:
        """See `Session.identify`."""
        number = self._firmware = int(self._transact(cmd.GET_FIRMWARE, 0xE9).values[0])
        text = {}
        for index, name in enumerate(_IDENTITY):
            with contextlib.suppress(DriverError):
                # Not every firmware answers each index; the wait for those must stay short.
                tries = 2 if index < _NEEDED_STRINGS else 1
                text[name] = str(self._transact(cmd.get_identity(index), 0xEA, tries=tries).fields()["text"])
        serial = text.get("serial number", "")
        return DeviceInfo(
            kind="imu",
            model=text.get("model name", "") or text.get("model number", "") or "3DM-GX3",
            serial_number=serial,
            firmware=cmd.firmware_text(number),
            path=self._port.name,
            protocol=self.protocol,
            details={k: v for k, v in text.items() if k not in ("serial number", "model name")},
        )

    def configure(self, settings: ImuSettings) -> Applied:
        """See `Session.configure`. Volatile only (but see the comment on old firmware)."""
        decimation = max(1, round(cmd.BASE_RATE_HZ / settings.rate_hz))
        self._choose_baud(settings, cmd.BASE_RATE_HZ / decimation)
        wanted = cmd.Sampling(decimation, cmd.FLAGS_INERTIAL_ONLY, settings.taps)
        in_force = cmd.Sampling.from_record(self._transact(cmd.sampling(), 0xDB))
        if in_force.difference(wanted):
            # Firmware before 1.1.27 writes its EEPROM on "apply". It happens once: the next start finds the
            # settings as they should be and sends nothing.
            if self._firmware < cmd.FIRST_VOLATILE_FIRMWARE:
                _log.warning(
                    "port=%s eeprom=written once, this old firmware knows no other way", self._port.name
                )
            self._transact(cmd.sampling(cmd.APPLY, wanted), 0xDB)
            in_force = cmd.Sampling.from_record(self._transact(cmd.sampling(), 0xDB))
        if difference := in_force.difference(wanted):
            little = (in_force.flags ^ wanted.flags) & cmd.FLAG_LITTLE_ENDIAN_FLOATS
            vital = (in_force.decimation, in_force.filter_width) != (wanted.decimation, wanted.filter_width)
            if vital or little:
                raise DeviceRefusedError(
                    f"{self._port.name}: the device did not take its settings: {difference}"
                )
            # Old firmware does not know every flag; the inertial data are the same.
            _log.warning("port=%s settings_differ=%s", self._port.name, difference)
        return Applied(
            rate_hz=cmd.BASE_RATE_HZ / in_force.decimation,
            group_delay_s=group_delay_s(in_force.filter_width),
            record_bytes=sb.LAYOUTS[_STREAMED].length,
            tick_hz=sb.TICK_HZ,
            tick_bits=32,
            filter_width=in_force.filter_width,
        )

    def _choose_baud(self, settings: ImuSettings, rate_hz: float) -> None:
        wanted = settings.baud
        if wanted is None and cmd.max_rate_hz(_STREAMED, self._port.baud) < rate_hz:
            wanted = next((b for b in cmd.BAUD_RATES if cmd.max_rate_hz(_STREAMED, b) >= rate_hz), None)
        if wanted is not None and wanted != self._port.baud:
            raise_baud(self._port, wanted, self.change_baud, explicit=settings.baud is not None)

    def change_baud(self, baud: int) -> None:
        """Change both sides' baud until the device's next power-up."""
        reply = self._transact(cmd.communication(cmd.APPLY, baud), 0xD9)
        if int(reply.values[1]) != baud:
            raise DeviceRefusedError(
                f"{self._port.name}: the device stays at {reply.values[1]} baud, not {baud}"
            )
        self._port.set_baud(baud)
        time.sleep(0.05)
        self._restart()
        if not self.probe(_REPLY_TIMEOUT_S) and not self.probe(_REPLY_TIMEOUT_S):
            raise timeout(self._port, f"the change to {baud} baud")

    def start(self) -> None:
        """See `Session.start`. Uses 0xC4: it is volatile, where presets would wear the EEPROM."""
        reply = self._transact(cmd.set_continuous(_STREAMED), 0xC4)
        if reply.values[0] != _STREAMED:
            raise DeviceRefusedError(f"{self._port.name}: the device does not stream record 0xC2")

    def read(self, timeout_s: float) -> list[RawSample]:
        """See `Session.read`."""
        if self._backlog:
            out, self._backlog = self._backlog, []
            return out
        out = []
        for record in self._stream.receive(timeout_s):
            if (sample := self._sample(record)) is not None:
                out.append(sample)
        return out

    def _sample(self, record: sb.Record) -> RawSample | None:
        # NaN or infinity: the device is idle or over range
        if record.kind != _STREAMED or not math.isfinite(sum(record.values)):
            return None
        ax, ay, az, wx, wy, wz, ticks = record.values
        force = (ax * _G, ay * _G, az * _G)
        return RawSample(ticks, (wx, wy, wz), force, self._stream.arrival_ns(record.end))

    def _transact(
        self, command: bytes, kind: int, timeout_s: float | None = None, tries: int = _TRIES
    ) -> sb.Record:
        """Send a command and return its reply; samples that stream in between are kept."""
        for _ in range(tries):
            self._port.write(command)
            deadline = time.monotonic() + (timeout_s or self.reply_timeout_s)
            found: sb.Record | None = None
            while found is None and (left := deadline - time.monotonic()) > 0:
                for record in self._stream.receive(left):
                    if record.kind == kind:
                        found = record
                    elif record.kind == sb.ERROR_REPLY:
                        raise DeviceRefusedError(
                            f"{self._port.name}: the device refused command 0x{kind:02X}"
                        )
                    elif (sample := self._sample(record)) is not None:
                        self._backlog.append(sample)
            if found is not None:
                return found
        raise timeout(self._port, f"command 0x{kind:02X}")

    def _restart(self) -> None:
        self._stream.restart()
        self._backlog = []

    def stop(self) -> None:
        """See `Session.stop`; a temporary baud is put back so that other software finds the device."""
        with contextlib.suppress(DriverError):
            self.quiet()
            if self._port.baud != self._baud_found:
                self.change_baud(self._baud_found)

    def capture_gyro_bias(self, duration_s: float) -> tuple[float, float, float]:
        """See `Session.capture_gyro_bias`."""
        command = cmd.capture_gyro_bias(round(duration_s * 1e3))
        reply = self._transact(command, 0xCD, duration_s + 2.0, tries=1)
        x, y, z = (float(v) for v in reply.values[:3])
        return x, y, z

    def poll(self, kind: int) -> dict[str, object]:
        """See `Session.poll`."""
        if kind not in sb.DATA_COMMANDS:
            known = ", ".join(f"0x{k:02X}" for k in sorted(sb.DATA_COMMANDS))
            raise DeviceRefusedError(f"{self._port.name}: 0x{kind:02X} is no data command; they are {known}")
        record = self._transact(bytes([kind]), kind)
        return {"kind": f"0x{kind:02X}", "name": sb.LAYOUTS[kind].name, **record.fields()}

    def store_gyro_bias(self) -> None:
        """See `Session.store_gyro_bias`."""
        reply = self._transact(cmd.store_bias_in_eeprom(2), 0xD0, 2.0, tries=1)
        if reply.values[0] != 2:
            raise DeviceRefusedError(f"{self._port.name}: the device refused to store the gyro bias")

    def settings(self) -> dict[str, object]:
        """See `Session.settings`."""
        s = self._transact(cmd.sampling(), 0xDB).fields()
        mode = int(self._transact(cmd.set_mode(0), 0xD4).values[0])
        link = self._transact(cmd.communication(), 0xD9).fields()
        return {
            "rate_hz": cmd.BASE_RATE_HZ / max(1, int(str(s["decimation"]))),
            "filter_width": s["filter_width"],
            "flags": f"0x{s['flags']:04X}",
            "mode": cmd.MODE_NAMES.get(mode, str(mode)),
            "uart_baud": link["baud"],
        }

    def self_test(self) -> dict[str, bool]:
        """See `Session.self_test`."""
        flags = int(self._transact(cmd.SELF_TEST, 0xDA, 2.0, tries=1).values[0])
        return {name: bool(flags >> bit & 1) for bit, name in _SELF_TEST_PARTS.items()}
