"""The task as one table: a row for each mode. Whoever needs to know something of a mode asks its row.

To add a mode: a member of `Mode` (messages.py), a row here, and a behaviour that owns it. The table in docs/README.md
is `document()`; a test keeps it current.

    idle -(open, close)-> search -> rough_approach -> fine_approach -> measure -> reach -> servo -> grasp -> turn
         -> release -> fold -> verify -> retreat -> done

A turn that is longer than one grasp reaches goes back from verify to measure, and so does one that the camera sees
elsewhere than the hands felt it; so does fold if nothing is turned yet and the run is not failing. A retreat before the
camera has decided goes back to verify.
"""

import dataclasses as dc
import math
import types
from collections.abc import Iterable, Mapping

from valve_drake.checks import ConfigError
from valve_drake.messages import Cause, Mode, Verdict

HOLD = "hold"  # instead of a block: nobody commands this group, it stands still
OPEN = "command_selector"  # instead of a block: the selector itself opens the hands
BEHAVIORS = ("valve_search", "base_approach", "kinematic_approach", "image_servo", "hybrid_rotation")

DECIDED = (Mode.RELEASE, Mode.FOLD, Mode.RETREAT)  # what follows them depends on the run
ANY = Cause.NONE  # in Row.retry: whatever the behaviour gives as its reason


@dc.dataclass(frozen=True)
class Retry:
    """What is tried after a failure, instead of giving up."""

    limit: str  # the key of supervisor.retries that says how often in a run
    times: int  # its default
    mode: Mode  # that is entered
    after_release: Mode | None = None  # if that is `release`: where it leads


@dc.dataclass(frozen=True)
class Row:
    """One mode.

    mode: its name. what: it is about, for people.
    owner: the block whose Status, carrying this activation's number, ends the mode; "": none does.
    base, torso, hands, grippers: who commands these joints: a block, HOLD, or OPEN; grippers "": as the hands.
    next: the mode after the owner has succeeded; None: the supervisor decides (release, fold and retreat end
        differently when the run is failing), or the mode is final.
    deadline: default of supervisor.deadline [s]; infinite: it has none.
    contact: the hands are at the handles; a fault or a stop lets go of the valve first.
    watched: valve_search may end it because the marker is lost.
    fixed: valve_search may end it because the valve is no longer where it was measured.
    ending: on the way off the valve; the run's own deadline does not cut it short.
    final: the run is over.
    head_every, wrist_every: perception looks at every n-th image of the head's or of the wrists' cameras; 0: at none.
        Defaults of supervisor.head_every and supervisor.wrist_every.
    afresh: perception forgets what it followed from image to image, and looks for the marker everywhere.
    retry: what is tried when the mode fails, by its cause or verdict; see `retry_of`.
    off: where a run that gives up in this mode goes.
    """

    mode: Mode
    what: str = ""
    owner: str = ""
    base: str = HOLD
    torso: str = "valve_search"
    hands: str = HOLD
    grippers: str = ""
    next: Mode | None = None
    deadline: float = math.inf
    contact: bool = False
    watched: bool = False
    fixed: bool = False
    ending: bool = False
    final: bool = False
    head_every: int = 0
    wrist_every: int = 0
    afresh: bool = False
    retry: Mapping[str, Retry] = dc.field(default_factory=dict)
    off: Mode = Mode.FAILED

    def source(self, group: str) -> str:
        """Who commands a group of joints: base, torso, {side}_arm or {side}_gripper."""
        if group in ("base", "torso"):
            commander: str = getattr(self, group)
            return commander
        return self.grippers or self.hands if group.endswith("gripper") else self.hands

    def retry_of(self, cause: str, verdict: str) -> Retry | None:
        """What is tried after a failure with this cause and verdict; None: nothing."""
        for key in (cause, verdict):
            if key and key in self.retry:
                return self.retry[key]
        return self.retry.get(ANY)


_SEARCH_AGAIN: dict[str, Retry] = {Verdict.MARKER_LOST: Retry("marker_lost", 2, Mode.SEARCH)}

