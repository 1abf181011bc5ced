"""Block `handle_marker`: the green marks in the wrist images on ports. No mathematics here."""

import dataclasses as dc

from valve_drake.messages import CameraFrame, HandleMark, HandleMarks, ModeState
from valve_drake.perception.handle_marker import HandleMarkerConfig, find_mark
from valve_drake.ports import Block, Inputs, Outputs


@dc.dataclass(frozen=True)
class _Memory:
    idle: int = 1 << 30  # steps since the last look
    left: HandleMark = dc.field(default_factory=HandleMark)
    right: HandleMark = dc.field(default_factory=HandleMark)


class HandleMarkerInputs(Inputs):
    left_wrist_image: CameraFrame = CameraFrame()
    right_wrist_image: CameraFrame = CameraFrame()
    mode: ModeState


class HandleMarkerSystem(Block[HandleMarkerInputs, _Memory]):
    """Looks at both wrist images as often as the mode asks; else holds.

    port               dir  type         notes
    -----------------  ---  -----------  -----------------
    left_wrist_image   in   CameraFrame
    right_wrist_image  in   CameraFrame
    mode               in   ModeState    how often to look
    marks              out  HandleMarks
    """

    OUTPUTS = {"marks": HandleMarks}

    def __init__(
        self,
        config: HandleMarkerConfig,
        name: str = "handle_marker",
        period: float = 1 / 16,
        delay: float = 1 / 128,
    ):
        config.check()
        self._config = config
        super().__init__(name, period=period, slot=3, delay=delay)

    def initial(self) -> _Memory:
        return _Memory()

    def step(self, time: float, inputs: HandleMarkerInputs, memory: _Memory) -> tuple[_Memory, Outputs]:
        state = inputs.mode
        every = state.wrist_every
        memory = dc.replace(memory, idle=memory.idle + 1)
        if every == 0 or memory.idle < every:
            return memory, {}
        left = self._look(inputs.left_wrist_image, memory.left)
        right = self._look(inputs.right_wrist_image, memory.right)
        if left is memory.left and right is memory.right:
            return memory, {}
        marks = HandleMarks(time=max(left.time, right.time), left=left, right=right)
        return _Memory(idle=0, left=left, right=right), {"marks": marks}

    def _look(self, frame: CameraFrame, last: HandleMark) -> HandleMark:
        """The mark in a new frame; `last` if the frame is not new."""
        if frame.sequence < 0 or frame.sequence == last.sequence:
            return last
        mark = find_mark(frame.image, self._config)
        return dc.replace(mark, frame=frame, time=frame.time, sequence=frame.sequence)
