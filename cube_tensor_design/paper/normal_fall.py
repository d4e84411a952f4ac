"""What makes P_normal fall in the paper's experiment (b), where a pressed body is sheared.

Before the shear all four pads feel s_zz + c: the true stress and what the cube adds to it, being
stiffer than the elastomer in its place. Under shear the cube turns by an angle t, and a pad feels
the stress along its own normal. The mean of the four is then::

    s_zz - 2 s_zx sin t cos t + (s_xx - s_zz) sin² t + c

The cube is rigid: its faces keep their areas, so this is the true stress and the nominal one. Each
of the four terms changes in turn, for all pads alike. At last the two pads of a face differ, which
changes P_normal because the pad law is not linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.oscillator import pad_frequency

from .experiments import FOAM, Experiment, prototype


@dataclass(frozen=True, eq=False)
class NormalFall:
    """By s_zz; by s_zx and by s_xx - s_zz on turned faces; by c; by pads of a face that differ.

    stress: (4,) Pa, changes of the pads' mean by the first four
    signal: (5,) Hz, changes of P_normal
    """

    stress: Array
    signal: Array


def normal_fall(experiment: Experiment) -> NormalFall:
    """Parts of what changes from the end of the pressing to the end of the shear.

    experiment: the first half of its steps presses and the second shears
    """
    pressed = len(experiment.displacement) // 2 - 1
    (before, *_), (zz, zx, xx) = experiment.truth[[pressed, -1], :3]
    first, last = experiment.pads[[pressed, -1], :4].mean(axis=1)
    sin, cos = np.sin(experiment.rotation[-1]), np.cos(experiment.rotation[-1])
    field = np.array([zz - before, -2 * zx * sin * cos, (xx - zz) * sin**2])
    stress = np.append(field, last - first - field.sum())
    alike = np.tile(np.cumsum([first, *stress])[:, None], 4)
    signal = prototype(pad_frequency(alike, **FOAM))[:, 0]
    return NormalFall(stress, np.diff(signal, append=experiment.prototype[-1, 0]))
