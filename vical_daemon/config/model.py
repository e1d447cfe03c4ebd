"""The config file of a rig: typed and strict. Every error names path, bound, file and line.

Defaults are here and next to the algorithms; `examples/vical.yaml` shows every key.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from vical_daemon.config import validation as schema
from vical_daemon.config.cross_checks import contradictions
from vical_daemon.config.paths import LOOPBACK_PORT
from vical_daemon.config.strict_yaml import ConfigError, Document, parse, read
from vical_daemon.config.validation import Bound
from vical_daemon.estimation.measurements import CalibrationOptions, ImuNoise

__all__ = ["Config", "ConfigError", "load", "loads"]

NAME = r"[A-Za-z][A-Za-z0-9_]{0,62}"  # as `topics.check_name`
NAMESPACE = r"/|/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*"
NAMESPACE_HINT = (
    "a ROS name like robot7 or /site/robot7: letters, digits and _ between slashes, no digit first"
)
GRAVITY_BOUNDS = (9.7, 9.9)  # m/s^2, on Earth
LOG_SCHEME = "log:"
"""Of a `port` or `uri` that is a recording, played as if its device were there."""
EMULATED = "emulated"
"""The `port` or `uri` of a device that `vical run` emulates."""
URI = rf"(v4l2|iidc|aravis|folder|log):.+|/.+|\d+|{EMULATED}"
Name = Annotated[str, Bound(pattern=NAME, hint="letters, digits and _, begin with a letter, at most 63")]
HostName = Annotated[
    str, Bound(pattern=r"[A-Za-z0-9._-]{1,253}|[0-9A-Fa-f:]{2,45}", hint="a name without port")
]
Focal = Annotated[float, Bound(above=0, high=1e5)]
Sigma = Annotated[float, Bound(low=0, high=1e5)]
Pixels = Annotated[int, Bound(low=16, high=16384)]
Matrix4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]


@dataclass(frozen=True, slots=True)
class NoiseConfig:
    """Continuous-time noise densities, from the IMU's data sheet or `vical allan`."""

    gyro_density: Annotated[float, Bound(above=0, high=1.0)] = ImuNoise().gyro_density
    gyro_walk: Annotated[float, Bound(above=0, high=1.0)] = ImuNoise().gyro_walk
    accel_density: Annotated[float, Bound(above=0, high=10.0)] = ImuNoise().accel_density
    accel_walk: Annotated[float, Bound(above=0, high=10.0)] = ImuNoise().accel_walk


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """One IMU.

    Attributes:
        port: Serial port, preferably a stable name below /dev/serial/by-id or /dev/vical; or log:FILE (plays
            the IMU of a recording; log:FILE#NAME if it has several), or emulated.
        driver: gx3: MicroStrain 3DM-GX3-25 (and MIP devices).
        protocol: auto detects it.
        rate_hz: Samples per second; a GX3 divides 1000 Hz.
        filter_samples: Width M of the moving average in the device, ms; its delay is subtracted from the
            stamps. None: one sample interval; longer averages flatten fast motion.
        baud: Bits per second while streaming; None: as found, or more if the rate needs it.
        link: Kind of link; on a real UART (ftdi, uart) the wire time is subtracted from the stamps.
        noise: Densities for the estimator.
    """

    port: str
    driver: Literal["gx3"] = "gx3"
    protocol: Literal["auto", "single-byte", "mip"] = "auto"
    rate_hz: Annotated[float, Bound(low=1, high=1000)] = 500.0
    filter_samples: Annotated[int, Bound(low=1, high=32)] | None = None
    baud: Literal[115200, 230400, 460800, 921600] | None = None
    link: Literal["auto", "usb", "ftdi", "uart"] = "auto"
    noise: NoiseConfig = field(default_factory=NoiseConfig)


@dataclass(frozen=True, slots=True)
class LensConfig:
    """Prior knowledge of a lens and its mounting, with Kalibr's keys.

    `intrinsics_sigma` (px) and `distortion_sigma`: uncertainty of a lens that `calibration.fix` fixes.
    """

    distortion_model: Literal["radtan", "plumb_bob", "equidistant"] = "radtan"
    intrinsics: tuple[Focal, Focal, float, float] | None = None
    distortion_coeffs: tuple[float, ...] | None = None
    intrinsics_sigma: tuple[Sigma, Sigma, Sigma, Sigma] | None = None
    distortion_sigma: tuple[Sigma, ...] | None = None
    T_cam_imu: Matrix4 | None = None
    timeshift_cam_imu: Annotated[float, Bound(low=-5, high=5, hint="seconds")] | None = None
    readout_s: Annotated[float, Bound(low=0, high=0.2)] = 0.0
    readout_axis: Literal["rows", "columns"] | None = None


