"""ROS recordings as files: ROS 1 bags, ROS 2 bags (sqlite3, MCAP) and single MCAP files, read by `rosbags` without ROS.

Messages are read as the standard definitions of their types say; the definitions that a bag carries are not used, as
one odd type of someone's own would make the whole bag unreadable.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from jaxmap.datasets.text_files import read_text
from jaxmap.errors import FrameError, JaxmapError

BAG_SUFFIXES = (".bag", ".mcap", ".db3")

_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_METADATA = "metadata.yaml"


class Topic(NamedTuple):
    """A topic of a bag: its type, as ROS 2 writes it (`sensor_msgs/msg/Image`), and how many messages it has."""

    type: str
    messages: int


class Place(NamedTuple):
    """Where a message lies: its topic, when it was recorded, and how many of the topic came before at that time."""

    topic: str
    recorded_ns: int
    before: int = 0


class Message(NamedTuple):
    """A message as read, and where it lies."""

    place: Place
    value: Any


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file by its suffix; a folder by ROS 2's metadata, or holding nothing but bags."""
    if path.is_file():
        return path.suffix.lower() in BAG_SUFFIXES
    if (path / _METADATA).is_file():
        try:
            return "rosbag2_bagfile_information" in read_text(path / _METADATA)
        except JaxmapError:
            return False
    return path.is_dir() and bool(_bag_files(path)) and not any(entry.is_dir() for entry in path.iterdir())


class Bag:
    """An open recording, in one file or several; reading may be done from several threads.

    Attributes:
        path: the file or folder.
        topics: what was recorded, by name, without the topics that have no message.
    """

    def __init__(self, path: Path) -> None:
        """Opens a recording; only its index is read.

        Raises:
            JaxmapError: it is damaged, incomplete or of no known kind.
        """
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        self.path = path
        self._lock = threading.Lock()
        self._opened = ExitStack()
        whole = path.is_file() or (path / _METADATA).is_file()
        files = [path] if whole else _bag_files(path)
        self._ros1 = files[0].suffix.lower() == ".bag"
        if any((file.suffix.lower() == ".bag") != self._ros1 for file in files):
            raise JaxmapError("bags of ROS 1 and ROS 2 in one folder", where=path, fix="give one of them")
        self._deserialise = _deserialiser(self._ros1)
        self._readers: list[Any] = []
        for file in files:
            with _told(file):
                self._readers.append(self._opened.enter_context((Reader1 if self._ros1 else Reader2)(file)))
        self.topics: dict[str, Topic] = {}
        for connection in (connection for reader in self._readers for connection in reader.connections):
            before = self.topics.get(connection.topic, Topic(connection.msgtype, 0))
            if connection.msgcount:
                self.topics[connection.topic] = Topic(connection.msgtype, before.messages + connection.msgcount)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """All messages of some topics, one at a time.

        Raises:
            JaxmapError: a message cannot be read.
        """
        yield from self._messages(topics)

    def read(self, place: Place) -> Any:
        """The one message that lies at a place.

        Raises:
            FrameError: it cannot be read.
        """
        with self._lock:
            try:
                for message in self._messages((place.topic,), place.recorded_ns):
                    if message.place == place:
                        return message.value
            except JaxmapError as fault:
                raise FrameError(fault.what, where=fault.where, fix=fault.fix) from fault
        raise FrameError(f"no message of {place.topic} at {place.recorded_ns} ns", where=self.path)

    def _messages(self, topics: Collection[str], at_ns: int | None = None) -> Iterator[Message]:
        last: dict[str, Place] = {}
        stop_ns = None if at_ns is None else at_ns + 1
        for reader in self._readers:
            connections = [connection for connection in reader.connections if connection.topic in topics]
            # Without any, the readers would deliver all.
            if not connections:
                continue
            with _told(self.path):
                for connection, recorded_ns, data in reader.messages(connections, at_ns, stop_ns):
                    before = last.get(connection.topic)
                    repeats = before.before + 1 if before is not None and before.recorded_ns == recorded_ns else 0
                    last[connection.topic] = place = Place(connection.topic, recorded_ns, repeats)
                    yield Message(place, self._deserialise(data, connection.msgtype))


def _bag_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in BAG_SUFFIXES and file.is_file())


@cache
def _deserialiser(ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
    for name in _TF_TYPES:
        if name not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store.deserialize_ros1 if ros1 else store.deserialize_cdr


@contextmanager
def _told(where: Path) -> Iterator[None]:
    """Whatever goes wrong in a bag becomes one line."""
    try:
        yield
    except (JaxmapError, GeneratorExit):
        raise
    except Exception as fault:
        # On damaged files the readers raise nearly anything; some of it without a text.
        reason = str(fault) or type(fault).__name__
        fix = "restore the file, or mend it by rosbag reindex (ROS 1), ros2 bag reindex or mcap recover"
        if "Profile" in reason:
            fix = "of MCAP files those of ROS 2 are read; give the bag that this one was made of"
        raise JaxmapError(f"the bag cannot be read ({reason[:160]})", where=where, fix=fix) from fault
