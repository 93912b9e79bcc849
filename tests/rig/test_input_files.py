"""Input files are read completely, or rejected immediately."""

import os
from pathlib import Path

import pytest

from daq.extras.importing.channel_table import columns_of
from daq.extras.ni_server.serve import Certificates
from rig.core.base import input_files
from rig.core.base.errors import SceneError
from rig.core.base.input_files import read_file


def test_file_is_read_up_to_the_size_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    monkeypatch.setattr(input_files, "MAX_BYTES", 5)
    assert read_file(path) == b"12345"
    path.write_bytes(b"123456")
    with pytest.raises(OSError, match="larger than"):
        read_file(path)
    with pytest.raises(FileNotFoundError):
        read_file(tmp_path / "b")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_pipe_or_device_is_rejected_without_waiting(tmp_path: Path) -> None:
    pipe, link_to_device = tmp_path / "pipe.yaml", tmp_path / "zero.yaml"
    os.mkfifo(pipe)
    link_to_device.symlink_to("/dev/zero")
    for path in (pipe, link_to_device, tmp_path):
        for read in (columns_of, lambda path: Certificates(path, path).credentials()):
            with pytest.raises(SceneError, match=f"cannot read {path}: not a regular file"):
                read(path)
