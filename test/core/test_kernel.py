# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The kernel in C and the one in numpy agree on every bit, on every processor."""

from __future__ import annotations

import dataclasses
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import ROOT
from cube_tensor_driver.core import pipeline
from cube_tensor_driver.core.calibration import Calibration, make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import CreepModel, ThermalModel, WeightModel
from cube_tensor_driver.core.kernel import run
from cube_tensor_driver.core.oscillator import TemperatureModel
from cube_tensor_driver.core.reconstructor import Reconstructor, RecordedHealth
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import STAMP

NATIVE = ROOT / "native"
SOURCES = [NATIVE / "cube_scan.c", NATIVE / "cube_contact.c", ROOT / "test" / "scan_process.c"]
STRICT = [
    "-std=c11",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-Wshadow",
    "-Werror",
]
BITS = ["-ffp-contract=off", "-fno-trapping-math", "-fno-math-errno"]
SANITIZED = ["-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
N_TABLES = 11
"""Number of arrays with tables of the skin that a call of the kernel takes."""
N_HEALTH = 3
"""Number of arrays with the state of health that a call of the kernel takes."""
N_OFFSETS = 12
"""Number of arrays with the coefficients and the state of compensation, which the kernel subtracts
from the readings of the pads."""
N_CUBE_STATE = 4
"""Number of arrays of compensation that the kernel writes. They are the last of `N_OFFSETS`."""
N_FILTERED = 3
"""Number of arrays that low-pass filters write. They are the last of their arguments."""
N_COLUMNS = 8
"""Number of arrays with columns of frequencies that a call of the kernel takes."""


class ScanProcess:
    """The kernel in a process of its own, with functions of the module."""

    def __init__(self, command: list[str]) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe)

    def run(self, *arguments):
        numbers, arrays = arguments[:2], arguments[2:]
        health, rest = arrays[N_TABLES:][:N_HEALTH], arrays[N_TABLES + N_HEALTH :]
        offsets, results = rest[N_OFFSETS - N_CUBE_STATE : N_OFFSETS], rest[N_OFFSETS + N_COLUMNS :]
        return self._call([0, *numbers], arrays, [*health, *offsets, *results])

    def filter(self, *arrays):
        self._call([1, 0, 0], arrays, arrays[-N_FILTERED:])

    def _call(self, numbers, arrays, written):
        call = [np.array(numbers, np.int64).tobytes()]
        for array in arrays:
            size = -1 if array is None else array.nbytes
            shape = () if array is None else array.shape
            call.append(np.array([size, len(shape), *shape], np.int64).tobytes())
            call.append(b"" if array is None else array.tobytes())
        try:
            self._process.stdin.write(b"".join(call))
            self._process.stdin.flush()
            answer = tuple(np.frombuffer(self._process.stdout.read(16), np.int64).tolist())
            for array in written:
                if array is not None:
                    data = self._process.stdout.read(array.nbytes)
                    array[...] = np.frombuffer(data, array.dtype).reshape(array.shape)
        except (BrokenPipeError, ValueError):
            pytest.fail(self.close())
        return answer

    def close(self) -> str:
        """What it wrote to standard error."""
        _, errors = self._process.communicate(timeout=10)
        return errors.decode()


def compiled(compiler: str, options: list[str], folder: Path, runner: list[str]) -> ScanProcess:
    program = folder / "scan_process"
    command = [compiler, *STRICT, *BITS, *options, f"-I{NATIVE}", *SOURCES, "-lm", "-o", program]
    subprocess.run(command, check=True, timeout=60)
    return ScanProcess([*runner, str(program)])


@pytest.fixture(scope="module", params=["module", "sanitized", "arm64"])
def kernel(request, tmp_path_factory) -> Iterator[object]:
    """Each way in which the C of the kernel runs."""
    folder = tmp_path_factory.mktemp("kernel")
    if request.param == "module":
        if run.native is None:
            pytest.skip("the module _scan is not built")
        yield run.native
        return
    cross, emulator = "aarch64-linux-gnu-gcc", shutil.which("qemu-aarch64-static")
    if request.param == "arm64" and not (shutil.which(cross) and emulator):
        pytest.skip("no arm64: apt install gcc-aarch64-linux-gnu qemu-user-static")
    if not shutil.which("cc"):
        pytest.skip("no C compiler: apt install gcc")
    if request.param == "arm64":
        process = compiled(cross, ["-O2", "-static"], folder, [str(emulator)])
    else:
        process = compiled("cc", SANITIZED, folder, [])
    yield process
    assert process.close() == ""


def individual(layout: str, seed: int, **changes) -> Calibration:
    """A calibration whose pads all differ."""
    rng = np.random.default_rng(seed)
    whole = make_illustrative_calibration(
        layout, ("xx", "xx_z", "xx_x") if layout == "quad" else ()
    )
    n = whole.layout.n_pads
    return replace(
        whole,
        gain=1 + 0.05 * rng.normal(size=n),
        beta=0.3 + 0.05 * rng.normal(size=n),
        noise=3 * rng.uniform(1, 2, size=n),
        rest_frequency=1e5 + 100 * rng.normal(size=n),
        modulus=3e5 * (1 + 0.1 * rng.normal(size=n)),
        **changes,
    )


