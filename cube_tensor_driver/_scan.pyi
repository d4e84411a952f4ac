"""The kernel of a scan in C (native/python_scan.c); core/kernel/run.py tells whether it exists."""

from typing import Any

def run(start: int, n_residuals: int, *arrays: Any) -> tuple[int, int]:
    """Process rows from `start` on; core/kernel/run.py states arguments and results.

    Args:
        start: Number of the first row.
        n_residuals: Number of outputs that are residuals.
        arrays: Fields of Tables, HealthState (or None for each), Columns and Results;
            real numbers are float32.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """
