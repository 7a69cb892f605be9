import errno
import os
import stat

import pytest

from sweeps.store import fsync
from tests.store.faults import refusing


def test_files_stay_as_they_were_if_one_can_not_be_written(tmp_path):
    (tmp_path / "a").write_bytes(b"before")
    with pytest.raises(FileNotFoundError):
        fsync.write({tmp_path / "a": b"after", tmp_path / "none" / "b": b"after"})
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a", b"before")]


def test_a_link_in_the_place_of_the_partial_file_is_not_followed(tmp_path):
    """`verify --repair` writes into a store from somebody else."""
    (tmp_path / "precious").write_bytes(b"before")
    (tmp_path / f"a{fsync.PARTIAL}").symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"):
        fsync.write({tmp_path / "a": b"after"})
    assert (tmp_path / "precious").read_bytes() == b"before"


@pytest.mark.parametrize(
    "number", [errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EACCES, errno.EBADF]
)
def test_a_file_system_without_fsync_of_folders_gets_a_warning(tmp_path, monkeypatch, number):
    """SMB and some FUSE file systems answer so."""
    fsync_of_files = os.fsync

    def of_files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            refusing(number)()
        fsync_of_files(descriptor)

    monkeypatch.setattr(os, "fsync", of_files_only)
    refused = rf"refuses fsync \({os.strerror(number)}\): a power cut may damage finished blocks"
    for act in (lambda: fsync.write({tmp_path / "a": b"after"}), lambda: fsync.sync(tmp_path)):
        with pytest.warns(RuntimeWarning, match=refused):
            act()
    assert (tmp_path / "a").read_bytes() == b"after"


def test_a_folder_that_may_not_be_listed_gets_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "open", refusing(errno.EACCES))
    with pytest.warns(RuntimeWarning, match="refuses fsync"):
        fsync.sync(tmp_path)


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_failed_fsync_is_an_error(tmp_path, monkeypatch, number):
    monkeypatch.setattr(os, "fsync", refusing(number))
    with pytest.raises(OSError, match=os.strerror(number)):
        fsync.write({tmp_path / "a": b"after"})
    assert not list(tmp_path.iterdir())
