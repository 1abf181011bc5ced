"""The estimator alone: where a red rectangle is, in a stereo pair of photographs. No Drake.

python examples/two_photographs.py LEFT.png RIGHT.png head.yaml 98x100

head.yaml: of `valve-drake calibrate stereo`, or of a ROS stereo pair. 98x100: the rectangle, width x height [mm].
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from valve_drake.camera.calibration_file import load_calibration
from valve_drake.perception import estimate_rectangle


def main(left: str, right: str, calibration: str, size: str) -> None:
    head = load_calibration([Path(calibration)])
    images = [cv2.cvtColor(cv2.imread(path), cv2.COLOR_BGR2RGB) for path in (left, right)]
    width, height = (float(word) / 1e3 for word in size.split("x"))
    found = estimate_rectangle(*images, head, marker_size=(width, height))
    if not found.found:
        sys.exit(f"no rectangle: {found.reason}")
    # X_LV, the marker V in the left camera L; the covariance is of (turn in V, position in L).
    sigma = np.sqrt(np.diag(found.covariance))
    print("position [mm]", np.round(1e3 * found.X_LV[:, 3], 2), "+-", np.round(1e3 * sigma[3:], 2))
    print("axis of V   ", np.round(found.X_LV[:, 2], 4), "+-", np.round(np.degrees(sigma[:2]), 3), "deg")


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