@dataclass(frozen=True, slots=True)
class CameraConfig:
    """One camera.

    Attributes:
        uri: v4l2:/dev/video0, iidc:GUID, aravis:NAME, folder:PATH; `vical devices` prints it. Or log:FILE
            or emulated, as for an IMU's `port`.
        size: width, height, px.
        rate_hz: Frames per second.
        exposure_s: Exposure time; None: leave the camera's setting.
        assume_exposure_s: Exposure time of a camera that does not report it; used for stamps only.
        gain: In the camera's own unit; None: leave the camera's setting.
        pixel_format: Format on the camera's link, e.g. GREY or MJPG; None: the cheapest.
        stamp: What the driver's stamp marks; auto: what the driver says.
        controls: Further controls, by the camera's own names.
        record_as: Images in logs: raw or compressed (png is lossless, jpeg is small).
        lens: Prior of intrinsics and mounting.
    """

    uri: Annotated[str, Bound(pattern=URI, hint="v4l2:/dev/video0 or iidc:GUID, see `vical devices`")]
    size: tuple[Pixels, Pixels] = (640, 480)
    rate_hz: Annotated[float, Bound(above=0, high=1000)] = 30.0
    exposure_s: Annotated[float, Bound(above=0, high=1.0, hint="seconds")] | None = None
    assume_exposure_s: Annotated[float, Bound(above=0, high=1.0, hint="seconds")] | None = None
    gain: float | None = None
    pixel_format: str | None = None
    stamp: Literal["auto", "raw", "soe", "eof", "first-packet", "shutter-closed"] = "auto"
    controls: dict[str, float] = field(default_factory=dict)
    record_as: Literal["raw", "png", "jpeg"] = "raw"
    lens: LensConfig = field(default_factory=LensConfig)


@dataclass(frozen=True, slots=True)
class ConvergenceConfig:
    """A calibration is converged when every sigma is below these."""

    position_sigma_m: Annotated[float, Bound(above=0, high=1.0)] = 0.005
    rotation_sigma_deg: Annotated[float, Bound(above=0, high=10.0)] = 0.1
    timeshift_sigma_s: Annotated[float, Bound(above=0, high=0.1)] = 0.0005


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """Options of the estimator.

    Attributes:
        mode: target: corners of a board; target_free: tracked features.
        imu: The IMU to calibrate against; None: the only one.
        cameras: Those to calibrate; empty: all.
        fix: Blocks kept at their priors.
        estimate: Optional blocks that are always estimated.
        corner_sigma_px: Initial value; measured afterwards.
        gravity_mps2: Magnitude of gravity at the site.
        lag_s: How long the estimator waits for late samples before it sorts by stamp.
        detect_rate_hz: Largest number of images per second in which the board is searched.
        convergence: Targets.
    """

    mode: Literal["target", "target_free"] = "target"
    imu: Name | None = None
    cameras: tuple[Name, ...] = ()
    fix: tuple[Literal["intrinsics", "timeshift", "extrinsics"], ...] = ()
    estimate: tuple[
        Literal["imu_intrinsics", "size_effect", "readout", "target_scale", "target_shape"], ...
    ] = ()
    corner_sigma_px: Annotated[float, Bound(above=0, high=20)] = CalibrationOptions().corner_sigma_px
    gravity_mps2: Annotated[float, Bound(*GRAVITY_BOUNDS, hint="magnitude on Earth, m/s^2")] = 9.80665
    lag_s: Annotated[float, Bound(low=0, high=5)] = 0.2
    detect_rate_hz: Annotated[float, Bound(above=0, high=1000)] = 30.0
    convergence: ConvergenceConfig = field(default_factory=ConvergenceConfig)


