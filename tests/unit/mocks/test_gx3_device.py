"""The emulated GX3 against the manual's bytes: its encoder never shares code with the driver's."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np
import pytest
from vical_mocks.clock import SkewedClock
from vical_mocks.gx3_device import Gx3Device
from vical_mocks.gx3_state import Settings
from vical_mocks.imu import ADC_DELAY_S, GYRO_ANALOG_DELAY_S, ImuErrors, ImuModel, _rotation, _rotation_vector


def ask(device: Gx3Device, text: str, wait_s: float = 0.05) -> str:
    """Send hexadecimal bytes, run the device for a while, return what it said."""
    now_s = getattr(ask, "now_s", 0.0) if device is getattr(ask, "device", None) else 0.0
    device.receive(bytes.fromhex(text), now_s)
    ask.device, ask.now_s = device, now_s + wait_s
    said = b"".join(data for _, data in device.advance(now_s + wait_s))
    device.wire_is_idle()
    return said.hex().upper()


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("D4A34700", "D40100D5"),
        ("D4A34703", "D40300D7"),
        ("D5BA8902", "D50200D7"),
        ("D6C66BC2", "D6C20198"),
        ("D9C35501010007080002" + "00", "D9010007080002" + "0000EB"),
        ("DBA8B900" + "00" * 16, "DB000A00030F11000A000A000000000000011C"),
        ("DBA8B90100010D000F11000A000A000000000000", "DB00010D000F11000A000A000000000000011D"),
        ("DA", "DA00100FDF01D8"),
        ("E9", "E90000046A0157"),
        ("EA02", "EA02202020202020" + "33444D2D4758332D32350403"),
        ("DD544C000A0A00000000", "DD0000000000DD"),
        ("DBA8B8" + "00" * 17, "210021"),
        ("C4C12800", "210021"),
        ("99", ""),
    ],
)
def test_replies_of_the_manual(command, reply):
    assert ask(Gx3Device(), command) == reply


def test_continuous_mode_replies_first_then_streams_until_stopped():
    device = Gx3Device()
    said = bytes.fromhex(ask(device, "C4C129C2", 0.1))
    assert said[:2] == b"\xc4\xc2"
    assert said[8] == 0xC2
    assert (len(said) - 8) % 31 == 0
    assert len(said) > 5 * 31
    acc = struct.unpack(">3f", said[9:21])
    assert acc == pytest.approx((0.0, 0.0, -1.0))
    ask(device, "FA75B4")
    assert ask(device, "") == ""


def test_replies_interleave_in_a_running_stream():
    device = Gx3Device()
    ask(device, "C4C129C2")
    said = ask(device, "E9", 0.1)
    assert "E90000046A0157" in said
    assert said.count("C2") >= 5


def test_settings_are_clamped_and_old_firmware_writes_its_eeprom():
    device = Gx3Device()
    assert ask(device, "DBA8B90100000003" + "FF11000A000A000000000000").startswith("DB000100032011")
    assert device.state.eeprom_writes == 0
    device.state.identity.firmware = 1126
    ask(device, "DBA8B90100010003" + "0F11000A000A000000000000")
    assert device.state.eeprom_writes == 1


def test_a_new_baud_takes_effect_after_the_reply_and_is_lost_at_power_up():
    device = Gx3Device()
    device.receive(bytes.fromhex("D9C3550101000E10000200"), 0.0)
    assert device.advance(0.05)
    assert device.baud == 115_200
    device.wire_is_idle()
    assert device.baud == 921_600
    device.power_up(1.0)
    assert device.baud == 115_200


def test_gyro_bias_capture_takes_its_time_and_then_removes_the_bias():
    errors = ImuErrors(gyro_bias_rps=(0.01, -0.02, 0.03))
    device = Gx3Device(errors=errors)
    assert ask(device, "CDC12903E8", 0.5) == ""
    said = bytes.fromhex(ask(device, "", 0.6))
    assert said[0] == 0xCD
    assert struct.unpack(">3f", said[1:13]) == pytest.approx(errors.gyro_bias_rps, abs=1e-6)
    sample = bytes.fromhex(ask(device, "C2"))
    assert struct.unpack(">3f", sample[13:25]) == pytest.approx((0, 0, 0), abs=1e-6)


def test_streams_at_power_up_where_the_eeprom_says_so():
    device = Gx3Device(eeprom=Settings(power_up_mode=2, preset_command=0xCC))
    said = b"".join(data for _, data in device.advance(0.1))
    assert said[0] == 0xCC
    assert len(said) % 79 == 0


def test_the_timer_steps_by_62_and_63_at_1000_hz_and_wraps():
    device = Gx3Device(first_ticks=2**32 - 100)
    ask(device, "DBA8B90100010D000F11000A000A000000000000")
    said = bytes.fromhex(ask(device, "C4C129C2", 0.03))[8:]
    ticks = [struct.unpack(">I", said[i + 25 : i + 29])[0] for i in range(0, len(said) - 30, 31)]
    steps = {(b - a) % 2**32 for a, b in pairwise(ticks)}
    assert steps == {62, 63}


@pytest.mark.parametrize(
    "kind", ["C1", "C3", "C5", "C6", "C7", "C8", "CB", "CC", "CE", "CF", "D1", "D2", "D3", "DF"]
)
def test_every_data_command_answers_with_a_right_checksum(kind):
    said = bytes.fromhex(ask(Gx3Device(), kind))
    assert said[0] == int(kind, 16)
    assert sum(said[:-2]) % 65536 == int.from_bytes(said[-2:], "big")


def test_idle_answers_with_nan_and_any_byte_wakes_a_sleeper():
    device = Gx3Device()
    ask(device, "D4A34703")
    assert np.isnan(struct.unpack(">3f", bytes.fromhex(ask(device, "C2"))[1:13])).all()
    ask(device, "D4A34704")
    assert ask(device, "00E9") == "E90000046A0157"


def test_mip_answers_of_the_manual():
    device = Gx3Device(protocol="mip")
    for command, reply in [
        ("756501020201E0C6", "7565010404F10100D56A"),
        ("75650C020206F0F7", "75650C0804F10600048303E85BF5"),
        ("75650C0D0D08010304000A05000A0E000A4195", "75650C0404F10800E7BA"),
        ("75650C05051101010" + "1041A", "75650C0404F11100F0CC"),
        ("75650C03034002" + "2E64", "75650C0A04F1400006870001C200"),
        ("75650C02027A646B", "75650C0404F17A015A9F"),
    ]:
        assert reply in ask(device, command), command


def test_filter_chain_delays_as_stated_and_has_its_null():
    slope = 0.5

    def motion(t_s):
        gyro = np.zeros((len(t_s), 3))
        gyro[:, 0] = slope * t_s
        gyro[:, 1] = np.sin(2 * np.pi * 1000.0 / 15.0 * t_s)
        return gyro, np.zeros((len(t_s), 3))

    model = ImuModel(motion, SkewedClock())
    for taps in (1, 15, 32):
        gyro, _ = model.sample(5000, taps)
        delay_s = 5.0 - gyro[0] / slope
        assert delay_s == pytest.approx(ADC_DELAY_S + GYRO_ANALOG_DELAY_S + (taps - 1) / 2e3, abs=1e-9)
    assert abs(model.sample(5000, 15)[0][1]) < 1e-6


def test_motion_is_computed_a_second_at_a_time():
    """Per 0.13 s it took three times as long: on a loaded computer all that the device sent was late."""
    asked = []

    def motion(t_s):
        asked.append(t_s)
        return np.zeros((len(t_s), 3)), np.tile(t_s[:, None], 3)

    model = ImuModel(motion, SkewedClock(skew_ppm=25.0))
    forces = [model.sample(k, 1)[1][0] for k in range(1000, 9000, 10)]
    assert len(asked) <= 2 * 10
    np.testing.assert_allclose(np.diff(forces), 0.01 / (1.0 + 25e-6), atol=1e-12)


def test_noise_density_is_that_of_the_white_noise_before_the_filter():
    model = ImuModel(None, SkewedClock(), ImuErrors(gyro_noise=4e-4), seed=3)
    values = np.array([model.sample(k, 15)[0] for k in range(1000, 41_000, 15)])
    assert values.std() == pytest.approx(4e-4 * np.sqrt(1000.0 / 15.0), rel=0.05)
    again = ImuModel(None, SkewedClock(), ImuErrors(gyro_noise=4e-4), seed=3).sample(20_000, 15)[0]
    np.testing.assert_array_equal(again, model.sample(20_000, 15)[0])


def test_increments_of_a_steady_turn_are_exact():
    rate = np.array([0.3, -0.2, 1.1])

    def motion(t_s):
        return np.tile(rate, (len(t_s), 1)), np.zeros((len(t_s), 3))

    angle, _ = ImuModel(motion, SkewedClock()).increments(3000, 100)
    np.testing.assert_allclose(angle, rate * 0.1, atol=1e-12)
    np.testing.assert_allclose(_rotation_vector(_rotation(rate)), rate, atol=1e-12)
