# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the fall of the signal P_normal in the paper's experiment (b): a pressed body is
sheared.

Before the shear all four pads have the stress s_zz + c: the true stress, and what the cube adds to
it because it is stiffer than the elastomer in its place. Under shear the cube rotates by an angle
t, and a pad measures the stress along its own normal. The mean of the four is then::

    s_zz - 2 s_zx sin t cos t + (s_xx - s_zz) sin² t + c

The cube is rigid: its faces keep their areas, so this is the true stress and the nominal one. Each
of the four terms is changed in turn, for all pads alike. At last the two pads of a face differ,
which changes P_normal because the pad law is not linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cube_tensor_driver.core.arrays import Array

from .experiments import Experiment, compute_foam_frequency, compute_prototype_signals


@dataclass(frozen=True, eq=False)
class NormalFall:
    """Parts of the change of P_normal, the prototype's signal for pressure, under shear.

    The order of the parts is: change of the true stress s_zz; shear s_zx on the faces of the
    rotated cube; difference s_xx - s_zz on these faces; change of the stress that the cube adds,
    because it is stiffer than the elastomer; difference between the two pads of a face.

    Attributes:
        stress: (4,) change of the pads' mean by the first four parts, in Pa.
        signal: (5,) change of P_normal, in Hz.
    """

    stress: Array
    signal: Array


def split_normal_fall(experiment: Experiment) -> NormalFall:
    """Return the parts of the change from the end of the pressing to the end of the shear.

    Args:
        experiment: An experiment whose first half of steps presses and whose second half shears.
    """
    pressed = len(experiment.displacement) // 2 - 1
    zz_before = experiment.truth[pressed, 0]
    zz, zx, xx = experiment.truth[-1, :3]
    normal_pads = experiment.pads[:, :4]
    before, after = normal_pads[[pressed, -1]].mean(axis=1)
    angle = experiment.rotation[-1]
    sin = np.sin(angle)
    cos = np.cos(angle)
    shear_part = -2 * zx * sin * cos
    normal_part = (xx - zz) * sin**2
    field = np.array([zz - zz_before, shear_part, normal_part])
    # The part of the change that the true stresses do not explain is a change of the stress that
    # the cube adds.
    added = after - before - field.sum()
    stress = np.append(field, added)

    # The signal that four equal pads would give, after each part in turn has been added to their
    # stress.
    mean_stress = np.cumsum([before, *stress])
    equal_pads = np.tile(mean_stress[:, None], 4)
    frequencies = compute_foam_frequency(equal_pads)
    signal = compute_prototype_signals(frequencies)[:, 0]
    # The last part leads from four equal pads to the pads as they are.
    end = experiment.prototype[-1, 0]
    return NormalFall(stress, np.diff(signal, append=end))
