"""A simulated rig that runs in real time next to the program under test: a GX3-25 on a pty and a camera.

Each device has a process of its own, as hardware has its own processor: what the daemon computes does not
disturb when bytes and frames leave. One trajectory moves both.
"""

from __future__ import annotations

import multiprocessing
import signal
import struct
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from types import SimpleNamespace, TracebackType
from typing import Any, Self

import numpy as np
from vical_drivers.closing import Closing
from vical_drivers.errors import DeviceLostError, DeviceTimeoutError
from vical_drivers.samples import DeviceInfo, Frame, SourceStats

from vical_mocks.clock import SkewedClock
from vical_mocks.imu import ADC_DELAY_S, BASE_RATE_HZ, GYRO_ANALOG_DELAY_S
from vical_mocks.rig import Rig, reference_rig

TICK_HZ = 62_500  # the GX3's timer
SERIAL_IMU, SERIAL_CAMERA = "6223-00001", "SIM-00001"
_HEADER = struct.Struct("<qqqii")  # stamp, exposure ns, sequence, height, width
_START_TIMEOUT_S = 60.0
_HOLD_BACK_S = 0.004  # a frame reaches the host this long after the end of its exposure


@dataclass(frozen=True)
class LiveRigSettings:
    """What is simulated; picklable, since both processes build the same truth from it.

    Attributes:
        board: Attributes of the board (see `board_art.draw_board`), e.g. ``{"kind": "checkerboard", ...}``.
        board_side: -1: the camera looks along the board's +z (checkerboard); +1: AprilGrid.
        seed: Chooses motion, biases and noise.
        timeshift_cam_imu_s: True shift: t_imu = t_cam + shift.
        mean_rate_dps: Of the hand motion, deg/s.
        camera_rate_hz: Frames per second.
        exposure_s: Exposure time.
        stamp_jitter_s: One sigma of the frame stamps.
        distortion: radtan k1 k2 p1 p2.
        imu_link: How the bytes travel, see `Gx3Emulator`.
        imu_protocol: single-byte or mip.
        imu_clock_ppm: Rate error of the IMU's crystal.
    """

    board: Mapping[str, Any]
    board_side: int = -1
    seed: int = 1
    timeshift_cam_imu_s: float = -0.0125
    mean_rate_dps: float = 55.0
    camera_rate_hz: float = 12.5
    exposure_s: float = 0.001
    stamp_jitter_s: float = 5e-5
    distortion: tuple[float, float, float, float] = (-0.28, 0.07, 2e-4, 2e-5)
    imu_link: str = "direct"
    imu_protocol: str = "single-byte"
    imu_clock_ppm: float = 25.0
    extra: Mapping[str, Any] = field(default_factory=dict)

    def rig(self) -> Rig:
        """The truth."""
        from vical_mocks.lens import Lens

        return reference_rig(
            self.seed,
            mean_rate_dps=self.mean_rate_dps,
            timeshift_cam_imu_s=self.timeshift_cam_imu_s,
            side=self.board_side,
            lens=Lens(distortion=self.distortion),
            **self.extra,
        )


class LiveRig:
    """The devices, running; a context manager.

    Args:
        settings: What is simulated.
        devices: Of imu and camera, those that are to run.

    Attributes:
        port: Name of the IMU's terminal.
        rig: The truth; its time 0 is `t_start_s` of CLOCK_MONOTONIC.
        t_start_s: See above.
    """

    def __init__(self, settings: LiveRigSettings, devices: tuple[str, ...] = ("imu", "camera")) -> None:
        self.settings = settings
        self.devices = devices
        self.rig = settings.rig()
        self.port = ""
        self.t_start_s = 0.0
        self._imu_clock: SkewedClock | None = None
        self._processes: list[multiprocessing.process.BaseProcess] = []
        self._pipes: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        context = multiprocessing.get_context("spawn")  # fork would copy locks held by other threads
        self.t_start_s = time.monotonic()
        try:
            for device in self.devices:
                here, there = context.Pipe()
                process = context.Process(
                    target=_DEVICES[device], args=(self.settings, self.t_start_s, there), daemon=True
                )
                _start_deaf_to_interrupts(process)
                there.close()
                self._processes.append(process)
                self._pipes[device] = here
            for device, pipe in self._pipes.items():
                if not pipe.poll(_START_TIMEOUT_S):
                    raise DeviceTimeoutError(f"simulated {device}: its process does not start")
                answer = pipe.recv()
                if device == "imu":
                    self.port, self._imu_clock = answer
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pipe in self._pipes.values():
            pipe.close()  # each process ends when its pipe does
        for process in self._processes:
            process.join(5)
            if process.is_alive():
                process.terminate()
                process.join()

    def imu_instant_ns(self, device_ticks: int, filter_samples: int) -> int:
        """When the gyro really measured what came with these ticks, CLOCK_MONOTONIC ns.

        What the host stamps differs from it by what no host can know: how long the shortest way of a byte
        takes, and that gyro and accelerometer have different analog filters.
        """
        assert self._imu_clock is not None
        t_host_s = self._imu_clock.host_s(device_ticks / TICK_HZ)
        window_s = (filter_samples - 1) / 2 / BASE_RATE_HZ
        return round((t_host_s - ADC_DELAY_S - GYRO_ANALOG_DELAY_S - window_s) * 1e9)

    def camera(self) -> LiveCamera:
        """Return the camera as a `FrameSource`."""
        return LiveCamera(self._pipes["camera"], self.settings.camera_rate_hz)


