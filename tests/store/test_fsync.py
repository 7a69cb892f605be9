import pytest

from sweeps.store import fsync


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
