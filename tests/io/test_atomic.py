"""Files are read or refused in one line; they appear whole or not at all, and nothing of others is replaced."""

import os

import pytest
from refusals import refusal

from fg_calib import InputError
from fg_calib.io.atomic import fill_folder, read_bytes, require_absent, require_own, require_writable, write_text

OWN = {"result": b"of ours", "table": b"", "page": b""}


def write(text, names=("table", "result")):
    return dict.fromkeys(names, f"of ours: {text}")


def content(folder):
    return {file.name: file.read_text().removeprefix("of ours: ") for file in folder.iterdir()}


def test_files_appear_together_and_those_of_an_earlier_time_are_removed(tmp_path):
    folder = tmp_path / "a" / "b"
    fill_folder(folder, write("old", OWN), OWN)
    assert content(folder) == dict.fromkeys(OWN, "old")
    fill_folder(folder, write("new"), OWN)
    assert content(folder) == {"table": "new", "result": "new"}


def test_the_file_that_holds_digests_of_the_others_is_moved_last(tmp_path, monkeypatch):
    fill_folder(tmp_path, write("old"), OWN)
    replace = os.replace

    def interrupted(source, target):
        if os.path.basename(target) == "result":
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fill_folder(tmp_path, write("new"), OWN)
    assert content(tmp_path) == {"table": "new", "result": "old"}


@pytest.mark.parametrize("own", [None, OWN])
def test_a_failure_leaves_nothing_and_no_folder(tmp_path, own):
    def fail(path):
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"b: cannot be written: No space left on device, expected a folder that can"):
        fill_folder(tmp_path / "a" / "b", {"table": "new", "result": fail}, own)
    assert [*tmp_path.iterdir()] == []


def test_a_folder_that_cannot_be_written_is_one_line_and_leaves_no_trace(tmp_path):
    require_writable(tmp_path / "a" / "b")
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "file").write_text("")
    for folder in ("file", "file/b", "a\0b"):
        with pytest.raises(InputError, match=r"cannot be written: .*, expected a folder that can be"):
            require_writable(tmp_path / folder)


@pytest.mark.parametrize(("make", "message"), [
    (lambda path: path.write_text("mine"), "is there already, not written by this command, expected another folder"),
    (lambda path: path.mkdir(), "is no file, expected a place for a file"),
    (lambda path: path.symlink_to("nowhere"), "is no file, expected a place for a file"),
])  # fmt: skip
def test_what_others_wrote_is_not_replaced(tmp_path, make, message):
    path = tmp_path / "table"
    make(path)
    for attempt in (lambda: require_own(tmp_path, OWN), lambda: fill_folder(tmp_path, write("new"), OWN)):
        assert refusal(attempt) == f"{path}: {message}"
    with pytest.raises(InputError, match="table: is there already, expected a folder without it"):
        require_absent(tmp_path, ["table"])
    assert [file.name for file in tmp_path.iterdir()] == ["table"]


def test_a_text_is_written_whole_or_not_at_all(tmp_path):
    write_text(tmp_path / "a", "old")
    with pytest.raises(UnicodeEncodeError):
        write_text(tmp_path / "a", "\udc00")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("a", "old")]
    with pytest.raises(InputError, match=r"b: there is no folder .*none$"):
        write_text(tmp_path / "none" / "b", "")


@pytest.mark.parametrize(("make", "message"), [
    (lambda folder: folder / "nothing", "nothing: no such file"),
    (lambda folder: folder, ": is a folder, expected a file"),
    (lambda folder: folder / ("x" * 5000), "cannot be read: File name too long, expected a file"),
    (lambda folder: folder / "a\0b", "cannot be read: "),
    (lambda folder: os.mkfifo(folder / "pipe") or folder / "pipe", "pipe: is a pipe or a device, expected a file"),
])  # fmt: skip
def test_what_is_no_file_is_one_line(tmp_path, make, message):
    error = refusal(read_bytes, make(tmp_path))
    assert message in error
    assert len(error) < 600
