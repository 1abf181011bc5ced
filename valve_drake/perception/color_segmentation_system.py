"""Block `color_segmentation`: segmenting both head images on ports. No mathematics here."""

import dataclasses as dc

from valve_drake.messages import CameraFrame, MarkerCandidate, ModeState, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segmented
from valve_drake.ports import Block, Inputs, Outputs

_Box = tuple[int, int, int, int]


@dc.dataclass(frozen=True)
class _Memory:
    idle: int = 1 << 30  # steps since the last look
    sequence: int = -1
    looks: int = 0
    boxes: tuple[_Box | None, _Box | None] = (None, None)  # where the candidates were, in each image


class ColorSegmentationInputs(Inputs):
    head_left_image: CameraFrame = CameraFrame()
    head_right_image: CameraFrame = CameraFrame()
    mode: ModeState


class ColorSegmentationSystem(Block[ColorSegmentationInputs, _Memory]):
    """Looks at both head images of one capture time, as often as the mode asks; else holds.

    port              dir  type              notes
    ----------------  ---  ----------------  -----------------
    head_left_image   in   CameraFrame
    head_right_image  in   CameraFrame
    mode              in   ModeState         how often to look
    segmentation      out  SegmentationPair

    reach: how far from the marker green marks are looked for, in lengths of its side.
    """

    OUTPUTS = {"segmentation": SegmentationPair}

    def __init__(
        self,
        config: ColorSegmentationConfig,
        name: str = "color_segmentation",
        period: float = 1 / 8,
        delay: float = 1 / 128,
        reach: float = 2.0,
    ):
        config.check()
        self._config, self._reach = config, max(reach, 2.0)
        super().__init__(name, period=period, slot=3, delay=delay)

    def initial(self) -> _Memory:
        return _Memory()

    def step(self, time: float, inputs: ColorSegmentationInputs, memory: _Memory) -> tuple[_Memory, Outputs]:
        state = inputs.mode
        every = state.head_every
        memory = dc.replace(memory, idle=memory.idle + 1)
        if every == 0 or memory.idle < every:
            return memory, {}
        left, right = inputs.head_left_image, inputs.head_right_image
        if left.sequence < 0 or right.sequence < 0 or left.time != right.time:
            return memory, {}
        if left.sequence == memory.sequence:
            return memory, {}
        follow = self._config.follow and not state.afresh and (memory.looks + 1) % self._config.full_every
        seen, boxes = [], []
        for frame, box in zip((left, right), memory.boxes):
            one, box = self._look(frame, box if follow else None)
            seen.append(one)
            boxes.append(box)
        pair = SegmentationPair(time=left.time, sequence=left.sequence, left=seen[0], right=seen[1])
        memory = _Memory(idle=0, sequence=left.sequence, looks=memory.looks + 1, boxes=(boxes[0], boxes[1]))
        return memory, {"segmentation": pair}

    def _look(self, frame: CameraFrame, box: _Box | None) -> tuple[Segmentation, _Box | None]:
        seen = segmented(frame, self._config, box)
        if box is not None and all(c.rejected for c in seen.candidates):
            seen = segmented(frame, self._config)
        accepted = [c for c in seen.candidates if not c.rejected]
        return seen, _around(accepted, frame.image.shape, self._reach)


def _around(accepted: list[MarkerCandidate], shape: tuple[int, ...], far: float) -> _Box | None:
    """A box with even corners round all candidates, wide enough for the green marks beside them.

    far: how far these are, in lengths of a candidate.
    """
    if not accepted:
        return None
    low, high = [10**6, 10**6], [0, 0]
    for c in accepted:
        size = (c.corners.max(0) - c.corners.min(0)).max()
        reach = far * size + 40
        for k in (0, 1):
            low[k] = min(low[k], int(c.center[k] - reach))
            high[k] = max(high[k], int(c.center[k] + reach))
    x, y = max(low[0], 0) // 2 * 2, max(low[1], 0) // 2 * 2
    width, height = (min(high[0], shape[1]) - x) // 2 * 2, (min(high[1], shape[0]) - y) // 2 * 2
    return (x, y, width, height) if min(width, height) >= 16 else None
