# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""One root for everything this package refuses, so that a caller needs one ``except``.

Every child carries its data as attributes (never only as prose) and its text says four things: which
field, what was got, what is valid, and what to do.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches

CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029]")
"""Characters that break a line, move a cursor or colour a terminal."""


class CalibPlannerError(Exception):
    """Root of all errors raised on purpose by calib_planner.

    Its text is one line, whatever stands in names that came over the wire or out of a file.
    """

    def __str__(self) -> str:
        """The text, with control characters written out."""
        return CONTROLS.sub(lambda one: repr(one[0])[1:-1], super().__str__())


class InputError(CalibPlannerError, ValueError):
    """A value from outside is not usable.

    Attributes:
        field: Name of the argument, key, column or parameter at fault.
        got: What came in, as text.
        expected: What would have been valid, as text.
        advice: What to do about it; may be empty.
    """

    def __init__(self, field: str, got: object, expected: str, advice: str = "") -> None:
        self.field = field
        self.got = str(got)
        self.expected = expected
        self.advice = advice
        text = f"{field}: expected {expected}, got {self.got}"
        super().__init__(f"{text}; {advice}" if advice else text)


class UnknownNameError(InputError):
    """A name is not among the valid ones.

    Attributes:
        valid: The valid names.
    """

    def __init__(self, field: str, got: str, valid: Sequence[str]) -> None:
        self.valid = tuple(valid)
        close = get_close_matches(got, self.valid, n=1)
        advice = f"did you mean {close[0]!r}?" if close else "use one of the valid names"
        names = ", ".join(self.valid) if self.valid else "(there are none)"
        super().__init__(field, repr(got), f"one of: {names}", advice)


class FileFormatError(InputError):
    """A file exists but cannot be read as what it should be.

    Attributes:
        path: The file.
    """

    def __init__(self, path: object, field: str, got: object, expected: str, advice: str = "") -> None:
        self.path = str(path)
        super().__init__(f"{path}: {field}", got, expected, advice)


class InfeasibleError(CalibPlannerError):
    """The request is well formed but nothing satisfies it.

    Attributes:
        constraint: Name of the constraint that empties the set of answers.
    """

    def __init__(self, constraint: str, message: str) -> None:
        self.constraint = constraint
        super().__init__(f"{constraint}: {message}")


class NotEnoughDataError(CalibPlannerError):
    """The data cannot determine the wanted parameters, whatever their values.

    Attributes:
        have: Number of scalar equations at hand.
        need: Number of scalar equations required.
    """

    def __init__(self, have: int, need: int, message: str) -> None:
        self.have = have
        self.need = need
        super().__init__(message)


class MissingExtraError(CalibPlannerError, ImportError):
    """A package that only this feature needs is not installed.

    Attributes:
        extra: The extra of calib_planner that brings it.
    """

    def __init__(self, extra: str, package: str, feature: str) -> None:
        self.extra = extra
        super().__init__(f"{feature} needs {package}; install it with: pip install 'calib_planner[{extra}]'")


class StoreError(CalibPlannerError):
    """Nothing can be written or read now: a full disk, a folder that is not writable, a device in trouble.

    What is there is right; the same thing can be tried again later.

    Attributes:
        path: The file or folder.
        reason: What the system says.
    """

    def __init__(self, path: object, reason: str, advice: str = "") -> None:
        self.path = str(path)
        self.reason = reason
        super().__init__(f"{path}: {reason}; {advice}" if advice else f"{path}: {reason}")