@dataclass(frozen=True, slots=True)
class CountsConfig:
    """The smallest changes since the calibration was stored that count as such."""

    position_m: Annotated[float, Bound(above=0, high=1.0)] = 2e-3
    rotation_deg: Annotated[float, Bound(above=0, high=10.0)] = 0.2
    timeshift_s: Annotated[float, Bound(above=0, high=0.1)] = 1e-3
    focal_share: Annotated[float, Bound(above=0, high=0.5, hint="of the focal length")] = 5e-3


@dataclass(frozen=True, slots=True)
class VerifyConfig:
    """With `mode: verify`: how the stored calibration is checked.

    Attributes:
        against: store, or a file: a result of vical, Kalibr's or OpenVINS's camchain; relative to the
            settings file.
        cpu_percent: Share of one core that the process may use on average, by pauses between checks.
        image_rate_hz: Largest number of images per second in which the board is searched during a check.
        recalibrate: Calibrate where nothing is stored, or what is stored no longer holds; store the result.
        counts: The smallest changes that count.
    """

    against: str = "store"
    cpu_percent: Annotated[float, Bound(above=0, high=100)] = 3.0
    image_rate_hz: Annotated[float, Bound(low=1, high=1000)] = 10.0
    recalibrate: bool = False
    counts: CountsConfig = field(default_factory=CountsConfig)


@dataclass(frozen=True, slots=True)
class BusConfig:
    """How processes connect; nothing listens on a network, loopback included, unless configured here.

    Attributes:
        socket: Unix socket of the router, for its user and group; None: `zenoh.sock` in the runtime folder.
        readers: Who may read. group: members of the router's group, over the socket; they may also write.
            loopback: everybody on this computer, read only.
        tcp_port: Loopback port of the router, for reading; 0: none, or 7447 with `readers: loopback`.
        listen: Further zenoh endpoints of the router (`tls/0.0.0.0:7447`), for reading.
        connect: Endpoints of a site's router that this rig joins.
        tls_ca: Certificate authority, PEM file.
        tls_certificate: This rig's certificate, PEM file.
        tls_key: Its private key, PEM file.
        password_file: usrpwd dictionary (user:password lines) of those who may connect.
        user: User name for `connect`.
        password: Its password.
        commanders: Users of `password_file`, or names in client certificates, who may send commands over
            any endpoint.
        publishers: Likewise, who may publish on every key.
    """

    socket: str | None = None
    readers: Literal["group", "loopback"] = "group"
    tcp_port: Annotated[int, Bound(low=0, high=65535)] = 0
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    tls_ca: str | None = None
    tls_certificate: str | None = None
    tls_key: str | None = None
    password_file: str | None = None
    user: str | None = None
    password: str | None = None
    commanders: tuple[str, ...] = ()
    publishers: tuple[str, ...] = ()

    @property
    def loopback_port(self) -> int:
        """Loopback port on which the router listens; 0: none."""
        return self.tcp_port or (LOOPBACK_PORT if self.readers == "loopback" else 0)


@dataclass(frozen=True, slots=True)
class Ros2Config:
    """Also publish under ROS 2's names (rmw_zenoh), see docs/how-to/ros2.md; on if this section exists.

    Attributes:
        namespace: Before every topic, so that robots on one router do not collide; None: the rig's name;
            /: none.
        domain: ROS_DOMAIN_ID of the subscribers.
    """

    namespace: Annotated[str, Bound(pattern=NAMESPACE, hint=NAMESPACE_HINT)] | None = None
    domain: Annotated[int, Bound(low=0, high=232)] = 0


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """The recorder.

    Attributes:
        enabled: Record from the start; commands on the bus start and stop it at any time.
        directory: Folder of the files; None: `log` in the state directory.
        images: Record images (points and IMU are always recorded).
        rotate_s: Begin a new file after this time, s.
        rotate_bytes: Begin a new file after this size.
        quota_bytes: Beyond this total, the oldest finished files are deleted.
        reserve_bytes: Recording stops before the disk has less free space than this.
    """

    enabled: bool = True
    directory: str | None = None
    images: bool = True
    rotate_s: Annotated[float, Bound(low=1)] = 300.0
    rotate_bytes: Annotated[int, Bound(low=1_000_000)] = 1_000_000_000
    quota_bytes: Annotated[int, Bound(low=0)] = 20_000_000_000
    reserve_bytes: Annotated[int, Bound(low=0)] = 500_000_000