def thermal(layout: str, seed: int, degree: int) -> Calibration:
    n_pads = make_illustrative_calibration(layout).layout.n_pads
    slopes = 1e-4 * np.random.default_rng(seed).normal(size=(n_pads, degree))
    return individual(layout, seed, temperature=TemperatureModel(24.0, slopes))


def heavy(calibration: Calibration, seed: int) -> Calibration:
    """The calibration with a response to weight that differs between pads."""
    response = 5 * np.random.default_rng(seed).normal(size=(calibration.layout.n_pads, 3))
    return replace(calibration, weight=WeightModel(response))


def lasting(calibration: Calibration, seed: int) -> Calibration:
    """The calibration with creep and an effect of temperature that differ between pads."""
    rng = np.random.default_rng(seed)
    n_pads = calibration.layout.n_pads
    creep = CreepModel(np.array([0.1, 2.0]), 0.1 * rng.random((n_pads, 2)))
    model = ThermalModel(np.array(25.0), np.array([1.0, 0.2]), rng.normal(size=(n_pads, 2)))
    return replace(calibration, creep=creep, thermal=model)


SKINS = {
    "planar": [make_illustrative_calibration("planar")] * 9,
    "mixed": [
        heavy(individual("cube", 8), 9),
        lasting(thermal("cube", 1, 2), 3),
        lasting(heavy(individual("planar", 12), 4), 5),
        *(individual("planar", seed) for seed in range(4)),
        individual("quad", 6),
        replace(make_illustrative_calibration("planar"), beta=np.array(0.0)),
        thermal("planar", 7, 1),
    ],
    "quad": [lasting(heavy(make_illustrative_calibration("quad"), 2), 3)] * 3,
}
"""Skins of all layouts: of one calibration, of many, with temperature, weight and creep, and
without a residual."""

WILD = [np.nan, np.inf, -np.inf, 0.0, -1e5, 1e-300, 1e300, 2e4, 1.8e5, 3.5e5, 1e5 * 1.3 / 0.3]


def played_rows(calibrations, seed: int, dtype) -> Iterator[tuple[FrequencyRows, RecordedHealth]]:
    """Batches of rows of all kinds: several scans, rows missing, rows in any order, gaps, jitter,
    time that jumps, doubtful stamps, temperatures, faults, and any numbers as frequencies."""
    rng = np.random.default_rng(seed)
    n_cubes, n_pads = len(calibrations), max(c.layout.n_pads for c in calibrations)
    rest = np.full((n_cubes, n_pads), np.nan)
    for number, calibration in enumerate(calibrations):
        rest[number, : calibration.layout.n_pads] = calibration.rest_frequency
    period_ns, time_ns = 20_000_000, 10**18
    for _ in range(20):
        n_scans = int(rng.integers(1, 5))
        cube = np.tile(np.arange(n_cubes), n_scans)
        scan = np.repeat(np.arange(n_scans), n_cubes)
        kept = rng.random(len(cube)) > rng.choice([0, 0.3])
        cube, scan = cube[kept], scan[kept]
        if rng.random() < 0.1:
            cube = rng.permutation(cube)
        n = len(cube)
        frequency = rest[cube] * (1 - 0.01 * rng.random() - 8e-6 * rng.normal(size=(n, n_pads)))
        is_wild = rng.random(frequency.shape) < rng.choice([0, 0, 0.01, 0.05])
        frequency[is_wild] = rng.choice(WILD, is_wild.sum())
        jitter = rng.choice([0, period_ns // 10, 2 * period_ns])
        stamp_ns = time_ns + scan * period_ns + rng.integers(0, jitter + 1, n)
        time_ns += n_scans * period_ns + int(rng.choice([0, 0, 0, 100_000_000, -2_000_000_000]))
        chance = rng.choice([0, 0, 0.1])
        fault = rng.integers(0, 2**32, n) * (rng.random(n) < chance)
        doubt = STAMP * (rng.random(n) < chance)
        celsius = rng.choice([np.nan, 20.0, 31.4], n)
        force = 9.81 * rng.normal(size=(n, 3))
        force[rng.random(n) < chance] = np.nan
        with np.errstate(all="ignore"):
            rows = FrequencyRows.from_values(
                cube.astype(np.uint16),
                frequency.astype(dtype),
                stamp_ns=stamp_ns,
                temperature=celsius,
                pad_fault=fault,
                status=doubt,
                specific_force=force if rng.random() < 0.8 else None,
            )
        known = rng.random(n) < 0.5
        left_out = rng.choice([0, 1, 6], n).astype(np.uint32)
        yield rows, RecordedHealth(known, left_out, rng.integers(0, 2048, n).astype(np.uint16))


def played(kernel, calibrations, seed: int, dtype=np.float32) -> list[object]:
    """Everything that a reconstruction of played rows yields, by one kernel."""
    found: list[object] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "native", kernel)
        # Few, so that tables are removed and made again, too.
        patch.setattr(pipeline, "MAX_CACHED_ESTIMATORS", 24)
        reconstructor = Reconstructor(calibrations, dtype)
        health = reconstructor.health
        for number, (rows, recorded) in enumerate(played_rows(calibrations, seed, dtype)):
            if number % 10 == 7:
                reconstructor.rest_frequency = reconstructor.rest_frequency * (1 + 1e-4)
            given = recorded if number % 3 == 2 else None
            found.append(reconstructor.process(rows, given))
            found.append(reconstructor.process_known(rows, recorded))
            found += reconstructor.compensation.collect_states().values()
            found += [array.copy() for array in reconstructor.compensation.offsets]
            found += [
                health.state,
                health.sums.cubes["mask"].copy(),
                *health.collect(),
                *health.read_window(),
            ]
        found += [column for window in health.history for column in window]
        found += [health.sums.cubes[name] for name in health.sums.cubes.dtype.names]
        found += [health.sums.quantities, health.sums.window_ns, health.closed]
    return found


def assert_same_bits(found: list[object], expected: list[object]) -> None:
    """The bits of results; in states, whose NaN nobody sees, those of all other numbers."""
    for number, (one, other) in enumerate(zip(found, expected, strict=True)):
        if isinstance(other, StressRows):
            for field in dataclasses.fields(other):
                a, b = getattr(one, field.name), getattr(other, field.name)
                assert a.dtype == b.dtype
                assert a.tobytes() == b.tobytes(), f"{number} {field.name}\n{a}\n{b}"
        else:
            np.testing.assert_array_equal(one, other, err_msg=str(number), strict=True)


@pytest.mark.parametrize("skin", list(SKINS))
def test_c_and_numpy_agree_on_every_bit(kernel, skin):
    """The compared bits are those of results, states and windows, under all conditions of pads."""
    expected = played(None, SKINS[skin], 1)
    assert_same_bits(played(kernel, SKINS[skin], 1), expected)


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1), st.sampled_from(list(SKINS)))
def test_c_and_numpy_agree_on_random_rows(seed, skin):
    if run.native is None:
        pytest.skip("the module _scan is not built")
    expected = played(None, SKINS[skin], seed)
    assert_same_bits(played(run.native, SKINS[skin], seed), expected)


