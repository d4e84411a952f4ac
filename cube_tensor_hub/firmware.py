# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Build of the firmware, and a hub that QEMU emulates."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
from pathlib import Path

from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.processes.children import end_with_parent

PACKAGES = {
    "make": "make",
    "cc": "gcc",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
"""Program that builds or runs the firmware -> Debian packages that contain it."""

MACHINE = "mps2-an386"
"""Name of the board (Cortex-M4) that QEMU emulates, as its option -M takes it."""

ANY_ADDRESS = ("127.0.0.1", 0)
"""TCP address of this machine with port 0, for which the kernel chooses a free port."""

MAX_END_S = 2.0
"""Longest time, in seconds, from the signal SIGTERM to the end of QEMU; after it QEMU is killed."""


class FirmwareError(CubeError):
    """The firmware cannot be built or run on this machine; the text names what is missing."""


def find_missing(*programs: str) -> str:
    """Return the command that installs the programs that are missing, empty if none is."""
    packages = " ".join(PACKAGES[name] for name in programs if shutil.which(name) is None)
    return f"apt-get install --no-install-recommends {packages}" if packages else ""


def need(what: str, *programs: str) -> None:
    """Check that programs are installed.

    Args:
        what: What needs them, for the error message.
        programs: Their names.

    Raises:
        FirmwareError: One is missing.
    """
    absent = [name for name in programs if shutil.which(name) is None]
    if absent:
        raise FirmwareError(f"{what} needs {', '.join(absent)}: {find_missing(*absent)}")


def build(source: Path, out: Path, target: str) -> str:
    """Make a target of the Makefile of the firmware.

    Args:
        source: Folder firmware/ of a checkout.
        out: Folder for the results.
        target: Name of the target.

    Returns:
        What make printed.

    Raises:
        FirmwareError: A program is missing, or the compiler failed.
    """
    if not (source / "Makefile").is_file():
        raise FirmwareError(f"{source}: no Makefile; the firmware is built in a checkout")
    compiler = "cc" if target == "posix" else "arm-none-eabi-gcc"
    need(f"the build of {target}", "make", compiler)
    command = ["make", "--no-print-directory", "-C", str(source), f"OUT={out}", target]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise FirmwareError(f"make {target} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


class Emulator:
    """A hub that QEMU emulates; a context manager.

    Attributes:
        port: Port of the hub, as in a skin file.
        pads: Socket of the line over which the hub asks for captures of its pads.
    """

    def __init__(
        self,
        image: Path,
        address: tuple[str, int] = ANY_ADDRESS,
    ) -> None:
        """Prepare the hub.

        Args:
            image: The firmware.
            address: Address at which the line of the hub appears.

        Raises:
            FirmwareError: QEMU is not installed.
        """
        need("the emulated hub", "qemu-system-arm")
        self._image, self._address = image, address

    def __enter__(self) -> Emulator:
        # QEMU gets sockets that listen already, so that nobody else takes the ports in between.
        with _open_listener(self._address) as host, _open_listener(ANY_ADDRESS) as pads:
            self.port = "socket://{}:{}".format(*host.getsockname())
            command = [*end_with_parent(), "qemu-system-arm"]
            command += ["-M", MACHINE, "-kernel", str(self._image)]
            command += ["-display", "none", "-monitor", "none"]
            for name, listener in (("host", host), ("pads", pads)):
                line = f"socket,id={name},fd={listener.fileno()},server=on,wait=off,nodelay=on"
                command += ["-chardev", line, "-serial", f"chardev:{name}"]
            self._process = subprocess.Popen(
                command,
                pass_fds=(host.fileno(), pads.fileno()),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
            self.pads = socket.create_connection(pads.getsockname())
        # Each question and answer is a small packet, which must not wait for more.
        self.pads.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self

    def check(self) -> None:
        """Raise FirmwareError if QEMU has ended by itself."""
        if self._process.poll() is not None and self._process.stderr is not None:
            said = self._process.stderr.read().strip()
            raise FirmwareError(f"QEMU ended with code {self._process.returncode}: {said}")

    def __exit__(self, *_: object) -> None:
        # A shutdown ends a `recv` of another thread, closing does not.
        with contextlib.suppress(OSError):
            self.pads.shutdown(socket.SHUT_RDWR)
        self.pads.close()
        self._process.terminate()
        try:
            self._process.wait(MAX_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()


def _open_listener(address: tuple[str, int]) -> socket.socket:
    """Return a socket that listens; FirmwareError: the address cannot be had."""
    try:
        return socket.create_server(address, backlog=1)
    except OSError as error:
        host, port = address
        raise FirmwareError(
            f"{host}:{port}: {error.strerror}; name an address that is free here"
        ) from None
