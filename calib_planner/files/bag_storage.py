"""Messages out of a rosbag2 recording, one at a time, whatever its storage; rosbags does the reading.

A bag is a folder with ``metadata.yaml``, a folder of storage files whose recorder never wrote that, or one
storage file (.db3, .mcap). Only the topics asked for are read, and only a chunk at a time is in memory. Their
types are those of ROS 2 Jazzy, whatever definitions the bag holds or lacks. Whatever rosbags raises on files that
are no bags or are damaged becomes an error of ours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from calib_planner.errors import FileFormatError, InputError, MissingExtraError

JOINT_STATE = "sensor_msgs/msg/JointState"
POINT = "geometry_msgs/msg/PointStamped"
STORAGE = (".db3", ".mcap")
WHAT = "a rosbag2 folder or a .db3 or .mcap file of one"
REPAIR = "repair it with 'ros2 bag reindex FOLDER' or, for .mcap, 'mcap recover FILE'"
MOST_LISTED = 20
"""Topics or files that an error lists."""


@dataclass(frozen=True)
class BagTopics:
    """Where the messages are; a leading slash may be left out.

    Attributes:
        joints: Topic of sensor_msgs/JointState.
        points: Topics of geometry_msgs/PointStamped, one per target, in the order of the targets.
    """

    joints: str = "joint_states"
    points: tuple[str, ...] = ("tracker/point",)

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", tuple(self.points))
        names = self.names
        if len(names) < 2 or "/" in names or len(set(names)) != len(names):
            got = ", ".join(map(repr, (self.joints, *self.points)))
            raise InputError("topics", got, "a topic of joints and one per target, each once")

    @property
    def names(self) -> tuple[str, ...]:
        """All topics as a bag names them, that of the joints first."""
        return tuple("/" + name.strip().strip("/") for name in (self.joints, *self.points))


class BrokenStorage(Exception):
    """Reading stopped before the end; the text says why."""


@dataclass(frozen=True, eq=False)
class Recording:
    """An open bag.

    Attributes:
        names: The topics wanted, as in the bag; their positions are the numbers of the streams.
        promised: Messages of each topic, as the bag's own index says.
        unread: What the bag holds but no reader gets at, in words; empty if there is nothing.
    """

    names: tuple[str, ...]
    promised: tuple[int, ...]
    unread: str
    _readers: tuple[Any, ...]
    _types: Any

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Number of the stream and undecoded message, in the order of recording.

        Raises:
            BrokenStorage: The storage is damaged here; nothing more can be read.
        """
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in self.names]
            source = iter(reader.messages(wanted)) if wanted else iter(())
            while True:
                try:
                    connection, _, data = next(source)
                except StopIteration:
                    break
                except Exception as error:  # rosbags lets through what sqlite, zstd, lz4 and struct raise
                    raise BrokenStorage(reason(error)) from None
                yield self.names.index(connection.topic), data

    def decode(self, stream: int, data: bytes) -> Any:
        """The message as an object with the fields of its type.

        Raises:
            BrokenStorage: These bytes are no such message.
        """
        try:
            return self._types.deserialize_cdr(data, POINT if stream else JOINT_STATE)
        except Exception as error:
            raise BrokenStorage(reason(error)) from None


@contextmanager
def open_bag(path: str | Path, topics: BagTopics) -> Iterator[Recording]:
    """Open a bag for reading the given topics.

    Raises:
        MissingExtraError: rosbags is not installed.
        FileFormatError: Not a bag, not readable, a topic missing or of another type.
    """
    reader_class, types = _rosbags()
    with ExitStack() as stack:
        readers = []
        for part in storage_parts(path):
            try:
                readers.append(stack.enter_context(reader_class(part)))
            except Exception as error:
                raise FileFormatError(part, "bag", reason(error), WHAT, REPAIR) from None
        _check_topics(path, readers, topics.names)
        promised = tuple(
            sum(c.msgcount for r in readers for c in r.connections if c.topic == name) for name in topics.names
        )
        yield Recording(topics.names, promised, _write_ahead(path), tuple(readers), types)