HASHED = """
import hashlib, sys
import numpy as np
from cube_tensor_driver.core.kernel import run
from test_kernel import SKINS, played
from cube_tensor_driver.core.rows import StressRows
found = hashlib.sha256()
for dtype in (np.float32, np.float64):
    for item in played(None, SKINS["mixed"], 3, dtype):
        if isinstance(item, StressRows):
            found.update(item.stress.tobytes() + item.residual.tobytes() + item.status.tobytes())
print(found.hexdigest(), np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"])
"""
OLD_PROCESSOR = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512_SKX AVX2 FMA3 X86_V3 X86_V4",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
}


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the names are of x86-64")
def test_an_old_processor_gives_the_same_bits():
    """Also of the matrices: BLAS, numpy and the C library take other instructions there."""
    found = []
    for environment in ({"OPENBLAS_CORETYPE": "Haswell"}, OLD_PROCESSOR):
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", HASHED],
            capture_output=True,
            text=True,
            cwd=Path(__file__).parent,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
            timeout=60,
            check=True,
        )
        found.append(done.stdout)
    assert found[0] == found[1]


PYTHON_H = Path(sysconfig.get_paths()["include"])


@pytest.mark.skipif(not (PYTHON_H / "Python.h").is_file(), reason="no headers: python3-dev")
def test_the_module_compiles_without_a_warning():
    command = ["cc", *STRICT, "-fsyntax-only", "-isystem", PYTHON_H, NATIVE / "python_scan.c"]
    subprocess.run(command, check=True, timeout=60)


@pytest.mark.skipif(run.native is None, reason="the module _scan is not built")
def test_arrays_that_do_not_fit_are_refused():
    calls = []

    def record(*call):
        calls.append(call)
        return module.run(*call)

    module = run.native
    rows, _ = next(played_rows(SKINS["planar"], 1, np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "native", SimpleNamespace(run=record))
        Reconstructor(SKINS["planar"]).process(rows)
    call = calls[-1]
    with pytest.raises(TypeError, match="takes 43 arguments"):
        module.run(*call[:-1])
    for number in range(2, len(call)):
        for wrong in (
            np.zeros((3, 1, 2)),
            call[number][..., None] if call[number] is not None else 1,
        ):
            with pytest.raises((ValueError, AttributeError), match="array"):
                module.run(*call[:number], wrong, *call[number + 1 :])
