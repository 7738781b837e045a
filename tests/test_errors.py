"""Messages are one printable line, whatever stands in the files that they are about."""

import logging
import subprocess
import sys

import pytest

from fg_calib.cli import output
from fg_calib.inputs import InputError, printable

ENEMY = "\x1b]0;title\x07 \u202eexe\n\ttab \ud800 \u2028 [/red]ü"


def test_what_no_terminal_should_get_is_escaped():
    assert printable(ENEMY) == r"\x1b]0;title\x07 \u202eexe tab \ud800 [/red]ü"
    assert printable("plain  text\n") == "plain text"


def test_every_part_of_a_message_is_printable_and_short():
    message = str(InputError(ENEMY, ENEMY * 100, ENEMY, ENEMY))
    assert message.isprintable()
    assert len(message) < 700
    assert message.startswith(r"\x1b]0;title\x07 \u202eexe tab \ud800 [/red]ü: \x1b]0;title\x07")


def test_findings_and_names_of_files_are_printable(capsys, tmp_path):
    with pytest.raises(output.typer.Exit):
        output.end([f"row {ENEMY} is wrong"])
    output.say_next(["a\x1b"], tmp_path / "b\x07")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.isprintable() for line in lines)
    assert lines[0] == r"not to be trusted: row \x1b]0;title\x07 \u202eexe tab \ud800 [/red]ü is wrong"


INTERRUPTED = """
import os, signal, sys
from fg_calib.cli import main
class Finder:
    def find_spec(self, name, *_):
        if name == "typer":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
main()
"""


def test_an_interruption_while_modules_are_imported_ends_in_silence():
    ended = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, b"", b"")


def test_warnings_are_printable(fg_calib, tmp_path, monkeypatch):
    """Also of a table whose own name has control characters."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    (tmp_path / "arm.yaml").write_text("convention: dh\njoints: [{a: 1, alpha: 0, d: 0, theta: 0}]\n")
    table = tmp_path / "q\x1b[2J.csv"
    table.write_text("q1,sigma_positon,x\n0,1,2\n")
    ended = fg_calib("observe", tmp_path / "arm.yaml", "--configurations", table)
    assert ended.code == 1
    warning, error = ended.err.splitlines()
    assert warning.startswith(r"q\x1b[2J.csv: column 'sigma_positon' is not used; ")
    assert error == r"error: q\x1b[2J.csv: no column y, expected x y z together"
