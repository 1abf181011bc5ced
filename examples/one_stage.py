"""One stage of valve_drake in a diagram of one's own: colour segmentation on images of any source.

python examples/one_stage.py IMAGE.png

Two systems and three arrows: a camera that is this file's, and the stage. Messages are values on abstract ports.
"""

import sys

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource

from valve_drake.messages import CameraFrame, ModeState
from valve_drake.perception.color_segmentation import ColorSegmentationConfig
from valve_drake.perception.color_segmentation_system import ColorSegmentationSystem


class Photograph(LeafSystem):
    """A camera that sees the same at all times: a new frame every 1/8 s."""

    def __init__(self, image: np.ndarray):
        super().__init__()
        self.image = image
        self.DeclareAbstractOutputPort("image", lambda: Value(CameraFrame()), self.look)

    def look(self, context, output) -> None:
        n = int(8 * context.get_time())
        output.set_value(CameraFrame(camera="photograph", time=n / 8, sequence=n, image=self.image.copy()))


def main(path: str) -> None:
    builder = DiagramBuilder()
    camera = builder.AddSystem(Photograph(cv2.cvtColor(cv2.imread(path), cv2.COLOR_BGR2RGB)))
    stage = builder.AddSystem(ColorSegmentationSystem(ColorSegmentationConfig()))
    mode = builder.AddSystem(ConstantValueSource(Value(ModeState(mode="search", head_every=1))))
    for port in ("head_left_image", "head_right_image"):
        builder.Connect(camera.get_output_port(), stage.GetInputPort(port))
    builder.Connect(mode.get_output_port(), stage.GetInputPort("mode"))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(1.0)
    seen = stage.GetOutputPort("segmentation").Eval(stage.GetMyContextFromRoot(simulator.get_context()))
    for candidate in seen.left.candidates:
        print(np.round(candidate.center), f"{candidate.area:.0f} px^2", candidate.rejected or "may be the marker")


if __name__ == "__main__":
    main(*sys.argv[1:])
