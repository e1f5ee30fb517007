"""What the pictures of these tests owe to the OpenCV that draws them."""

from __future__ import annotations

import cv2

# OpenCV 4 draws the films a little otherwise, so other corners are found; bounds are those of OpenCV 5.
SLACK = 1.0 if int(cv2.__version__.split(".")[0]) >= 5 else 1.35
