"""Distinguishes a complete FireWire image from one that a lost packet has shifted.

The kernel's isochronous reception knows packets, not images. A buffer waits for the packet that begins an
image (its sy bit), then takes packet after packet until it is full. When one is lost, the rest of the image
moves up, and the first packets of the *next* image fill the end. The next image has then lost its beginning:
no buffer takes it. libdc1394 does not report this. Two rules follow, whatever the packets hold:

* an image that was received before the next one could begin is complete;
* after a shifted image, the next image is always missing.

With embedded data the next image's own header, at a packet boundary, is a third sign. Pure arithmetic.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
import numpy.typing as npt

from vical_drivers.camera.iidc.cycle_clock import WRAP_NS, image_cycle_time_ns
from vical_drivers.camera.iidc.embedded import FRAME_COUNTER, EmbeddedInfo, parse_embedded, position

EARLIEST_NEXT = 0.97
"""In periods after an image's first packet: the next image begins no earlier. Cameras keep their rate to
much better than 3 %; the fixed modes of IIDC 1.3 fill 0.9 of a period with packets."""
LATEST_NEXT_NS = 2_000_000_000
"""The next image's stamp is at most this much later, ns; 0.53 s is the period at the lowest IIDC rate."""


class Completeness(Enum):
    """What is known about an image when it arrives."""

    COMPLETE = "complete"
    SHIFTED = "shifted"
    UNDECIDED = "undecided"  # the next image decides: this one is complete if no frame is missing between


def check_completeness(
    buffer: npt.NDArray[np.uint8],
    packet_bytes: int,
    info: EmbeddedInfo,
    frame_info: int,
    age_ns: int,
    rate_hz: float,
) -> Completeness:
    """Decide from one image alone whether it is complete.

    Args:
        buffer: All packets of the image, padding included, shape (bytes,).
        packet_bytes: Of one packet; 0 where unknown.
        info: What the camera wrote at the beginning of the image.
        frame_info: Which embedded items are on (see `embedded.parse_embedded`).
        age_ns: From its first packet on the bus until it was found complete, ns.
        rate_hz: Frames per second; 0.0: unknown.
    """
    if packet_bytes > 0 and _holds_next_header(buffer, packet_bytes, info, frame_info):
        return Completeness.SHIFTED
    if rate_hz > 0 and 0 <= age_ns * rate_hz < EARLIEST_NEXT * 1e9:
        return Completeness.COMPLETE
    return Completeness.UNDECIDED


def _holds_next_header(
    buffer: npt.NDArray[np.uint8], packet_bytes: int, info: EmbeddedInfo, frame_info: int
) -> bool:
    """Look for the next image's frame counter and stamp at the beginning of a packet."""
    at = position(frame_info, FRAME_COUNTER)
    if at is None or info.frame_counter is None or info.cycle_time is None:
        return False  # one number alone may be a row of pixels by chance
    packets = buffer[: buffer.size - buffer.size % packet_bytes].reshape(-1, packet_bytes)
    wanted = np.frombuffer(((info.frame_counter + 1) % 2**32).to_bytes(4, "big"), dtype=np.uint8)
    own_ns = image_cycle_time_ns(info.cycle_time)
    for k in np.flatnonzero((packets[1:, at : at + 4] == wanted).all(axis=1)):
        found = parse_embedded(packets[k + 1].tobytes(), frame_info).cycle_time
        if found is not None and 0 < (image_cycle_time_ns(found) - own_ns) % WRAP_NS < LATEST_NEXT_NS:
            return True
    return False
