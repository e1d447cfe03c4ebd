"""Targets, detectors and feature tracks: the only folder that imports cv2."""

import os

# A picture of a few hundred kB can unpack to as many pixels as its header states. OpenCV reads this limit
# where it is imported; 2^27 pixels: twice what the largest industrial cameras have.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))
# Detectors run in a thread of their own. OpenCV's pool of threads waits actively between the short calls of a
# detector: with two cores it cost four cameras a fifth of their CPU time, and gave nothing back.
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
