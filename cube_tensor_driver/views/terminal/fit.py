"""The result of a calibration fit, as tables."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from ...calibrate.fit import Fit


def show_fit(result: Fit, rest: str) -> None:
    """Print coefficients, gains, how well they fit, and which loads to add. rest: a remark."""
    console = Console(highlight=False)
    console.print(f"coefficients, {result.structure.symmetry} symmetry, Pa per Pa; {rest}")
    table = _table("coefficient")
    for name, value in result.coefficients.items():
        if math.isfinite(value):
            table.add_row(name, f"{value:+.5f}", f"{result.deviations[name]:.2g}")
        else:
            table.add_row(name, "open", "not determined")
    console.print(table)
    console.print("gains (average 1 over pads that the symmetry carries onto each other)")
    gains = _table("pad")
    pads = result.structure.layout.pads
    for pad, gain, deviation in zip(pads, result.gain, result.gain_deviation, strict=True):
        gains.add_row(pad, f"{gain:.5f}", f"{deviation:.2g}")
    console.print(gains)
    console.print(
        f"scatter {result.scale:.3g} × the stated noise; "
        f"chi-square {result.chi2:.4g} for {result.dof} degrees of freedom; "
        f"held-out error {100 * result.held_out:.3g} % of the readings; "
        f"{int(result.outliers.sum())} outliers"
    )
    for sentence in result.advice:
        console.print(sentence, style="red")


def _table(first: str) -> Table:
    """A column of names, one of values, one of standard deviations."""
    table = Table(first)
    value = "gain" if first == "pad" else "value"
    for name in (value, "standard deviation"):
        table.add_column(name, justify="right")
    return table
