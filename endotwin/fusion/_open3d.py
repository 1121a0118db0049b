"""Open3D as bare machines can load it: it links against libusb, which the ``libusb-package`` wheel
carries."""

import ctypes

import libusb_package

_libusb = libusb_package.get_library_path()
if _libusb is not None:
    ctypes.CDLL(str(_libusb), mode=ctypes.RTLD_GLOBAL)

import open3d as o3d  # noqa: E402
import open3d.core as o3c  # noqa: E402

__all__ = ["o3c", "o3d"]
