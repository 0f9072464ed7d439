# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the elements of a MATLAB file (versions 5 to 7) fit into each other, before SciPy reads them.

SciPy's reader believes what a file says of itself. Numbers whose type is none end the whole process
(scipy/scipy#25349): the type of the next element is, where an imaginary part is missing. Sizes that nothing
stands behind take memory without end. So the file is walked through once, without looking at a number.

Behind a header of 128 bytes, of which the last two tell the order of bytes, a file is a row of elements: type and
length (4 bytes each), then the content, filled up to a multiple of 8 bytes. Content of at most 4 bytes may stand
in the tag itself, whose first half then holds its length and its type. An element of type 15 holds another one,
compressed. One of type 14 is an array, which consists of elements again: flags, sizes, name, and what its class
says: numbers, then imaginary parts, texts, or arrays in arrays.
"""

from __future__ import annotations

import math
import struct
import zlib

NUMBERS = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})
"""Types of elements that hold numbers or characters; SciPy knows them by a table that has holes."""
ARRAY, COMPRESSED = 14, 15
CELL, STRUCT, OBJECT, CHARACTERS, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC = range(6, 16)
"""Classes of arrays, in the low byte of the flags; ``NUMERIC`` are double to uint64."""
COMPLEX = 1 << 11
MOST_INSIDE = 1 << 28
"""Bytes that a compressed element may unpack to: 33 million numbers, more than a table may have."""
DEEPEST = 16
"""Arrays within arrays; SciPy reads each by a call within a call of C, of which there is no error but a crash."""

MOST_SPACES = 1 << 16
"""Characters that may be without content: SciPy makes them spaces, and some writers leave them out."""


def check_elements(data: bytes) -> None:
    """Refuse a file that SciPy's reader could not come out of.

    Raises:
        ValueError: Says what does not fit.
    """
    order = "<" if data[126:128] == b"IM" else ">"
    file = _Elements(memoryview(data)[128:], order)
    while file.rest:
        kind, content = file.take()
        if kind == COMPRESSED:
            unpack = zlib.decompressobj()
            inside = _Elements(memoryview(unpack.decompress(content, MOST_INSIDE)), order)
            if unpack.unconsumed_tail:
                raise ValueError(f"an array of more than {MOST_INSIDE >> 20} MB")
            kind, content = inside.take()
        if kind != ARRAY:
            raise ValueError(f"an element of type {kind} where an array should be")
        _check_array(_Elements(content, order), DEEPEST)


class _Elements:
    """Elements one behind the other."""

    def __init__(self, rest: memoryview, order: str) -> None:
        self.rest = rest
        self.order = order

    def integers(self, content: memoryview) -> tuple[int, ...]:
        return struct.unpack(f"{self.order}{len(content) // 4}i", content[: len(content) // 4 * 4])

    def take(self, among: frozenset[int] | None = None) -> tuple[int, memoryview]:
        """Type and content of the next element, whose type is ``among`` these."""
        if len(self.rest) < 8:
            raise ValueError("an element is missing at the end")
        kind, length = struct.unpack(f"{self.order}II", self.rest[:8])
        start = 8
        if kind >> 16:  # the content stands in the tag
            kind, length, start = kind & 0xFFFF, kind >> 16, 4
            if length > 4:
                raise ValueError(f"{length} bytes in a tag that has room for 4")
        if among is not None and kind not in among:
            raise ValueError(f"an element of type {kind} where numbers should be")
        if start + length > len(self.rest):
            raise ValueError("an element that is longer than what holds it")
        content = self.rest[start : start + length]
        padded = kind != COMPRESSED  # compressed elements stand side by side
        self.rest = self.rest[max(8, start + length + (-length % 8 if padded and start == 8 else 0)) :]
        return kind, content


def _check_array(inside: _Elements, deepest: int) -> None:
    """The elements of one array: nothing is missing, and its sizes are not more than what it holds."""
    if deepest == 0:
        raise ValueError(f"more than {DEEPEST} arrays within each other")
    flags = inside.integers(inside.take(NUMBERS)[1])
    if len(flags) != 2:
        raise ValueError("flags that are none")
    kind, several = flags[0] & 0xFF, bool(flags[0] & COMPLEX)
    size = 1
    if kind == OPAQUE:
        for _ in range(3):
            inside.take(NUMBERS)
    else:
        sizes = inside.integers(inside.take(NUMBERS)[1])
        inside.take(NUMBERS)  # the name
        if min(sizes, default=-1) < 0:
            raise ValueError(f"an array of {len(sizes)} sizes, some of them less than 0")
        size = math.prod(sizes)
    if kind in NUMERIC:
        for _ in range(1 + several):
            inside.take(NUMBERS)
    elif kind == SPARSE:  # SciPy follows its indices wherever they lead
        raise ValueError("a sparse array (save full(…) of it)")
    elif kind == CHARACTERS:
        _check_room(size, max(len(inside.take(NUMBERS)[1]), MOST_SPACES))
    elif kind in (CELL, STRUCT, OBJECT, FUNCTION, OPAQUE):
        _check_parts(inside, kind, size, deepest)
    else:
        raise ValueError(f"an array of class {kind}, which is none")
    if inside.rest and deepest < DEEPEST:  # SciPy would take it for the next one
        raise ValueError("more in an array than belongs to it")


def _check_parts(inside: _Elements, kind: int, size: int, deepest: int) -> None:
    """The arrays within an array."""
    if kind == OBJECT:
        inside.take(NUMBERS)  # the name of its class
    count = size if kind == CELL else 1
    if kind in (STRUCT, OBJECT):
        longest = inside.integers(inside.take(NUMBERS)[1])
        names = len(inside.take(NUMBERS)[1])
        if len(longest) != 1 or longest[0] < 1:
            raise ValueError("names of fields without a length")
        count = size * (names // longest[0])
        _check_room(size, max(count, 1))
    _check_room(count, len(inside.rest) // 8)
    for _ in range(count):
        part, content = inside.take()
        if part != ARRAY:
            raise ValueError(f"an element of type {part} where an array should be")
        if content:
            _check_array(_Elements(content, inside.order), deepest - 1)


def _check_room(size: int, most: int) -> None:
    if size > most:
        raise ValueError(f"an array of {size} where {most} are")
