"""The documentation builds without a warning, and the commands on its pages run."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import ROOT

# What is run here, page by page; the others need hardware, a recording or minutes, and have tests of their own.
LONG = ("./cube demo", "./cube view", "./cube pictures", "./cube docs", "./cube exec", "./cube test", "./cube bench",
        "./cube record", "./cube replay", "./cube fem", "./cube paper", "./cube study", "./cube fit LOADS")  # fmt: skip
PAGES = ("start.md", "robot.md", "build.md", "calibrate.md")


def commands(page: Path) -> list[str]:
    """Lines of a page that call ./cube, without what follows a #."""
    return re.findall(r"^ {4,}(\./cube [^#\n]*?) *(?:#.*)?$", page.read_text(), re.MULTILINE)


def cube(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "cube_tensor_driver.cli", *arguments], cwd=folder, text=True,
                          capture_output=True, timeout=120, check=False)  # fmt: skip


def test_documentation_builds_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="needs sphinx: run this with ./cube test")
    done = cube(["docs", "-o", str(tmp_path / "html")], ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "html" / "index.html").is_file()
    api = (tmp_path / "html" / "api.html").read_text()
    assert "rest_frequency" in api and "contacts" in api


@pytest.mark.parametrize("page", PAGES)
def test_commands_of_a_page_run(page, tmp_path, domain):
    (tmp_path / "config").symlink_to(ROOT / "config")
    found = commands(ROOT / "docs" / page)
    assert found
    for command in found:
        arguments = shlex.split(command)[1:]
        measured = command.startswith("./cube demo") and "--duration" in arguments
        if measured or not command.startswith(LONG):
            done = cube(arguments, tmp_path)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_commands_of_every_page_are_ones_that_exist(page):
    """Every command and option of a page is one that the parser knows."""
    from cube_tensor_driver.cli import parser

    for command in commands(page):
        words = shlex.split(command)[1:]
        if words[0] in ("exec", "--help"):
            continue
        try:
            parser().parse_args([word for word in words if word != "…"])
        except SystemExit as error:
            pytest.fail(f"{page.name}: {command}: the parser ends with {error.code}")
