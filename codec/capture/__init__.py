"""Input layouts -> Capture: one reader file per layout, and the detector that picks it by what lies in the folder."""

from gscodec.capture.capture import Capture, blend, composite, cropped
from gscodec.capture.detect import find_capture, open_capture
from gscodec.capture.images import View

__all__ = ["Capture", "View", "blend", "composite", "cropped", "find_capture", "open_capture"]