ROWS = (
    Row(Mode.IDLE, "waits for the operator", hands="kinematic_approach"),
    Row(
        Mode.SEARCH,
        "head, waist and base sweep until both cameras agree on a marker",
        owner="valve_search",
        base="valve_search",
        hands="kinematic_approach",
        next=Mode.ROUGH_APPROACH,
        deadline=60.0,
        head_every=1,
        afresh=True,
    ),
    Row(
        Mode.ROUGH_APPROACH,
        "drives towards the marker's centre (stage 1) to within 2 m",
        owner="base_approach",
        base="base_approach",
        hands="kinematic_approach",
        next=Mode.FINE_APPROACH,
        deadline=30.0,
        watched=True,
        head_every=4,  # odometry is good for half a second
        retry=_SEARCH_AGAIN,
    ),
    Row(
        Mode.FINE_APPROACH,
        "drives by the marker's pose (stage 2) to a stance found by inverse kinematics over the whole turn",
        owner="base_approach",
        base="base_approach",
        hands="kinematic_approach",
        next=Mode.MEASURE,
        deadline=45.0,
        watched=True,
        head_every=3,
        retry=_SEARCH_AGAIN,
    ),
    Row(
        Mode.MEASURE,
        "several estimates at rest, fused; the grasps are planned",
        owner="kinematic_approach",
        hands="kinematic_approach",
        next=Mode.REACH,
        deadline=6.0,
        watched=True,
        head_every=1,
        retry=_SEARCH_AGAIN | {Cause.STANCE: Retry("measure", 2, Mode.FINE_APPROACH)},
    ),
    Row(
        Mode.REACH,
        "a collision-free path of both arms to the stand-off along the wrist cameras' view; wrist sensors tared",
        owner="kinematic_approach",
        hands="kinematic_approach",
        next=Mode.SERVO,
        deadline=20.0,
        fixed=True,
        head_every=8,  # a valve that was moved is noticed within two seconds
        wrist_every=4,
        retry={Cause.MOVED: Retry("moved", 2, Mode.FOLD)},
        off=Mode.FOLD,
    ),
    Row(
        Mode.SERVO,
        "both hands onto the taught images of the green marks (stage 4)",
        owner="image_servo",
        hands="image_servo",
        next=Mode.GRASP,
        deadline=20.0,
        contact=True,
        fixed=True,
        head_every=8,
        wrist_every=1,
        retry={
            Cause.MOVED: Retry("moved", 2, Mode.RELEASE, after_release=Mode.FOLD),
            ANY: Retry("servo", 2, Mode.REACH),
        },
        off=Mode.RELEASE,
    ),
    Row(
        Mode.GRASP,
        "fingers close while the arms yield; proved by opening, force and a tug",
        owner="hybrid_rotation",
        hands="hybrid_rotation",
        next=Mode.TURN,
        deadline=12.0,
        contact=True,
        head_every=16,
        wrist_every=16,
        # the handle is not where it was measured, or the mark is not where the handle is: the head looks again
        retry={Verdict.GRASP_MISSED: Retry("grasp", 2, Mode.RELEASE, after_release=Mode.FOLD)},
        off=Mode.RELEASE,
    ),
    Row(
        Mode.TURN,
        "both hands turn the valve (stage 5)",
        owner="hybrid_rotation",
        hands="hybrid_rotation",
        next=Mode.RELEASE,
        deadline=60.0,
        contact=True,
        head_every=16,
        retry={  # the camera looks how far it is, and both hands grasp afresh
            Verdict.REACH_LIMIT: Retry("turn", 3, Mode.RELEASE, after_release=Mode.FOLD),
            Verdict.SLIP: Retry("slip", 2, Mode.RELEASE, after_release=Mode.FOLD),
        },
        off=Mode.RELEASE,
    ),
    Row(
        Mode.RELEASE,
        "wrenches bled, fingers opened, hands drawn back",
        owner="hybrid_rotation",
        hands="hybrid_rotation",
        deadline=8.0,
        ending=True,
        head_every=16,
    ),
    Row(
        Mode.FOLD,
        "both arms home along a collision-free path, out of the cameras' view",
        owner="kinematic_approach",
        hands="kinematic_approach",
        deadline=15.0,
        ending=True,
        head_every=16,
        off=Mode.RETREAT,
    ),
    Row(
        Mode.VERIFY,
        "the head looks until the valve stands still: the camera decides `turned`",
        owner="kinematic_approach",
        hands="kinematic_approach",
        next=Mode.RETREAT,
        deadline=12.0,
        ending=True,
        head_every=2,
        retry={
            Cause.REGRASP: Retry("regrasp", 12, Mode.MEASURE),
            Cause.UNSEEN: Retry("unseen", 1, Mode.RETREAT),  # and looks from there
            Verdict.SLIP: Retry("short", 2, Mode.MEASURE),  # the rest is turned, wherever the angle was lost
        },
        off=Mode.RETREAT,
    ),
    Row(
        Mode.RETREAT,
        "back by half a metre",
        owner="base_approach",
        base="base_approach",
        hands="kinematic_approach",
        deadline=15.0,
        ending=True,
        head_every=16,
    ),
    Row(Mode.DONE, "the camera has seen the commanded angle", torso=HOLD, final=True),
    Row(Mode.FAILED, "the run has ended with another verdict", torso=HOLD, grippers=OPEN, final=True),
    Row(Mode.STOPPED, "the operator has stopped the run", torso=HOLD, grippers=OPEN, final=True),
)


