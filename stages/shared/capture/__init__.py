"""Captures: cameras, pictures, masks, labels and poses of one dressed person, in any layout on disk."""

from stages.shared.capture.camera import Box, Camera
from stages.shared.capture.labels import label_picture
from stages.shared.capture.native_writer import NativeWriter, TakeWriter, native_writer
from stages.shared.capture.open_capture import FORMATS, open_capture
from stages.shared.capture.take import Capture, Take

__all__ = [
    "FORMATS",
    "Box",
    "Camera",
    "Capture",
    "NativeWriter",
    "Take",
    "TakeWriter",
    "label_picture",
    "native_writer",
    "open_capture",
]
