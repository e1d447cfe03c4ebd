"""The same from asyncio: start moving the robot only once its camera is calibrated.

python examples/watch_async.py [ENDPOINT]
"""

from __future__ import annotations

import asyncio
import os
import sys

from vical_daemon import client
from vical_daemon.bus.zenoh_bus import BusError


async def main(endpoint: str | None = None) -> int:
    """Wait, then follow for ten updates."""
    try:
        async with await client.connect_async(endpoint) as robot:
            update = await robot.wait_converged(timeout_s=300)
            print(f"{update.rig}/{update.camera} is calibrated: {update.known.T_imu_cam.p_m} m")
            count = 0
            async for update in robot.updates():
                count += 1
                print(count, update.estimate.status, f"NIS {update.estimate.nis_per_dof:.2f}", flush=True)
                if count == 10:
                    break
    except (BusError, client.ClientError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    try:
        sys.exit(asyncio.run(main(*sys.argv[1:2])))
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # nobody reads any more, as after `| head -3`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
