"""Text for the terminal: the one place where foreign text (of logs, files, arguments) is made harmless.

A log's topic or mode name may hold ESC sequences, line ends or rich's [tags]. `printable` shows control characters as
escapes; `console` makes rich consoles that read no markup and pass every text through `printable`. Own styles are
given as `styled(text, style)` or `style=`, never as markup.
"""

import sys
import unicodedata
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_UNSAFE = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))  # control, invisible format, half a pair, line and paragraph ends


class _Escapes(dict[int, str]):
    """Code point -> what stands for it, for str.translate."""

    def __missing__(self, point: int) -> str:
        character = chr(point)
        unsafe = unicodedata.category(character) in _UNSAFE
        self[point] = character.encode("unicode_escape").decode() if unsafe else character
        return self[point]


_ESCAPES: Mapping[int, str] = _Escapes()


def printable(text: object) -> str:
    """The text on one line, with every control character as an escape (ESC is shown as \\x1b, a line end as \\n)."""
    return str(text).translate(_ESCAPES)


def say(text: object) -> None:
    """One line on standard output."""
    print(printable(text))


def complain(text: object) -> None:
    """One line on standard error, in the program's name."""
    print(f"valve-drake: {printable(text)}", file=sys.stderr)


def console(stderr: bool = False) -> "Console":
    """A rich console for foreign text: no markup, no highlighting, no wrapped lines, control characters as escapes."""
    from rich.console import Console

    class Harmless(Console):
        def render_str(self, text: str, **options: Any) -> "Text":  # every text passes here, table cells too
            return super().render_str(printable(text), **options)

    return Harmless(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True)


def styled(*parts: str | tuple[str, str]) -> "Text":
    """Text in styles: each part plain, or (text, style)."""
    from rich.text import Text

    pairs = [part if isinstance(part, tuple) else (part, "") for part in parts]
    return Text.assemble(*((printable(text), style) for text, style in pairs))