def checked(rows: Iterable[Row]) -> dict[Mode, Row]:
    """The rows by mode. Raises ConfigError: a mode without a row or with two, an unknown block, a way that leads
    nowhere, retries that disagree."""
    table: dict[Mode, Row] = {}
    limits: dict[str, int] = {}
    for row in rows:
        where = f"task/modes.py: the row of {row.mode.value}"
        if row.mode in table:
            raise ConfigError(f"task/modes.py: mode {row.mode.value} has two rows")
        table[row.mode] = row
        for key in ("owner", "base", "torso", "hands", "grippers"):
            block = getattr(row, key)
            others = {"owner": ("",), "grippers": ("", HOLD, OPEN)}.get(key, (HOLD,))
            if block not in (*BEHAVIORS, *others):
                raise ConfigError(f"{where}: {key} must be one of {', '.join(BEHAVIORS)}, got {block!r}")
        bounded = 0 < row.deadline < math.inf
        if bool(row.owner) != bounded:
            raise ConfigError(f"{where}: a mode with an owner has a deadline, and no other; got {row.deadline}")
        if row.owner and row.next is None and row.mode not in DECIDED:
            decided = ", ".join(mode.value for mode in DECIDED)
            raise ConfigError(f"{where}: next must be a mode, which only {decided} leave to the supervisor")
        unknown = [key for key in row.retry if key not in (*Cause, *Verdict)]
        if unknown:
            raise ConfigError(f"{where}: retry must be by a cause or a verdict, got {unknown[0]!r}")
        if row.final and (row.owner or row.next or row.retry):
            raise ConfigError(f"{where}: a final mode has no owner and leads nowhere")
        if row.contact and row.off != Mode.RELEASE:
            raise ConfigError(f"{where}: off must be release while the hands are at the handles, got {row.off.value}")
        for retry in row.retry.values():
            if limits.setdefault(retry.limit, retry.times) != retry.times:
                raise ConfigError(f"{where}: retries of {retry.limit} must be {limits[retry.limit]}, got {retry.times}")
            if (retry.mode == Mode.RELEASE) != (retry.after_release is not None):
                raise ConfigError(f"{where}: after_release goes with a retry by release, and with no other")
    missing = [mode.value for mode in Mode if mode not in table]
    if missing:
        raise ConfigError(f"task/modes.py: mode {', '.join(missing)} has no row")
    return table


TABLE: Mapping[Mode, Row] = types.MappingProxyType(checked(ROWS))

TERMINAL = tuple(mode for mode, row in TABLE.items() if row.final)
RUNNING = tuple(mode for mode, row in TABLE.items() if row.owner)
FIXED = tuple(mode for mode, row in TABLE.items() if row.fixed)
WATCHED = tuple(mode for mode, row in TABLE.items() if row.watched)
DEADLINES = {mode.value: TABLE[mode].deadline for mode in RUNNING}  # [s]
MODES = tuple(mode.value for mode in Mode)
HEAD_EVERY = {mode.value: row.head_every for mode, row in TABLE.items()}
WRIST_EVERY = {mode.value: row.wrist_every for mode, row in TABLE.items()}
RETRIES = {retry.limit: retry.times for row in ROWS for retry in row.retry.values()}


def owned(block: str) -> tuple[Mode, ...]:
    """The modes that a block owns."""
    return tuple(mode for mode, row in TABLE.items() if row.owner == block)


def document() -> str:
    """The table in Markdown, for docs/README.md."""
    lines = ["| mode | owner | what happens | deadline | tried again |", "|---|---|---|---|---|"]
    for mode in RUNNING:
        row = TABLE[mode]
        again = "; ".join(
            f"{cause or 'any failure'} -> {retry.mode.value}"
            + (f", {retry.after_release.value}" if retry.after_release else "")
            for cause, retry in row.retry.items()
        )
        lines.append(f"| {mode.value} | {row.owner} | {row.what} | {row.deadline:g} s | {again} |")
    return "\n".join(lines) + "\n"
