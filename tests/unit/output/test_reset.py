"""`reset`, as the page sends it, makes the estimate role begin anew; other words do nothing."""

import threading
import time

from vical_daemon import topics
from vical_daemon.bus import LocalBus
from vical_daemon.config import CameraConfig, Config, ImuConfig
from vical_daemon.messages import decode_calibration, encode_imu, encode_string
from vical_daemon.roles import estimate
from vical_daemon.wall_clock import private_clock


def test_reset_forgets_everything(tmp_path):
    board = tmp_path / "board.yaml"
    board.write_text(
        "{target_type: checkerboard, targetCols: 8, targetRows: 6, "
        "rowSpacingMeters: 0.05, colSpacingMeters: 0.05}"
    )
    config = Config(
        imus={"imu0": ImuConfig(port="none")},
        cameras={"cam0": CameraConfig(uri="none")},
        target=str(board),
    )
    bus, stop, counts = LocalBus(), threading.Event(), []
    bus.subscribe(
        topics.CALIBRATION.key("rig0", "cam0"),
        lambda sample: counts.append(decode_calibration(sample.payload).estimate.imu_samples),
    )
    options = {"clock": private_clock()}
    thread = threading.Thread(target=estimate.run, args=(config, bus, stop), kwargs=options)
    thread.start()

    def wait_until(true):
        end = time.monotonic() + 60
        while not true():
            assert time.monotonic() < end
            feed()
            time.sleep(0.02)

    t_ns = [10**18]

    def feed():
        for _ in range(5):
            t_ns[0] += 4_000_000
            wiggle = 1e-3 * (t_ns[0] // 4_000_000 % 7)  # an IMU that repeats itself bit by bit has hung
            payload = encode_imu(t_ns[0], "imu0", (wiggle, 0.0, 0.0), (0.0, 0.0, 9.8))
            bus.publish(topics.IMU.key("rig0", "imu0"), payload)

    command = topics.COMMAND.key("rig0", "estimate")
    try:
        wait_until(lambda: counts and counts[-1] > 100)
        bus.publish(command, encode_string("dance"))
        bus.publish(command, b"")
        before = counts[-1]
        wait_until(lambda: counts[-1] > before)
        bus.publish(command, encode_string("reset"))
        wait_until(lambda: counts[-1] < before)
    finally:
        stop.set()
        thread.join(60)
