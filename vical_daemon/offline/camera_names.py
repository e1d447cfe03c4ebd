"""What a file says of cameras, by the names that a recording has for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import TypeVar

from vical_daemon.bus.topics import parse_key
from vical_daemon.config.priors import Initial
from vical_daemon.estimation.measurements import CameraPrior
from vical_daemon.logs.recorded_logs import name_of_topic
from vical_daemon.offline.errors import OptionError

Said = TypeVar("Said")


def camera_name(topic: str) -> str:
    """Return the name of the camera whose images are on a topic."""
    parsed = parse_key(topic.strip("/"))
    return name_of_topic(topic, "cam") if parsed is None else parsed.name


def by_recording(
    said: Mapping[str, Said], topics: Mapping[str, str], names: Collection[str]
) -> dict[str, Said]:
    """Rename what a file says: Kalibr numbers its cameras, and its `rostopic` tells which they are.

    Args:
        said: By the names in the file.
        topics: Topic of the images, by the names in the file; not of all. One that two cameras have is none.
        names: Names in the recording.
    """
    meant = {name: camera_name(topics[name]) for name in said if topics.get(name)}
    once = Counter(meant.values())
    renamed = {old: new for old, new in meant.items() if new in names and once[new] == 1}
    rest = {name: item for name, item in said.items() if name not in renamed}
    return rest | {new: said[old] for old, new in renamed.items()}


def priors_meant(initial: Initial, names: Collection[str]) -> dict[str, CameraPrior]:
    """Return the priors by the recording's names; the only camera of the file may have another name there.

    Raises:
        OptionError: The file is of other cameras.
    """
    given = by_recording(initial.cameras, initial.topics, names)
    if not given or any(name in given for name in names):
        return given
    if len(given) == 1:
        return dict.fromkeys(names, next(iter(given.values())))
    here, there = ", ".join(names), ", ".join(given)
    raise OptionError(f"--initial has {there}, the recording has {here}: rename the camera in the file")
