"""Error types: the type says who has to act; the message says what is wrong, where, what was expected, what to do.

All derive from `GscodecError`, which the command line prints as one sentence; any other exception is a bug of gscodec.
"""

import importlib
from types import ModuleType


class GscodecError(Exception):
    """Base of all errors that a user can cause and fix."""


class BitstreamError(GscodecError):
    """A file is damaged or not a .gsv file: names the byte offset, the unit and what was expected there."""


class LimitError(GscodecError):
    """A .gsv file or a request is valid but larger than the level or this build allows."""


class CaptureError(GscodecError):
    """Input data (images, calibration, splats) is missing or wrong: names file, camera and frame."""


class UsageError(GscodecError):
    """An argument or a combination of arguments makes no sense, or an extra has to be installed first."""


def require(module: str, purpose: str, extra: str = "encode") -> ModuleType:
    """Imports the optional module `module` only when it is needed: the player's side installs without it.

    Args:
        module: import name, e.g. "cv2".
        purpose: operation that needs the module, the start of the message, e.g. "reading a video".
        extra: optional extra of the package that installs the module.

    Raises:
        UsageError: the module is not installed; names the extra that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise UsageError(f"{purpose} needs {module}; install it with: pip install 'gscodec[{extra}]'") from e
