"""Errors by blame: who has to act decides the type (the message says what, where, what was expected and what to do).

All derive from `GscodecError`, which the command line prints as one sentence; anything else is a bug of ours.
"""

import importlib
from types import ModuleType


class GscodecError(Exception):
    """Base of everything that a user can cause and mend."""


class BitstreamError(GscodecError):
    """A .gsv file is damaged or not one: names the byte offset, the unit and what was expected there."""


class LimitError(GscodecError):
    """A .gsv file or a request is valid but larger than the level or this build allows."""


class CaptureError(GscodecError):
    """Input data (images, calibration, splats) is missing or wrong: names file, camera and frame."""


class UsageError(GscodecError):
    """An argument or a combination of arguments makes no sense, or an extra has to be installed first."""


def require(module: str, purpose: str, extra: str = "encode") -> ModuleType:
    """The optional module `module`, imported when it is needed, since the player's side installs without it.

    Args:
        module: import name, e.g. "cv2".
        purpose: what needs it, the start of the message, e.g. "reading a video".
        extra: the extra of the package that has it.

    Raises:
        UsageError: it is not installed; names the extra that has it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise UsageError(f"{purpose} needs {module}; install it with: pip install 'gscodec[{extra}]'") from e
