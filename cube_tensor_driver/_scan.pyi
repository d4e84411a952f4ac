"""The kernel of a scan in C (native/python_scan.c); core/kernel/run.py tells whether it exists."""

from typing import Any

def run(start: int, n_residuals: int, is_double: bool, *arrays: Any) -> tuple[int, int]:
    """Process rows from `start` on; core/kernel/run.py states arguments and results.

    Args:
        start: Number of the first row.
        n_residuals: Number of outputs that are residuals.
        is_double: Whether real numbers are float64.
        arrays: Fields of Tables, HealthState (or None for each), Columns and Results.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """
