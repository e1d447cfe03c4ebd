"""What the page gives away as files: exports of the present result, and the newest log."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from vical_daemon.bus.messages import merge_calibrations
from vical_daemon.config.model import Config
from vical_daemon.config.paths import state_directory
from vical_daemon.logs.mcap import LogFolder, is_being_written
from vical_daemon.results.export import ExportError, export, rig_from_estimate
from vical_daemon.web.state import WebState


class Downloads:
    """Makes files for the page.

    Args:
        config: The rig: image sizes, and where logs lie.
        state: The present results.
    """

    def __init__(self, config: Config, state: WebState) -> None:
        self._config, self._state = config, state

    def export(self, format_name: str, *, force: bool = False) -> tuple[str, bytes]:
        """Return name and contents of an export of the present result; several files come as a zip.

        Raises:
            ExportError: No result yet, an unknown format, or directions that the motion did not determine
                (without `force`).
        """
        messages = [message for message, _ in self._state.calibrations.values() if message.camera_estimate]
        if not messages:
            raise ExportError("there is no result yet")
        sizes = {name: camera.size for name, camera in self._config.cameras.items()}
        sizes |= self._state.image_sizes
        rig = rig_from_estimate(merge_calibrations(messages), sizes, note="vical, from the live page")
        files = export(rig, format_name, force=force)
        if len(files) == 1:
            return files[0].name, files[0].text.encode()
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in files:
                archive.writestr(file.name, file.text)
        return f"{format_name}.zip", stream.getvalue()

    def newest_log(self) -> Path | None:
        """Return the newest recording on this computer; one that is being written is readable, too.

        The times of files count only for recordings that the recorder did not make: a date may be wrong.
        """
        record = self._config.record
        folder = Path(record.directory) if record.directory else state_directory() / "log"
        try:
            parts = [part for part in folder.glob("*.mcap.part") if is_being_written(part)]
            files = [*folder.glob("*.mcap"), *folder.glob("*.mcap.part")]
            newest = [max(files, key=lambda path: path.stat().st_mtime)] if files else []
            return next(iter([*parts, *reversed(LogFolder(folder).segments()), *newest]), None)
        except OSError:
            return None
