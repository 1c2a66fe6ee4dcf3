"""Atomic writes, locked folders, bounded npz files, and disk errors of one line."""

import errno
import io
import os
import random
import re
import stat
import tracemalloc
import zipfile
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lidarpose.errors import InputError
from lidarpose.io import atomic
from lidarpose.io.atomic import LOCK, atomic_path, check_suffix, is_unused, locked, write_all_atomic, write_atomic
from lidarpose.io.files import file_error, read_bytes, read_json
from lidarpose.io.npz import read_npz
from lidarpose.io.point_cloud import read_points


def tree(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_read_json_detects_unicode_encoding(tmp_path, encoding):
    (tmp_path / "a.json").write_bytes('{"name": "Zoë"}'.encode(encoding))
    assert read_json(tmp_path / "a.json", expected="a name") == {"name": "Zoë"}


@settings(max_examples=30, deadline=None)
@given(data=st.binary() | st.text())
def test_write_atomic_round_trip(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("files")
    path = folder / "deep" / "er" / "a.json"
    for content in (b"the older content", data):
        write_atomic(path, content)
    assert path.read_bytes() == (data.encode() if isinstance(data, str) else data)
    assert tree(folder) == ["deep", "deep/er", "deep/er/a.json"]
    if data:
        assert read_bytes(path, expected="a test") == path.read_bytes()


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")
def test_write_atomic_uses_default_mode(tmp_path):
    write_atomic(tmp_path / "a.txt", "new")
    (tmp_path / "b.txt").write_text("plain")
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == stat.S_IMODE((tmp_path / "b.txt").stat().st_mode)


def test_write_all_atomic_puts_files_in_place_in_their_order(tmp_path, monkeypatch):
    replaced, replace = [], os.replace
    monkeypatch.setattr(
        os, "replace", lambda source, target: (replaced.append(os.path.basename(target)), replace(source, target))
    )
    write_all_atomic({tmp_path / name: name.encode() for name in ("scores.json", "a.png", "poses.parquet")})
    assert replaced == ["scores.json", "a.png", "poses.parquet"]


def test_atomic_path_keeps_suffix(tmp_path):
    path = tmp_path / "a.npz"
    with atomic_path(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".npz" and temporary != path
        np.savez(temporary, points=np.ones(3))
        assert not path.exists()
    assert np.load(path)["points"].tolist() == [1, 1, 1]
    assert tree(tmp_path) == ["a.npz"]


@pytest.mark.parametrize("name", ["a.txt", "a" * 250 + ".png", "点" * 84, "é" * 125 + ".png"])
def test_write_atomic_accepts_long_and_relative_names(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_atomic(name, b"x")
    assert tree(tmp_path) == [name] and (tmp_path / name).read_bytes() == b"x"


def test_atomic_path_temporary_names_are_unique(tmp_path, monkeypatch):
    """Also after a killed process with the same id, and with equal random seeds."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    for number in range(9):
        (tmp_path / f".1-{number}-a.txt").write_text("left")
    names = set()
    for _ in range(2):
        random.seed(0)
        with atomic_path(tmp_path / "a.txt") as temporary:
            names.add(temporary.name)
            temporary.write_text("new")
    assert len(names) == 2 and (tmp_path / "a.txt").read_text() == "new"
    assert all(re.fullmatch(atomic._TEMPORARY + "a.txt", name) for name in (*names, ".1-8-a.txt"))


def test_atomic_path_nested_calls_use_different_files(tmp_path):
    with atomic_path(tmp_path / "a.txt") as one, atomic_path(tmp_path / "a.txt") as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert (tmp_path / "a.txt").read_text() == "one"
    assert tree(tmp_path) == ["a.txt"]


@pytest.mark.parametrize(
    "error", [RuntimeError("boom"), KeyboardInterrupt(), SystemExit(1), OSError(errno.EIO, "far away")]
)
def test_atomic_path_failure_leaves_only_old_file(tmp_path, error):
    write_atomic(tmp_path / "a.txt", "old")
    for path in (tmp_path / "a.txt", tmp_path / "made" / "for" / "b.txt"):
        with pytest.raises(type(error)) as caught, atomic_path(path) as temporary:
            temporary.write_text("half of the n")
            raise error
        assert caught.value is error
    assert tree(tmp_path) == ["a.txt"] and (tmp_path / "a.txt").read_text() == "old"


def test_atomic_path_failure_keeps_folders_in_use(tmp_path):
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "made" / "a.txt") as temporary:
        (temporary.parent / "other.txt").write_text("mine")
        raise RuntimeError
    assert tree(tmp_path) == ["made", "made/other.txt"]


@pytest.mark.parametrize("number", ["ENOSPC", "EDQUOT", "EROFS"])
@pytest.mark.parametrize("call", ["mkdir", "open", "write", "fsync", "replace"])
def test_atomic_path_reports_disk_errors(tmp_path, monkeypatch, call, number):
    number = getattr(errno, number)
    error = OSError(number, os.strerror(number))

    def refuse(*_, **__):
        raise error

    if call == "mkdir":
        monkeypatch.setattr(atomic.Path, "mkdir", refuse)
    elif call != "write":
        monkeypatch.setattr(atomic.os, call, refuse)
    path = tmp_path / "made" / "a.txt"
    with pytest.raises(InputError) as caught, atomic_path(path):
        if call == "write":
            refuse()
    monkeypatch.undo()
    message = str(caught.value)
    assert message.isprintable() and str(path.parent) in message and os.strerror(number) in message
    assert any(word in message for word in ("free some", "read-only"))
    assert tree(tmp_path) == []


@pytest.mark.parametrize(
    "path, words",
    [
        ("a" * 300, "choose a shorter name"),
        ("", "^'': is a folder; give the name of a file"),
        ("~/a.txt", "~ was not replaced with the home folder; give the whole path"),
        ("~somebody/a.txt", "~somebody was not replaced"),
        (".", "is a folder; give the name of a file"),
        ("file/a.txt", "file .*is a file: choose another folder"),
        ("file/deeper/a.txt", "file/deeper .*is a file: choose another folder"),
        *((path, "expected the path of a file to write") for path in (3, None, "a\0b")),
    ],
)
def test_write_atomic_rejects_invalid_paths(tmp_path, monkeypatch, path, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=words) as caught:
        write_atomic(path, "x")
    assert "\n" not in str(caught.value) and tree(tmp_path) == ["file"]
    with pytest.raises(InputError, match="3: expected the path of a file to write"):
        check_suffix(3, ".png")


def test_write_atomic_accepts_an_existing_folder_that_begins_with_a_tilde(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "~old").mkdir()
    write_atomic("~old/a.txt", "x")
    write_atomic("./~new.txt", "x")
    assert tree(tmp_path) == ["~new.txt", "~old", "~old/a.txt"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_write_atomic_reports_missing_permission(tmp_path):
    tmp_path.chmod(0o500)
    for path in (tmp_path / "a.txt", tmp_path / "made" / "a.txt"):
        with pytest.raises(InputError, match="Permission denied.*choose another folder"):
            write_atomic(path, "x")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names are POSIX's")
def test_write_atomic_never_replaces_pipes(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="device or pipe"):
        write_atomic(tmp_path / "pipe", "x")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode) and tree(tmp_path) == ["pipe"]


@pytest.mark.skipif(os.name != "posix", reason="links need rights elsewhere")
def test_write_atomic_follows_links(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "a.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "there" / "a.txt")
    write_atomic(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "there" / "a.txt").read_text() == "new"


@pytest.mark.long
def test_read_npz_bounds_unpacked_size(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", zeros=np.zeros(2**24), ones=np.ones(3))
    arrays, names = read_npz(tmp_path / "a.npz", ["ones", "none"], expected="an npz")
    assert list(arrays) == ["ones"] and names == ["ones", "zeros"]
    with pytest.raises(InputError, match=r"a.npz: expected at most 67108864 bytes or 32 .*LIDARPOSE_MAX_UNPACKED=\d+$"):
        read_npz(tmp_path / "a.npz", ["zeros"], expected="an npz")
    monkeypatch.setenv("LIDARPOSE_MAX_UNPACKED", str(2**28))
    assert read_npz(tmp_path / "a.npz", ["zeros"], expected="an npz")[0]["zeros"].shape == (2**24,)


# offsets in the archive's directory of a member's sizes: 20 compressed, 24 uncompressed
@pytest.mark.parametrize("compression, field", [("DEFLATED", 24), ("DEFLATED", 20), ("BZIP2", 24), ("LZMA", 20)])
def test_read_npz_bounds_memory_if_sizes_are_wrong(tmp_path, monkeypatch, compression, field):
    array = io.BytesIO()
    monkeypatch.setenv("LIDARPOSE_MAX_UNPACKED", "1000000")
    np.save(array, np.zeros((2**20, 3)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", getattr(zipfile, f"ZIP_{compression}")) as archive:
        archive.writestr("points.npy", array.getvalue())
    content = bytearray((tmp_path / "a.npz").read_bytes())
    start = content.rfind(b"PK\x01\x02") + field
    content[start : start + 4] = (1000 if field == 24 else 2**31).to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(content)
    tracemalloc.start()
    try:
        for read in (lambda path: read_npz(path, ["points"], expected="an npz"), read_points):
            with pytest.raises(InputError, match="a.npz: expected"):
                read(tmp_path / "a.npz")
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_file_error_message_is_one_printable_line():
    message = str(file_error("a\nb\x1b[31m\udcff.pcd", "one\r\ntwo\tthree\x00"))
    assert message.isprintable() and message.encode()
    assert message.startswith("a b") and "one two" in message


def test_locked_allows_one_writer_and_removes_leftovers(tmp_path):
    folder, left = tmp_path / "new" / "out", ".0123456789abcdef-a.json"
    with locked(folder, r"a\.json", busy="somebody writes"):
        assert is_unused(folder, r"a\.json")
        with (
            pytest.raises(InputError, match="out: somebody writes$"),
            locked(folder, r"a\.json", busy="somebody writes"),
        ):
            pass
    # folders that were created and not used are removed
    assert not folder.parent.exists()
    (folder / "deep").mkdir(parents=True)
    for name in (left, f"deep/{left}", ".0123456789abcdef-b.json", LOCK):
        (folder / name).touch()
    with locked(folder, r"a\.json", busy=""):
        (folder / left).touch()
    assert tree(folder) == [".0123456789abcdef-b.json", "deep"] and not is_unused(folder, r"a\.json")


@pytest.mark.parametrize(
    "error, message", [(NotImplementedError(), None), (PermissionError(13, "no"), "cannot write into")]
)
def test_locked_if_lock_cannot_be_acquired(tmp_path, monkeypatch, error, message):
    filelock = pytest.importorskip("filelock")
    monkeypatch.setattr(filelock.FileLock, "acquire", mock.Mock(side_effect=error))
    if message is None:
        with locked(tmp_path / "out", "a", busy=""):
            (tmp_path / "out" / "a").touch()
        assert tree(tmp_path / "out") == ["a"]
    else:
        with pytest.raises(InputError, match=message), locked(tmp_path / "out", "a", busy=""):
            pass


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")
@pytest.mark.parametrize("mode", [0o600, 0o440])
def test_write_atomic_keeps_mode(tmp_path, mode):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(mode)
    with atomic_path(path) as temporary:
        # other users cannot read the temporary file
        assert not stat.S_IMODE(temporary.stat().st_mode) & 0o077
        temporary.write_text("half")
    write_atomic(path, "new")
    assert path.read_text() == "new" and stat.S_IMODE(path.stat().st_mode) == mode
