# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Text in and out of files: bounded reading, atomic writing, typed errors."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from calib_planner.errors import FileFormatError, InputError

MAX_BYTES = 50_000_000
"""Larger files are refused: a plan or a day's measurements is far below a megabyte."""


@dataclass(frozen=True, eq=False)
class RawLines:
    """A file before anybody looked at what its lines mean.

    Attributes:
        path: The file.
        kind: What kind of file it is, with the part of it that was read, for people.
        texts: The lines, blank ones among them.
        word: What a position in ``texts``, from 1, counts in the file: ``line``, ``row`` or ``entry``.
        separator: What parts the cells, where the kind of file decides that; empty for text.
        units: Column name → unit as written, where the file says that apart from the names.
        first: Number of the first text.
    """

    path: str
    kind: str
    texts: Sequence[str] = field(repr=False)
    word: str = "line"
    separator: str = ""
    units: dict[str, str] = field(default_factory=dict)
    first: int = 1


def user_path(path: str | Path) -> Path:
    """The path that a user gave, with ``~`` as the home folder."""
    return Path(path).expanduser()


def make_folder(folder: str | Path, field: str = "output") -> Path:
    """The folder, made with those above it if it is not there.

    Raises:
        InputError: It cannot be made; names ``field``.
    """
    target = user_path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"{folder} ({error.strerror})"
        raise InputError(field, reason, "a folder that can be made", "choose another") from None
    return target


def fresh_folder(folder: str | Path, field: str = "output") -> Path:
    """A folder of its own for new results: ``folder`` if it is not there or empty, else ``folder-2``, ``-3``, ….

    Raises:
        InputError: It cannot be made; names ``field``.
    """
    target = user_path(folder)
    number = 1
    while (place := target if number == 1 else target.with_name(f"{target.name}-{number}")).exists():
        if place.is_dir() and not any(place.iterdir()):
            break
        if not place.is_dir() and number == 1:
            break  # a file of that name: make_folder says so
        number += 1
    return make_folder(place, field)


def read_text(path: str | Path, what: str) -> str:
    """The text of a UTF-8 file, without a byte order mark.

    Args:
        path: The file.
        what: What it should be, for the error, e.g. ``"a CSV of measurements"``.

    Raises:
        FileFormatError: No such file, not readable, too big or not UTF-8.
    """
    return decode(path, what, read_bytes(path, what), "utf-8-sig")


def read_bytes(path: str | Path, what: str) -> bytes:
    """Like ``read_text``, the bytes as they are.

    Raises:
        FileFormatError: No such file, not readable or too big.
    """
    try:
        with open(user_path(path), "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        reason = error.strerror or error
        raise FileFormatError(path, "file", reason, what, "check the path") from None
    if len(data) > MAX_BYTES:
        limit = f"{what} of at most {MAX_BYTES // 1_000_000} MB"
        raise FileFormatError(path, "file", "a larger file", limit, "split it")
    return data


def decode(path: str | Path, what: str, data: bytes, encoding: str = "utf-8") -> str:
    """``data`` as text; ``encoding`` utf-8-sig drops a byte order mark.

    Raises:
        FileFormatError: Not UTF-8.
    """
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        got = f"byte 0x{data[error.start]:02x} in line {line} ({error.reason})"
        raise FileFormatError(path, "file", got, what, "save it as UTF-8 text") from None


def decode_any(path: str | Path, what: str, data: bytes) -> tuple[str, str]:
    """``data`` as text in whatever encoding tables come, and the encoding's name.

    A byte order mark decides; else every second byte being zero tells UTF-16; else it is UTF-8, and if it is
    not, the Windows code page of western languages, in which spreadsheets write ° and µ.

    Raises:
        FileFormatError: Bytes that are no text.
    """
    sample = data[:4096]
    odd, even = sample[1::2].count(0), sample[0::2].count(0)
    half = len(sample) // 2
    encoding = "utf-8-sig"
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encoding = "utf-16"
    elif half and max(odd, even) > 0.7 * half and min(odd, even) < 0.1 * half:
        encoding = "utf-16-le" if odd > even else "utf-16-be"
    if encoding == "utf-8-sig":
        if b"\0" in data:
            line = data.count(b"\n", 0, data.index(b"\0")) + 1
            raise FileFormatError(path, f"line {line}", "a NUL character", what, "save it as text")
        try:
            return data.decode(encoding), "UTF-8"
        except UnicodeDecodeError:
            encoding = "cp1252"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        got = f"byte 0x{data[error.start]:02x} in line {line} ({error.reason})"
        raise FileFormatError(path, "file", got, what, "save it as UTF-8 text") from None
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise FileFormatError(path, f"line {line}", "a NUL character", what, "save it as text")
    return text, {"cp1252": "Windows-1252"}.get(encoding, "UTF-16")


def write_text(path: str | Path, text: str, field: str = "output") -> None:
    """Write ``text`` so that the file is either the old one or the whole new one.

    Args:
        path: The file; an existing one is replaced. A device or pipe is written to directly.
        text: Its content.
        field: The argument or option that named the path, for the error.

    Raises:
        InputError: The path cannot be written.
    """
    target = user_path(path)
    try:
        if target.exists() and not target.is_file() and not target.is_dir():
            target.write_text(text, encoding="utf-8")
        else:
            _replace(target.resolve(), text)
    except OSError as error:
        raise _unwritable(path, field, error) from None


def check_writable(path: str | Path, field: str = "output") -> None:
    """Find out before the work whether ``write_text`` will be able to write there; leaves nothing behind.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    target = user_path(path).resolve()
    try:
        if target.is_dir():
            raise IsADirectoryError(21, "is a folder")
        if target.exists() and not target.is_file():
            return  # a device or a pipe
        handle, name = tempfile.mkstemp(prefix=f".{target.name[:64]}.", dir=target.parent)
        os.close(handle)
        os.unlink(name)
    except OSError as error:
        raise _unwritable(path, field, error) from None


def _unwritable(path: str | Path, field: str, error: OSError) -> InputError:
    reason = f"{path} ({error.strerror or error})"
    return InputError(
        field, reason, "a file path that can be written", "choose another path or make the folder first"
    )


def _replace(target: Path, text: str) -> None:
    if target.is_dir():
        raise IsADirectoryError(21, "is a folder")
    handle, name = tempfile.mkstemp(prefix=f".{target.name[:64]}.", dir=target.parent)
    try:
        with open(handle, "w", encoding="utf-8", newline="") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, _mode(target))
        os.replace(name, target)
    except BaseException:
        os.unlink(name)
        raise
    settle(target.parent)


def settle(folder: Path) -> None:
    """Have a folder know its new names for good: else a power cut may take back what was renamed or made."""
    with suppress(OSError):  # not every file system can
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _mode(target: Path) -> int:
    """Permissions of the file to be replaced, or what a new file would get."""
    if target.exists():
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
