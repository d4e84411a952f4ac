# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Files appear complete or not at all, whoever else writes them at the same time."""

from __future__ import annotations

import os
import stat

import pytest

from cube_tensor_driver.config.output_files import check_writable, write_atomically
from cube_tensor_driver.core.errors import ConfigError


def test_each_of_two_writers_has_its_own_temporary_file(tmp_path):
    path = tmp_path / "tare.yaml"
    with write_atomically(path) as one:
        one.write_text("one" * 1000)
        with write_atomically(path) as other:
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "one" * 1000
    with pytest.raises(ZeroDivisionError), write_atomically(path) as failed:
        failed.write_text(f"{1 / 0}")
    check_writable(path)
    assert path.read_text() == "one" * 1000 and list(tmp_path.iterdir()) == [path]


def test_no_link_is_followed_and_permissions_are_those_of_any_new_file(tmp_path):
    path, victim = tmp_path / "tare.yaml", tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "tare.yaml.part").symlink_to(victim)
    with write_atomically(path) as temporary:
        temporary.write_text("new")
    assert victim.read_text() == "mine" and path.read_text() == "new"
    (tmp_path / "plain").touch()
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("plain", "tare.yaml")]
    assert modes[0] == modes[1]


def test_the_content_is_on_the_disk_before_the_name(tmp_path, monkeypatch):
    path, synced = tmp_path / "tare.yaml", []

    def fsync(number: int) -> None:
        synced.append((os.fstat(number).st_size, path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    with write_atomically(path) as temporary:
        temporary.write_text("content")
    assert synced == [(7, False)]


def test_what_cannot_be_written_is_one_line(tmp_path):
    for path in (tmp_path, tmp_path / "none" / "a", tmp_path / ("a" * 300)):
        with pytest.raises(ConfigError, match="name a file in a folder"):
            check_writable(path)
