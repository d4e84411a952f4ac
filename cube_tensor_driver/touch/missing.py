"""What cubes predict for one among them that misses values.

Values that are missing (D; R are the others around their cube) change no matrix of a window. The
estimate without them is the one with what the others predict in their place::

    y_D = -P_DD^-1 P_DR y_R,      covariance + G_D P_DD^-1 G_D'

Source: C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning (2006), 5.4.2
(leaving out).
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Index, Mask, Single
from .windows import Windows, of_pressure


class Missing:
    """What the inner cubes of a window predict where its own cube misses values.

    variance: (cubes, points x 2) what is added to the variances at the size 1

    Errors of the predictions of several cubes count as independent of each other.
    """

    def __init__(self, windows: Windows, observed: Mask, known: Mask) -> None:
        missing = observed & ~known
        width = known.shape[1]
        self.variance = np.zeros((len(known), windows.prior.shape[1]))
        self._fill: list[tuple[int, Index, Index, Array]] = []
        self._noise: list[tuple[Index, Array, Index, Array]] = []
        for cube in np.flatnonzero(missing.any(axis=1)).tolist():
            near, kind = windows.near[cube, : windows.inner], windows.kind[cube]
            precision = windows.precision[kind].astype(float)
            out, own = missing[near].ravel(), np.flatnonzero(missing[cube])
            # Of the cube's own ones, the first ones of those that are out.
            some = np.eye(out.sum(), len(own))
            inside = np.linalg.solve(precision[np.ix_(out, out)], some)
            fill = -inside.T @ precision[out]
            fill[:, out] = 0.0
            rows, place = np.nonzero(windows.near == cube)
            columns = place[:, None] * width + own
            lost = windows.gain[windows.kind[rows][:, None], :, columns].astype(float)
            lost = of_pressure(lost)
            more = np.einsum("ncr,cd,ndr->nr", lost, inside[: len(own)], lost)
            self.variance[rows] += np.maximum(more, 0)
            if out.all():
                continue
            self._fill.append((cube, own, near, fill))
            pads = windows.pads[near]
            by_pad = np.einsum("fwc,wcp->fwp", fill.reshape(len(own), len(near), -1), pads)
            self._noise.append((near, by_pad.reshape(len(own), -1), rows, lost))

    def filled(self, y: Single) -> Single:
        """Values (cubes, C) that are 0 where they are missing, with what is predicted there."""
        filled = y.copy()
        for cube, own, near, fill in self._fill:
            filled[cube, own] = fill @ y[near].ravel()
        return filled

    def noise(self, of_pads: Single) -> Array:
        """(cubes, points x 2) as `Windows.noise`, by the pads that the predictions are from."""
        total = np.zeros_like(self.variance)
        for near, by_pad, rows, lost in self._noise:
            covariance = (by_pad * of_pads[near].ravel()) @ by_pad.T
            total[rows] += np.einsum("ncr,cd,ndr->nr", lost, covariance, lost)
        return total
