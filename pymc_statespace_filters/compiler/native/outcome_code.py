"""What a call of compiled code ended with: an integer there, a sentence here."""

from enum import IntEnum
from typing import Self


class OutcomeCode(IntEnum):
    """A code with its ``message`` and, where one is general, what to do: its ``cure``."""

    message: str
    cure: str

    def __new__(cls, code: int, message: str, cure: str = "") -> Self:
        """Make a member."""
        self = int.__new__(cls, code)
        self._value_, self.message, self.cure = code, message, cure
        return self

    @classmethod
    def of(cls, code: float) -> Self:
        """The member of a code."""
        return cls._value2member_map_[int(code)]  # type: ignore[return-value]