def is_bag(path: str | Path) -> bool:
    """Whether ``path`` is to be read as a bag rather than as text: a folder, or a storage file by its name."""
    place = Path(path).expanduser()
    return place.is_dir() or place.suffix in STORAGE or place.name == "metadata.yaml"


def storage_parts(path: str | Path) -> list[Path]:
    """What to open one after the other: the folder itself if it has metadata, else its storage files.

    Raises:
        FileFormatError: There is nothing of the kind.
    """
    place = Path(path).expanduser()
    place = place.parent if place.name == "metadata.yaml" else place
    try:
        if not place.is_dir():
            place.open("rb").close()
            if place.suffix in STORAGE:
                return [place]
            advice = "convert it with rosbags-convert" if place.suffix == ".bag" else "give the bag's folder"
            raise FileFormatError(path, "file", f"a file named {place.name}", WHAT, advice)
        files = sorted(p for p in place.iterdir())
    except OSError as error:
        raise FileFormatError(path, "file", error.strerror or error, WHAT, "check the path") from None
    if any(p.name == "metadata.yaml" for p in files):
        return [place]
    found = sorted((p for p in files if p.suffix in STORAGE), key=_numbered)
    if found:
        return found
    inner = [p.name for p in files if (p / "metadata.yaml").is_file()]
    advice = f"give one of the folders in it: {_cut(inner)}" if inner else "give the folder that ros2 bag wrote"
    raise FileFormatError(path, "folder", f"{_cut([p.name for p in files])}", WHAT, advice)


def reason(error: BaseException) -> str:
    """What went wrong in one line, short; the kind of error where it has no text."""
    text = " ".join(str(error).split())[:300].rstrip(".")
    return text or type(error).__name__


def _rosbags() -> tuple[Any, Any]:
    """The class that reads bags, and the message types of Jazzy."""
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("bags", "rosbags", "reading bags") from None
    return Reader, get_typestore(Stores.ROS2_JAZZY)


def _check_topics(path: str | Path, readers: list[Any], names: tuple[str, ...]) -> None:
    held: dict[str, set[str]] = {}
    for connection in (c for r in readers for c in r.connections):
        held.setdefault(connection.topic, set()).add(connection.msgtype)
    described = _cut([f"{t} ({', '.join(sorted(held[t]))})" for t in sorted(held)])
    for stream, name in enumerate(names):
        wanted, option = (POINT, "--point-topic") if stream else (JOINT_STATE, "--joint-topic")
        fitting = [t for t in sorted(held) if held[t] == {wanted}]
        close = (get_close_matches(name, fitting, n=1, cutoff=0.3) or fitting)[:1]
        advice = f"is it {option} {close[0]}?" if close else f"record a topic of type {wanted}"
        if name not in held:
            raise FileFormatError(
                path, f"topic {name}", f"a bag with {described}", f"messages of {wanted}", advice
            )
        if held[name] != {wanted}:
            raise FileFormatError(path, f"topic {name}", ", ".join(sorted(held[name])), wanted, advice)


def _write_ahead(path: str | Path) -> str:
    """Names logs beside SQLite files that still hold messages: the recorder did not end properly."""
    place = Path(path).expanduser()
    logs = [place.with_name(place.name + "-wal")] if place.is_file() else sorted(place.glob("*.db3-wal"))
    full = [p.name for p in logs if p.is_file() and p.stat().st_size]
    return f"{_cut(full)} holds messages not yet in the .db3 file (open that once with sqlite3)" if full else ""


def _numbered(path: Path) -> list[Any]:
    """Sorts bag_10 after bag_9."""
    words = re.split(r"([0-9]+)", path.name)
    return [int(w) if i % 2 else w for i, w in enumerate(words)]


def _cut(names: list[str]) -> str:
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return ", ".join(n[:200] for n in names[:MOST_LISTED]) + more if names else "nothing"
