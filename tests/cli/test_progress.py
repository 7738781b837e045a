"""The bar for what takes long, and the shell's completion."""

import io
import subprocess
import sys
import time

import pytest

from fg_calib.cli import progress as shown
from fg_calib.progress import listening, tell


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def a_terminal(monkeypatch):
    """`a_terminal()`: stderr is one from then on; pytest would take its place again after a fixture."""

    def make(patience=0.05):
        stream = Terminal()
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setattr(shown, "PATIENCE", patience)
        return stream

    return make


def wait_for(words, terminal):
    """Until words are shown; a machine may be slow."""
    for _ in range(600):
        if words in terminal.getvalue():
            return
        time.sleep(0.05)
    pytest.fail(f"{words} is not shown")


def test_what_takes_long_is_shown_and_gone_when_it_is_done(a_terminal):
    terminal = a_terminal()
    with shown.progress():
        tell("calibrating", 1, 4)
        wait_for("calibrating", terminal)
    assert terminal.getvalue().endswith("\x1b[2K")  # the line is cleared


def test_what_is_quick_shows_nothing(a_terminal):
    terminal = a_terminal(patience=60.0)
    with shown.progress():
        tell("calibrating")
    assert terminal.getvalue() == ""


def test_nothing_is_shown_once_something_else_is_printed(a_terminal):
    terminal = a_terminal()
    with shown.progress():
        shown.hide_progress()
        time.sleep(0.2)
        tell("calibrating")
    assert terminal.getvalue() == ""


def test_names_do_not_steer_the_terminal(a_terminal):
    terminal = a_terminal()
    with shown.progress():
        tell("\x1b[2Jcalibrating")
        wait_for("calibrating", terminal)
    assert "\x1b[2J" not in terminal.getvalue()


def test_a_pipe_gets_no_bar(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(shown, "PATIENCE", 0.0)
    with shown.progress():
        time.sleep(0.1)
    assert stream.getvalue() == ""


@pytest.mark.slow
def test_folds_tell_how_far_they_are(example, fg_calib):
    heard = []
    with listening(lambda *told: heard.append(told)):
        assert fg_calib("calibrate", example / "calibration.yaml", "--folds", "3").code == 0
    assert [told[1:] for told in heard if "fold" in told[0]] == [(0, 3), (1, 3), (2, 3)]
    assert [told[0] for told in heard][:2] == ["calibrating", "judging the result"]


def test_nobody_has_to_listen():
    tell("calibrating")


@pytest.mark.slow
def test_shells_complete_commands():
    environment = {"_FG_CALIB_COMPLETE": "complete_bash", "COMP_WORDS": "fg-calib ca", "COMP_CWORD": "1"}
    code = "from fg_calib import cli; cli.main()"
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert ended.stdout.split() == ["calibrate"]
