"""`valve-drake operator`: the desk from which an operator commands a robot by keys, words or voice."""

import argparse
import codecs
import contextlib
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from valve_drake import outputs
from valve_drake.checks import OperationFailed, require
from valve_drake.commands.common import FAILED, OK, Subcommands, signals
from valve_drake.console import console as make_console
from valve_drake.console import say

if TYPE_CHECKING:
    import numpy as np

    from valve_drake.operator.desk import Desk
    from valve_drake.operator.desk_link import DeskLink
    from valve_drake.operator.ear import Beside

FRAME = 0.1  # between two pictures [s]
POLL = 0.01  # between two looks at the wire [s]
ANSWER = 5.0  # for the robot's answer to one sentence [s]
GONE = 10.0  # a script gives a program up that was silent for longer [s]


def add(commands: Subcommands) -> None:
    p = commands.add_parser("operator", help="commands a robot by keys, words or voice (run --operator listens)")
    p.add_argument("scenario", nargs="?", help="for its bus: the one that is run (default: simulated.scenario.yaml)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument(
        "--say",
        action="append",
        default=[],
        metavar="TEXT",
        help='says it, e.g. "robot, open the valve"; may be repeated',
    )
    p.add_argument("--file", type=Path, metavar="FILE.wav", help="says what is recorded there, at its own speed")
    p.add_argument("--voice", choices=("microphone", "wire"), help="listens: to this machine, or to the bus's sound")
    p.add_argument(
        "--radio", action="store_true", help="with --file: puts the sound on the bus, and says nothing itself"
    )
    p.add_argument("--json", action="store_true", help="with --say or --file: print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake import scenario as scenarios
    from valve_drake.operator import ear
    from valve_drake.operator.desk import Desk
    from valve_drake.operator.desk_link import DeskLink
    from valve_drake.operator.grammar import LONGEST
    from valve_drake.stations.bus import Bus

    require(not options.radio or options.file is not None, "--radio", "given with --file", options.radio)
    for other in ("say", "voice", "json"):
        require(not (options.radio and getattr(options, other)), "--radio", f"given without --{other}", options.radio)
    for text in options.say:
        require(0 < len(text.strip()) and len(text) <= LONGEST, "--say", f"1 to {LONGEST} characters", text)
    scripted = bool(options.say) or options.file is not None
    require(scripted or not options.json, "--json", "given with --say or --file", True)
    require(scripted or sys.stdin.isatty(), "standard input", "a terminal, or --say or --file given", "none")
    scenario = scenarios.load(options.scenario, options.set)
    sound = ear.read_wav(options.file, "--file") if options.file is not None else None
    listens = options.voice is not None or (sound is not None and not options.radio)
    listener = ear.Beside(ear.recogniser()) if listens else None
    microphone = ear.Microphone() if options.voice == "microphone" else None
    link = DeskLink(Bus(scenario.hardware))
    if options.radio:
        assert sound is not None
        return _send(link, sound)
    desk = Desk(link, listener, send_sound=options.voice != "wire")
    alone = link.claim()
    while not alone():  # it listens and says nothing
        link.bus.pump()
        time.sleep(POLL)
    if options.voice == "wire":
        link.listen(desk.sound)

    def poll() -> None:
        for samples in microphone.ready() if microphone is not None else ():
            desk.sound(samples)
        desk.poll()

    try:
        return _script(desk, poll, options, sound, listener) if scripted else _sit(desk, poll)
    finally:
        if listener is not None:
            listener.close()
        link.leave()


# ---------------------------------------------------------------- at the terminal


def _sit(desk: "Desk", poll: Callable[[], None]) -> int:
    """The page, until the operator leaves. Ctrl-C is a stop, and leaves."""
    from rich.live import Live

    console = make_console()
    interrupted = [False]

    def handle(number: int) -> None:
        interrupted[0] = True

    with signals(handle), _keys() as keys, Live(console=console, screen=True, auto_refresh=False) as live:
        shown = 0.0
        while not desk.left:
            for key in keys(POLL):
                desk.press(key)
            poll()
            if interrupted[0]:
                _stop(desk, poll)
                break
            if time.monotonic() - shown >= FRAME:
                shown = time.monotonic()
                live.update(desk.shown(console.height), refresh=True)
    return OK


def _stop(desk: "Desk", poll: Callable[[], None]) -> None:
    """Says stop, and waits until it is heard."""
    from valve_drake.operator.grammar import Heard

    desk.say(Heard("stop", typed=True))
    end = time.monotonic() + 1.0
    while desk.link.waiting and time.monotonic() < end:
        poll()
        time.sleep(POLL)


@contextlib.contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """Keys of the terminal as they are pressed: keys(seconds) waits so long for some."""
    import termios
    import tty

    from valve_drake.operator.desk import keys_of

    decoder, rest = codecs.getincrementaldecoder("utf-8")("replace"), ""
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)

    def keys(seconds: float) -> str:
        nonlocal rest
        if not select.select([descriptor], [], [], seconds)[0]:
            return ""
        data = os.read(descriptor, 256)
        if not data:  # the terminal is gone
            raise OperationFailed("the terminal was closed")
        pressed, rest = keys_of(rest + decoder.decode(data))
        return pressed

    try:
        yield keys
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


