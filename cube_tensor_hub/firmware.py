"""The firmware: what builds it, and the hub that QEMU runs."""

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
"""Program -> Debian packages that have it."""
MACHINE = "mps2-an386"
ANY_ADDRESS = ("127.0.0.1", 0)
END_S = 2.0


class FirmwareError(CubeError):
    """The firmware cannot be built or run here; the text names what is missing."""


def missing(*programs: str) -> str:
    """How to install those of the programs that are not there, "" if all are."""
    packages = " ".join(PACKAGES[name] for name in programs if shutil.which(name) is None)
    return f"apt-get install --no-install-recommends {packages}" if packages else ""


def need(what: str, *programs: str) -> None:
    """FirmwareError: a program is not there."""
    absent = [name for name in programs if shutil.which(name) is None]
    if absent:
        raise FirmwareError(f"{what} needs {', '.join(absent)}: {missing(*absent)}")


def build(source: Path, out: Path, target: str) -> str:
    """Make a target of the firmware's Makefile in the folder `out`; returns what make said.

    source: the folder firmware/ of a checkout. FirmwareError: a program is missing, or the
    compiler failed.
    """
    if not (source / "Makefile").is_file():
        raise FirmwareError(f"{source}: no Makefile; the firmware is built in a checkout")
    compiler = "cc" if target == "posix" else "arm-none-eabi-gcc"
    need(f"the build of {target}", "make", compiler)
    command = ["make", "--no-print-directory", "-C", str(source), f"OUT={out}", target]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FirmwareError(f"make {target} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


class Emulator:
    """An image in QEMU; a context manager that ends it.

    port: of the hub, as the driver takes it
    pads: connected to the line over which the hub asks for captures
    """

    def __init__(self, image: Path, address: tuple[str, int] = ANY_ADDRESS) -> None:
        """address: where the hub's line is to be. FirmwareError: QEMU is not there."""
        need("the emulated hub", "qemu-system-arm")
        self._image, self._address = image, address

    def __enter__(self) -> Emulator:
        # QEMU gets sockets that listen already: so no port is taken by somebody else in between.
        with _listening(self._address) as host, _listening(ANY_ADDRESS) as pads:
            self.port = "socket://{}:{}".format(*host.getsockname())
            command = [
                *end_with_parent(),
                "qemu-system-arm",
                "-M",
                MACHINE,
                "-kernel",
                str(self._image),
            ]
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
        self.pads.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self

    def check(self) -> None:
        """FirmwareError: QEMU has ended by itself."""
        if self._process.poll() is not None and self._process.stderr is not None:
            said = self._process.stderr.read().strip()
            raise FirmwareError(f"QEMU ended with code {self._process.returncode}: {said}")

    def __exit__(self, *_: object) -> None:
        # Ends a `recv` of another thread, which closing does not.
        with contextlib.suppress(OSError):
            self.pads.shutdown(socket.SHUT_RDWR)
        self.pads.close()
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()


def _listening(address: tuple[str, int]) -> socket.socket:
    """FirmwareError: the address cannot be used."""
    try:
        return socket.create_server(address, backlog=1)
    except OSError as error:
        host, port = address
        raise FirmwareError(
            f"{host}:{port}: {error.strerror}; name an address that is free here"
        ) from None
