"""Captures: the cameras of folders that other programs leave (INRIA's trainer, nerfstudio, COLMAP), one reader for each
format, all giving `Camera` and the lens that bends straight lines in the photograph. Reads no pictures."""

from __future__ import annotations

from splatpainter.captures.camera_files import capture_of as capture_of
from splatpainter.captures.camera_files import captured_views as captured_views
from splatpainter.captures.camera_files import choose_one as choose_one
from splatpainter.captures.camera_files import exposures_of as exposures_of
from splatpainter.captures.camera_files import is_capture as is_capture
from splatpainter.captures.camera_files import named_views as named_views
from splatpainter.captures.camera_files import split_selector as split_selector
from splatpainter.captures.captured_view import CapturedView as CapturedView
