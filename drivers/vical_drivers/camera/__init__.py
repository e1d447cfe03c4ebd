"""Cameras: V4L2, FireWire (IIDC), GenICam and image folders, all as `FrameSource`.

A camera is named by a URI:

| URI | source |
|---|---|
| ``/dev/video0``, ``/dev/v4l/by-id/...``, ``v4l2:PATH``, ``v4l2:SERIAL`` | `v4l2.camera.V4l2Camera` |
| ``iidc:GUID`` (``iidc:`` alone: the only one there is) | `iidc.camera.IidcCamera` |
| ``aravis:ID`` | `aravis.camera.AravisCamera` |
| ``folder:PATH`` | `folder.ImageFolder`, an ASL folder with ``data.csv``, played once in real time |
"""

from vical_drivers.camera.opening import check_camera, list_cameras, open_camera
from vical_drivers.camera.settings import CameraSettings

__all__ = ["CameraSettings", "check_camera", "list_cameras", "open_camera"]
