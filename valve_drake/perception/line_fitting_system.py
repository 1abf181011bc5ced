"""Block `line_fitting`: the marker's sub-pixel edges on ports. No mathematics here."""

from valve_drake.camera.lens import StereoHead
from valve_drake.messages import MarkerEdges, SegmentationPair
from valve_drake.perception.line_fitting import LineFittingConfig, fit_pair
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.ports import Block, Inputs, Outputs


class LineFittingInputs(Inputs):
    segmentation: SegmentationPair = SegmentationPair()


class LineFittingSystem(Block[LineFittingInputs, int]):
    """Fits the sides of the marker in every new pair of segmented images. Memory: the last sequence.

    port          dir  type              notes
    ------------  ---  ----------------  ---------------------------------------------------
    segmentation  in   SegmentationPair
    edges         out  MarkerEdges       of the pair of candidates that fits the marker best
    """

    OUTPUTS = {"edges": MarkerEdges}

    def __init__(
        self,
        config: LineFittingConfig,
        head: StereoHead,
        marker: Marker | None = None,
        matching: StereoPositioningConfig | None = None,
        name: str = "line_fitting",
        period: float = 1 / 8,
        delay: float = 2 / 128,
    ):
        self._config, self._head = config, head
        self._marker = marker or Marker()
        self._matching = matching or StereoPositioningConfig()
        for part in (self._config, self._marker, self._matching):
            part.check()
        super().__init__(name, period=period, slot=3, delay=delay)

    def initial(self) -> int:
        return -1

    def step(self, time: float, inputs: LineFittingInputs, memory: int) -> tuple[int, Outputs]:
        pair = inputs.segmentation
        if pair.sequence == memory:
            return memory, {}
        edges = fit_pair(pair, self._head, self._marker, self._config, self._matching)
        return pair.sequence, {"edges": edges}
