"""Input layouts -> Capture. Each layout has a reader file; detect.py picks the reader by the files of the folder."""

from .capture import Capture, blend, composite, cropped
from .detect import find_capture, open_capture
from .images import View

__all__ = ["Capture", "View", "blend", "composite", "cropped", "find_capture", "open_capture"]
