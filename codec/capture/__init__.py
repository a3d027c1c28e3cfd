"""Input layouts -> Capture: one reader file per layout, and the detector that picks it by what lies in the folder."""

from .capture import Capture, blend, composite, cropped
from .detect import find_capture, open_capture
from .images import View

__all__ = ["Capture", "View", "blend", "composite", "cropped", "find_capture", "open_capture"]
