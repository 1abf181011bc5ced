"""Cameras: the lens models of the paper and of OpenCV, and the calibration of the stereo head."""
