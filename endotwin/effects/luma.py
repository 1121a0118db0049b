"""Luminance of display values."""

import numpy as np

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Shares of R, G and B in luminance (ITU-R BT.601)."""
