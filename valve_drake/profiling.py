"""Where a run's processor time goes, so that whatever becomes dearer is named.

    with profiling.measure() as profile:
        with profiling.advance():
            simulator.AdvanceTo(1.0)  # blocks and recorder report to the profile that is open in their thread
    spent = profile.spent()

The parts of an advance are read off the wall's clock, which takes a tenth of the time that the processor's takes, and
scaled to the processor time of the thread that advances: on a busy machine it is taken off the processor in the middle
of them all alike. What waits is left out of both. Nothing of this reaches the log.
"""

import collections
import contextlib
import contextvars
import dataclasses as dc
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any

STAGE, PLANT, LOGGING, IMAGES, WAITING = "stages", "plant", "logging", "images", "waiting"  # kinds of work
START_UP, ADVANCES, END = "start-up", "advances", "end"  # phases of a run


@dc.dataclass(frozen=True)
class Spent:
    """Processor seconds of a run, of all its processes; each is counted once."""

    imports: float  # of the process, before the run: interpreter, imports, reading the scenario
    start_up: float  # until the first step, without the renderers'
    renderers_start_up: float  # until they could make images
    plant: float | None  # None where there is none: station `hardware`
    framework: float  # Drake's events, state copies and ports
    stages: dict[str, float]  # by block, the station's too
    images: float  # fetching and decoding them
    logging: float  # the recorder, and the thread that writes
    rendering: float  # in the renderers
    other: float  # beside the advances: threads of the views, display, link
    end: float  # completing the log, its numbers, the 3D recording
    waited: float  # for images and the plant [s, wall]: no processor time

    def parts(self) -> dict[str, float]:
        """Processor seconds by kind of work, the stages as one."""
        parts = {field.name: getattr(self, field.name) for field in dc.fields(self) if field.name != "waited"}
        parts["stages"] = sum(self.stages.values())
        if self.plant is None:
            del parts["plant"]
        return {name.replace("_", " "): seconds for name, seconds in parts.items()}

    @property
    def total(self) -> float:
        """All of it."""
        return sum(self.parts().values())

    def as_json(self) -> dict[str, Any]:
        """What `run --json` says of it, the dearest block first."""
        out: dict[str, Any] = {field.name: getattr(self, field.name) for field in dc.fields(self)}
        out["stages"] = dict(sorted(self.stages.items(), key=lambda item: -item[1]))
        return _rounded({**out, "total": self.total})


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    return None if value is None else round(value, 4)


class Profile:
    """The clocks of one run, in the thread that advances it; begun when it is made."""

    def __init__(self) -> None:
        self.seconds: dict[tuple[str, str], float] = collections.defaultdict(float)  # kind, part -> [s, wall]
        self._stack: list[tuple[tuple[str, str], float]] = []  # what is being done, since when
        self._inner: list[float] = []  # seconds of the work inside each
        self._wall = self._processor = 0.0  # of all advances
        self._phases: dict[str, float] = {}
        self._marked = time.process_time()
        # Processor time, told by others [s].
        self.imports = self.renderers_start_up = self.rendering = self.writing = self.plant_beside = 0.0

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        now = time.perf_counter()
        label, start = self._stack.pop()
        self.seconds[label] += now - start - self._inner.pop()
        if self._inner:
            self._inner[-1] += now - start

    def work(self, label: tuple[str, str]) -> "Profile":
        """Counts a with statement's time; what is counted inside is taken off it."""
        self._stack.append((label, time.perf_counter()))
        self._inner.append(0.0)
        return self

    def ends(self, phase: str) -> None:
        """The processor time since the last phase ended was of this one: START_UP, ADVANCES or END."""
        now = time.process_time()
        self._phases[phase], self._marked = now - self._marked, now

    @contextlib.contextmanager
    def advance(self) -> Iterator[None]:
        """Where Drake advances the diagram."""
        wall, processor = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            self._processor += time.thread_time() - processor
            self._wall += time.perf_counter() - wall

    def spent(self) -> Spent:
        """The account so far."""
        start_up, advances, end = (self._phases.get(phase, 0.0) for phase in (START_UP, ADVANCES, END))
        waited = self._of(WAITING)
        scale = self._processor / max(self._wall - waited, 1e-9)
        stages = {part: scale * s for (kind, part), s in self.seconds.items() if kind == STAGE}
        images, logging, plant = (scale * self._of(kind) for kind in (IMAGES, LOGGING, PLANT))
        return Spent(
            imports=self.imports,
            start_up=start_up,
            renderers_start_up=self.renderers_start_up,
            plant=plant + self.plant_beside or None,
            framework=self._processor - sum(stages.values()) - images - logging - plant,
            stages=stages,
            images=images,
            logging=logging + self.writing,
            rendering=self.rendering,
            other=max(advances - self._processor - self.writing, 0.0),
            end=end,
            waited=waited,
        )

    def _of(self, kind: str) -> float:
        return sum(seconds for (other, _), seconds in self.seconds.items() if other == kind)


_open: contextvars.ContextVar[Profile | None] = contextvars.ContextVar("profile", default=None)
_OFF = contextlib.nullcontext()


@contextlib.contextmanager
def measure() -> Iterator[Profile]:
    """Opens a profile for this thread."""
    profile = Profile()
    token = _open.set(profile)
    try:
        yield profile
    finally:
        _open.reset(token)


def work(kind: str, part: str = "") -> contextlib.AbstractContextManager[None]:
    """Counts a with statement's time in the profile that is open in this thread, if one is."""
    profile = _open.get()
    return _OFF if profile is None else profile.work((kind, part))


def advance() -> contextlib.AbstractContextManager[None]:
    """`Profile.advance` of the profile that is open in this thread, if one is."""
    profile = _open.get()
    return _OFF if profile is None else profile.advance()