@dataclass(frozen=True, slots=True)
class WebConfig:
    """The page with the live calibration.

    Attributes:
        enabled: Serve it.
        host: Address to listen on; 127.0.0.1: this machine only.
        port: Of the page; 0: any free one.
        hosts: Further names of the page (a proxy's name, a name in your DNS) beyond localhost, this
            computer's host name and its address; other names are refused.
        picture_rate_hz: Largest number of pictures per second on the page; each costs about 2 ms of CPU.
        foxglove_port: WebSocket for Foxglove (its usual port is 8765); 0: none.
    """

    enabled: bool = False
    host: str = "127.0.0.1"
    port: Annotated[int, Bound(low=0, high=65535)] = 8080
    hosts: tuple[HostName, ...] = ()
    picture_rate_hz: Annotated[float, Bound(low=0.1, high=30)] = 2.0
    foxglove_port: Annotated[int, Bound(low=0, high=65535)] = 0


@dataclass(frozen=True, slots=True)
class StoreConfig:
    """Where the last converged calibration is kept; None: the state directory."""

    directory: str | None = None


@dataclass(frozen=True, slots=True)
class Config:
    """A whole rig.

    Attributes:
        rig: Name of the rig in every bus key.
        imus: By name.
        cameras: By name.
        target: Target file (Kalibr's format); relative to the settings file.
        mode: calibrate: estimate and store; verify: check from time to time whether the stored calibration
            still holds.
        ros2: Publish under ROS 2's names, too; None: off.
        path: File this was read from; None: made in memory.

    Relative paths in `target`, ``log:FILE`` and ``folder:PATH`` are taken from the folder of this file.
    """

    rig: Name = "rig0"
    imus: dict[Name, ImuConfig] = field(default_factory=dict)
    cameras: dict[Name, CameraConfig] = field(default_factory=dict)
    target: str | None = None
    mode: Literal["calibrate", "verify"] = "calibrate"
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    ros2: Ros2Config | None = None
    record: RecordConfig = field(default_factory=RecordConfig)
    web: WebConfig = field(default_factory=WebConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    path: Path | None = field(default=None, metadata={"hidden": True})

    @property
    def calibration_imu(self) -> str:
        """Name of the IMU that cameras are calibrated against."""
        return self.calibration.imu or next(iter(self.imus))

    @property
    def calibration_cameras(self) -> tuple[str, ...]:
        """Names of the cameras to calibrate."""
        return self.calibration.cameras or tuple(self.cameras)

    @property
    def ros2_namespace(self) -> str:
        """Namespace of the ROS 2 topics, with its leading slash; empty: none."""
        given = self.rig if self.ros2 is None or self.ros2.namespace is None else self.ros2.namespace
        return f"/{given.strip('/')}".rstrip("/")

    @property
    def target_path(self) -> Path | None:
        """The target file, relative names taken from the folder of the settings file."""
        if self.target is None:
            return None
        return (self.path.parent if self.path else Path()) / self.target

    @property
    def verify_path(self) -> Path | None:
        """The file that is verified, likewise; None: the store."""
        if self.verify.against == "store":
            return None
        return (self.path.parent if self.path else Path()) / self.verify.against


def load(path: Path | str) -> Config:
    """Read a settings file.

    Raises:
        ConfigError: It cannot be used; the message is one line, `problems` has them all.
    """
    path = Path(path)
    return _check(read(path), path)


def loads(text: str, name: str = "config") -> Config:
    """Read settings from text; `name` stands in messages.

    Raises:
        ConfigError: See `load`.
    """
    return _check(parse(text, name), None)


def _check(document: Document, path: Path | None) -> Config:
    config = _anchored(replace(schema.build(document, Config), path=path))
    problems = [schema.mistake(document, where, text) for where, text in contradictions(config)]
    if problems:
        raise ConfigError(problems[0], problems)
    return config


def _anchored(config: Config) -> Config:
    """Take the relative paths of devices that are files from the folder of the settings file."""
    if config.path is None:
        return config
    folder = config.path.absolute().parent

    def anchor(name: str) -> str:
        for scheme in (LOG_SCHEME, "folder:"):
            if name.startswith(scheme):
                return f"{scheme}{folder / name.removeprefix(scheme)}"
        return name

    return replace(
        config,
        imus={name: replace(imu, port=anchor(imu.port)) for name, imu in config.imus.items()},
        cameras={name: replace(camera, uri=anchor(camera.uri)) for name, camera in config.cameras.items()},
    )
