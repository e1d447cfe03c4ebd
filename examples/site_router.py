"""One router for a site: every robot joins it, whoever watches the site needs one connection.

    python examples/site_router.py CA.pem SITE.pem SITE.key robot7 robot8 ...

Who shows a certificate of CA.pem may look; those whose certificates bear the names given here may publish. A
robot's side: `examples/site_robot.yaml`.
"""

from __future__ import annotations

import sys
import time

from vical_daemon import client
from vical_daemon.bus.zenoh_bus import BusError, open_bus


def main(ca: str, certificate: str, key: str, *robots: str) -> None:
    """Host the router and print a line when a robot's calibration changes its status."""
    site = open_bus(
        mode="router",
        listen=["tls/0.0.0.0:7447"],
        tls_ca=ca,
        tls_certificate=certificate,
        tls_key=key,
        publishers=robots,
    )
    status: dict[tuple[str, str], str] = {}

    def show(update: client.Update) -> None:
        name = update.rig, update.camera
        if status.get(name) != update.estimate.status:
            status[name] = update.estimate.status
            print("/".join(name), update.estimate.status, flush=True)

    client.Client(site).subscribe(show)
    while True:
        time.sleep(3600)


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit("usage: site_router.py CA.pem SITE.pem SITE.key ROBOT ...")
    try:
        main(*sys.argv[1:])
    except BusError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
