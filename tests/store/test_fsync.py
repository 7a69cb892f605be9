import pytest

from sweeps.store import fsync


def test_files_stay_as_they_were_if_one_can_not_be_written(tmp_path):
    (tmp_path / "a").write_bytes(b"before")
    with pytest.raises(FileNotFoundError):
        fsync.write({tmp_path / "a": b"after", tmp_path / "none" / "b": b"after"})
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a", b"before")]
