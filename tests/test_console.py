"""Foreign text on the terminal: control sequences in logs, files and arguments are escaped."""

import io

from rich.table import Table

from valve_drake import cli
from valve_drake.console import console, printable, styled

HOSTILE = "a\x1b]0;title\x07\x1b[2J\r\n\x9b31m\u202eb\u2028c\x7f[bold red]d[/]:smile:"


def test_control_characters_are_shown_as_escapes():
    assert printable(HOSTILE) == (r"a\x1b]0;title\x07\x1b[2J\r\n\x9b31m\u202eb\u2028c\x7f[bold red]d[/]:smile:")
    assert printable("Größe 5 µm \u2009 日本") == "Größe 5 µm \u2009 日本"
    assert printable("name-\udcff.mcap") == r"name-\udcff.mcap"  # a file name that is not UTF-8
    printable("\ud800").encode()


def test_consoles_take_no_markup_and_no_sequence_from_texts_cells_and_styles():
    out = console()
    out.file, out.width = io.StringIO(), 300
    table = Table("mode", HOSTILE)
    table.add_row("x", HOSTILE)
    out.print(HOSTILE)
    out.print(table)
    out.print(styled((HOSTILE, "bold"), HOSTILE))
    text = out.file.getvalue()
    assert not set(text) & set("\x1b\x07\r\x9b\u202e\u2028\x7f")
    assert text.count("[bold red]d[/]:smile:") == 5
    assert len(text.splitlines()) == 1 + 5 + 1


def test_an_error_is_one_line_whatever_it_quotes(capsys):
    assert cli.main(["review", "no\nsuch\x1b[31m.mcap"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "\x1b" not in error and r"no\nsuch\x1b[31m.mcap" in error
