"""The error tree: one class per exit code, each message one line that says what to do.

A failed *solve* is a result with a status and a sentence (see ``quality``); a wrong *call*
or a bad file is one of these exceptions.
"""

from __future__ import annotations


class GcarError(Exception):
    """Base of every error that gcar raises on purpose; ``exit_code`` is the process's code."""

    exit_code = 1


class UsageError(GcarError):
    """The call itself is wrong: too few pictures, an option out of range, an existing folder."""

    exit_code = 2


class ImageError(GcarError):
    """A picture or DICOM file is missing, truncated, undecodable or of an unsupported kind."""

    exit_code = 3


class GeometryError(GcarError):
    """A geometry value is missing, misspelt, out of range or at odds with the picture."""

    exit_code = 4


class ModelError(GcarError):
    """A model file is missing, altered or not what its spec says."""

    exit_code = 5


class RefusedError(GcarError):
    """Good files from which no tree can honestly be made (quality gate)."""

    exit_code = 6


class CancelledError(GcarError):
    """The caller cancelled, or the deadline passed before there was a result."""

    exit_code = 7


class NumericalError(GcarError):
    """The computation left the finite numbers and could not be brought back."""

    exit_code = 8


#: what libraries say, in errors that are no MemoryError, of memory that the system does not give
_NO_MEMORY = ("can't start new thread", "Failed to allocate memory", "bad_alloc", "bad allocation",
              "Insufficient memory")  # fmt: skip


def out_of_memory(error: BaseException) -> bool:
    """Tell whether an error says that memory ran out, whichever library raised it."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in _NO_MEMORY)
