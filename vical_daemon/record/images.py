"""Compresses images for the log, for cameras whose config asks for it."""

from __future__ import annotations

import numpy as np

from vical_daemon.bus.messages import MessageError, decode_image, encode_compressed_image
from vical_daemon.bus.topics import COMPRESSED, IMAGE, parse_key
from vical_daemon.config.model import Config

_ENCODINGS = ("mono8", "mono16", "bgr8")


class ImageCompressor:
    """Compresses the images of cameras whose `record_as` is not raw.

    Attributes:
        failures: Images that could not be compressed; they are recorded raw.
    """

    def __init__(self, config: Config) -> None:
        self._rig = config.rig
        self._kinds = {n: c.record_as for n, c in config.cameras.items() if c.record_as != "raw"}
        self.failures = 0

    def as_recorded(self, key: str, payload: bytes) -> tuple[str, bytes]:
        """Return key and message to record, unchanged or compressed. Never raises on data."""
        parsed = parse_key(key) if self._kinds else None
        if parsed is None or parsed.topic is not IMAGE or parsed.rig != self._rig:
            return key, payload
        kind = self._kinds.get(parsed.name)
        if kind is None:
            return key, payload
        try:
            return COMPRESSED.key(parsed.rig, parsed.name), self._compressed(payload, kind)
        except (MessageError, ValueError):
            self.failures += 1
            return key, payload

    @staticmethod
    def _compressed(payload: bytes, kind: str) -> bytes:
        from vical_daemon.vision.image_codec import encode_image

        message = decode_image(payload)
        if message.encoding not in _ENCODINGS:
            raise MessageError(f"pixel format '{message.encoding}' has no place in a {kind}")
        pixels = message.pixels()
        if pixels.dtype.itemsize > 1:  # a JPEG has 8 bits
            kind, pixels = "png", pixels.astype(np.uint16)
        data = encode_image(np.ascontiguousarray(pixels), kind)
        return encode_compressed_image(message.stamp_ns, message.frame_id, kind, data)