class LiveCamera(Closing):
    """The receiving end of the simulated camera: a `FrameSource`."""

    def __init__(self, pipe: Connection, rate_hz: float) -> None:
        self._pipe, self._rate_hz = pipe, rate_hz
        self._samples = self._lost = 0
        self._next_sequence: int | None = None
        self._t_first_ns = self._t_last_ns = 0

    @property
    def info(self) -> DeviceInfo:
        """Who the camera is."""
        details = {"rate_hz": f"{self._rate_hz:g}"}
        return DeviceInfo("camera", "rendered board", SERIAL_CAMERA, protocol="simulated", details=details)

    def read(self, timeout_s: float) -> Frame | None:
        """See `FrameSource.read`."""
        try:
            if not self._pipe.poll(timeout_s):
                return None
            data = self._pipe.recv_bytes()
        except (EOFError, OSError):
            raise DeviceLostError("simulated camera: its process has ended") from None
        stamp_ns, exposure_ns, sequence, height, width = _HEADER.unpack_from(data)
        image = np.frombuffer(data, np.uint8, offset=_HEADER.size).reshape(height, width)
        dropped = sequence - self._next_sequence if self._next_sequence is not None else 0
        self._next_sequence = sequence + 1
        self._t_first_ns = self._t_first_ns or stamp_ns
        self._t_last_ns = stamp_ns
        self._samples += 1
        self._lost += dropped
        return Frame(
            t_exposure_mid_ns=stamp_ns,
            t_arrival_ns=time.monotonic_ns(),
            sequence=sequence,
            image=image,
            encoding="mono8",
            stamp_rule="simulated",
            exposure_ns=exposure_ns,
            readout_ns=0,
            dropped_before=dropped,
        )

    def stats(self) -> SourceStats:
        """See `FrameSource.stats`."""
        span_s = (self._t_last_ns - self._t_first_ns) * 1e-9
        rate_hz = (self._samples + self._lost - 1) / span_s if span_s > 0 else 0.0
        return SourceStats(samples=self._samples, lost=self._lost, rate_hz=rate_hz)

    def close(self) -> None:
        """The pipe belongs to the rig."""


def _start_deaf_to_interrupts(process: multiprocessing.process.BaseProcess) -> None:
    """Start a process that no ^C reaches, not even while it loads its libraries: it ends with its pipe."""
    resource_tracker.ensure_running()  # else `start` does it, and unblocks the signal again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_imu(settings: LiveRigSettings, t_start_s: float, pipe: Connection) -> None:
    """Emulate the IMU until the pipe closes."""
    from vical_mocks.gx3_emulator import Gx3Emulator
    from vical_mocks.imu import GX3_25_ERRORS, FloatArray, ImuErrors

    rig = settings.rig()

    def motion(t_host_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        return rig.imu_reading(t_host_s - t_start_s)

    noise = ImuErrors(gyro_noise=GX3_25_ERRORS.gyro_noise, accel_noise=GX3_25_ERRORS.accel_noise)
    emulator = Gx3Emulator(
        motion,
        protocol=settings.imu_protocol,
        link=settings.imu_link,
        clock_skew_ppm=settings.imu_clock_ppm,
        errors=noise,
        seed=settings.seed,
        serial_number=SERIAL_IMU,
    )
    emulator.plug()
    with emulator, suppress(OSError):  # the parent may have ended already
        pipe.send((emulator.port_name, emulator._clock))
        _wait_for_close(pipe)


def _run_camera(settings: LiveRigSettings, t_start_s: float, pipe: Connection) -> None:
    """Render until the pipe closes; pictures are drawn ahead of time where the processor allows."""
    import cv2

    from vical_mocks.camera import CameraSettings, SimulatedCamera

    cv2.setNumThreads(1)
    rig = settings.rig()
    board = SimpleNamespace(**settings.board)
    optics = CameraSettings(exposure_s=settings.exposure_s)
    camera = SimulatedCamera(board, rig.lens, rig.camera_pose_target, optics, settings.seed)
    jitter = np.random.default_rng([settings.seed, 31])
    camera.render(0.0)  # the first picture builds its tables
    try:
        pipe.send(None)
    except OSError:  # the parent has ended
        return
    sequence = 0
    while True:
        # Whoever cannot keep up skips pictures; the sequence number shows it.
        now_s = time.monotonic() - t_start_s
        sequence = max(sequence + 1, int(np.ceil((now_s - 0.05) * settings.camera_rate_hz)))
        t_s = sequence / settings.camera_rate_hz
        image = camera.render(t_s)
        t_stamp_s = float(rig.t_cam(t_s)) + settings.stamp_jitter_s * jitter.standard_normal()
        header = _HEADER.pack(
            round((t_start_s + t_stamp_s) * 1e9), round(settings.exposure_s * 1e9), sequence, *image.shape
        )
        ready_s = t_s + settings.exposure_s / 2 + _HOLD_BACK_S
        time.sleep(max(0.0, t_start_s + ready_s - time.monotonic()))
        try:
            pipe.send_bytes(header + image.tobytes())
        except OSError:
            return


def _wait_for_close(pipe: Connection) -> None:
    try:
        pipe.recv()
    except (EOFError, OSError):
        return


_DEVICES = {"imu": _run_imu, "camera": _run_camera}
