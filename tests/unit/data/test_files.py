"""Files are written whole or not at all, and through no link that somebody planted."""

import os
import signal

import pytest

from herglotz.data.files import folder_at, read_bytes, remove_leftovers, write_atomically
from herglotz.errors import InputError


def test_a_planted_link_is_not_written_through(tmp_path):
    # fails if the temporary name can be foretold and a link of that name is followed
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for name in (f".out.{os.getpid()}.tmp", ".out.tmp"):
        (tmp_path / name).symlink_to(victim)
    write_atomically(tmp_path / "out", b"content")
    assert (tmp_path / "out").read_bytes() == b"content"
    assert victim.read_text() == "mine"


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    # fails if a full disk loses the file that was there, or a temporary file stays
    path = tmp_path / "out"
    write_atomically(path, b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"out: cannot be written \(No space left on device\); make room on its disk"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [x.name for x in tmp_path.iterdir()] == ["out"]


def test_permissions_are_those_of_any_new_file(tmp_path):
    # fails if a file is left private, as temporary files are
    write_atomically(tmp_path / "out", b"content")
    (tmp_path / "plain").write_bytes(b"content")
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_what_a_killed_writer_leaves_is_removed(tmp_path, monkeypatch):
    # fails if the names that are looked for are not those of the writer, or another file of the folder goes
    (tmp_path / ".out.tmp").write_text("mine")
    (tmp_path / ".output.abcdefgh.tmp").write_text("of another file")
    write_atomically(tmp_path / "out", b"whole")
    child = os.fork()
    if not child:
        monkeypatch.setattr(os, "fsync", lambda _: os.kill(os.getpid(), signal.SIGKILL))
        write_atomically(tmp_path / "out", b"half")
    os.waitpid(child, 0)
    assert len(list(tmp_path.iterdir())) == 4
    remove_leftovers(tmp_path, ["out", "none"])
    assert sorted(x.name for x in tmp_path.iterdir()) == [".out.tmp", ".output.abcdefgh.tmp", "out"]
    assert (tmp_path / "out").read_bytes() == b"whole"


def test_a_device_is_said_once():
    # fails if a message stands inside another one
    with pytest.raises(InputError, match=r"^/dev/zero: is a pipe or a device, not a file; save its output to a file"):
        read_bytes("/dev/zero")


def test_a_folder_is_made_or_refused(tmp_path):  # fails if a file in the way is a traceback, or parents are not made
    assert folder_at(tmp_path / "a" / "b").is_dir()
    assert folder_at(tmp_path / "a") == tmp_path / "a"
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"file/b: cannot be made \(Not a directory\); choose another folder"):
        folder_at(tmp_path / "file" / "b")
