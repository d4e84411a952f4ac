"""The kernel of a scan and the response to contacts in C (native/python_scan.c).

core/kernel/run.py tells whether they exist.
"""

from .core.arrays import AnyArray

def run(start: int, n_residuals: int, *arrays: AnyArray | None) -> tuple[int, int]:
    """Process rows from `start` on; core/kernel/run.py states arguments and results.

    Args:
        start: Number of the first row.
        n_residuals: Number of outputs that are residuals.
        arrays: Fields of Tables, HealthState and Offsets (or None for each) and Columns, then the
            columns of StressRows in the order of run.py, and what is subtracted or None; real
            numbers are float32.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """

def forces(*arrays: AnyArray | None) -> None:
    """Compute the specific force at the cubes of rows; core/compensation/motion.py states how.

    Args:
        arrays: Arguments of `_find_forces`.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """

def filter(*arrays: AnyArray) -> None:
    """Advance low-pass filters; core/compensation/low_pass.py states how.

    Args:
        arrays: Arguments of `_advance`.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """

def respond(*arrays: AnyArray) -> None:
    """Compute the values of cubes under Hertz contacts; native/cube_contact.h states the arrays.

    Args:
        arrays: The first ones of `CUBE_CONTACT_ARRAYS`, up to `result`.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """

def linearise(halfway: float, *arrays: AnyArray | None) -> None:
    """Linearise the values of cubes in the parameters of Hertz contacts.

    Args:
        halfway: Number by which lengths are divided for the effect of errors of the elastomer.
        arrays: `CUBE_CONTACT_ARRAYS` of native/cube_contact.h, but None instead of `result`.

    Raises:
        ValueError: An array has another type or shape, or is not contiguous.
    """