# ---------------------------------------------------------------- scripts


def _send(link: "DeskLink", sound: "np.ndarray") -> int:
    """Puts sound on the bus at its own speed."""
    from valve_drake.operator.ear import PIECE, pieces
    from valve_drake.operator.wire import RATE

    begin = time.monotonic()
    for k, piece in enumerate(pieces(sound)):
        time.sleep(max(begin + (k + 1) * PIECE - time.monotonic(), 0.0))
        link.sound(piece)
    say(f"{len(sound) / RATE:.1f} s of sound were sent")
    return OK


def _script(
    desk: "Desk",
    poll: Callable[[], None],
    options: argparse.Namespace,
    sound: "np.ndarray | None",
    listener: "Beside | None",
) -> int:
    """Says all that was given, and waits for the end of a run that it began: whoever leaves loses the link.

    Exit 0: all was heard, nothing that --say says was refused, and the valve was turned if it was asked for.
    """
    from valve_drake.operator.desk import transcript
    from valve_drake.operator.ear import PIECE, pieces
    from valve_drake.operator.grammar import Heard
    from valve_drake.operator.wire import RATE

    stopped = [False]
    outcomes: list[str] = []
    told = 0

    def handle(number: int) -> None:
        stopped[0] = True

    def until(done: Callable[[], bool], seconds: float) -> bool:
        nonlocal told
        end = time.monotonic() + seconds
        while not done():
            poll()
            for line in transcript(desk.lines[told:]) if not options.json else ():
                say(line)
            told = len(desk.lines)
            if stopped[0]:
                _stop(desk, poll)
                raise OperationFailed("stopped by the operator")
            if time.monotonic() >= end:
                return False
            time.sleep(POLL)
        return True

    link = desk.link
    with signals(handle):
        if not until(lambda: link.commanding, ANSWER):
            silent = "no program listens (valve-drake run --operator)" + link.bus.excuse()
            who = "another operator commands" if link.linked else silent
            raise OperationFailed(f"the robot does not listen to this desk: {who}")
        for text in options.say:
            desk.say(Heard(text, typed=True))
            if not until(lambda: not link.waiting, ANSWER) or link.unheard:
                raise OperationFailed(f"the robot did not answer to {text}")
            outcomes.append(link.state.outcome)
        if sound is not None:
            begin = time.monotonic()
            for k, piece in enumerate(pieces(sound)):
                until(lambda due=begin + (k + 1) * PIECE: time.monotonic() >= due, 2 * PIECE)  # type: ignore[misc]
                desk.sound(piece)
            if listener is not None:
                until(lambda: not listener.busy, len(sound) / RATE + ANSWER)
            until(lambda: not link.waiting, ANSWER)
        until(lambda: False, 0.3)  # what the robot says last
        begun = link.commanding and link.state.task > 0
        if begun:
            until(lambda: link.state.done or link.silence > GONE or link.state.speaker != link.number, float("inf"))
            until(lambda: False, 4 * POLL)
    state = link.state
    refused = [outcome for outcome in outcomes if outcome in ("refused", "ignored")]
    good = not (refused or link.unheard) and link.commanding and not (begun and state.verdict != "turned")
    if options.json:
        said = [{"time_s": line.time, "who": line.who, "text": line.text} for line in desk.lines]
        facts = {"mode": state.mode, "done": state.done, "verdict": state.verdict, "reason": state.reason}
        print(outputs.json_text({"good": good, "said": said} | facts))
    return OK if good else FAILED
