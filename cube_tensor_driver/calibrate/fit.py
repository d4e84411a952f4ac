# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Fit of a calibration to known loads: the symmetric coefficients, and one gain per pad.

    v_np = g_p sum_k c_k (B_k s_n)_p + noise

    s_n   amplitudes of the modes (linear stress fields) of the known load n
    v_np  stress that pad p measured under load n
    B_k   basis matrices (pads x modes) of the responses that the symmetry allows
    c_k   coefficients of the response
    g_p   gain, the sensitivity of pad p relative to the symmetric response

Loads determine only the product of g and c. So gains average 1 over each set of pads that the
symmetry maps onto each other. The fit takes Gauss-Newton steps on weighted residuals: with equal
weights, then with Huber's weights, and at last with Tukey's, which are 0 for outliers.

Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array, Mask, Real
from ..core.calibration import Calibration
from ..core.errors import FitError
from ..core.modes import Modes
from ..core.oscillator import compute_pad_stress
from ..core.symmetry import Structure
from .robust import (
    MAX_STEPS,
    STAGES,
    compute_robust_covariance,
    compute_weights,
    estimate_scatter,
    find_null_space,
    find_undetermined,
    solve_least_squares,
)

FOLDS = 10
"""Number of parts into which the known loads are divided for cross-validation. The fit is repeated
without each of the parts, and its error is measured on the part that was left out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Result of a fit of a cube's response (stress on its P pads per known stress) to N loads.

    The response consists of K coefficients, which are the same for pads that the symmetry maps onto
    each other, and of a gain for each pad. A reading is the stress that one pad measured under one
    load.

    Attributes:
        structure: Layout, symmetry, names of the coefficients, and the matrix of each coefficient.
        coefficients: Values of the coefficients of the response by name, in Pa per Pa; NaN where
            the loads do not determine them.
        deviations: Standard deviations of the coefficients by name, in Pa per Pa.
        covariance: Covariance (K, K) of the coefficients.
        gain: Sensitivities of the pads relative to the symmetric response (P,), 1 on average.
        gain_deviation: Standard deviations of the gains (P,).
        scale: Standard deviation of the residuals (measured minus fitted), in units of the noise
            that the caller stated.
        chi2: Sum of squares of the residuals divided by the stated noise, without outliers.
        dof: Degrees of freedom of chi2: number of readings minus number of determined parameters.
        held_out: Ratio of the rms error on loads that are left out of the fit (cross-validation) to
            the rms reading, without outliers.
        fitted: Fitted pad stresses (N, P), in Pa.
        outliers: Whether the fit ignores a reading, because it deviates too much (N, P).
        undetermined: Names of the coefficients that the loads do not determine.
        advice: Sentences that name the loads to add, so that they determine all coefficients.
    """

    structure: Structure
    coefficients: dict[str, float]
    deviations: dict[str, float]
    covariance: Array
    gain: Array
    gain_deviation: Array
    scale: float
    chi2: float
    dof: int
    held_out: float
    fitted: Array
    outliers: Mask
    undetermined: tuple[str, ...]
    advice: tuple[str, ...]

    def make_calibration(
        self,
        base: Calibration,
        created: str = "",
        source: str = "",
    ) -> Calibration:
        """Return a calibration with the fitted coefficients and gains.

        Args:
            base: Calibration that provides all other values, such as rest frequencies. Its noise is
                multiplied by `scale` (scatter of the residuals in units of the noise) if that is
                above 1.
            created: Time of creation, ISO 8601.
            source: Origin of the values.

        Raises:
            FitError: The loads do not determine all coefficients. `advice` names loads to add; the
                alternative is to give the coefficients to `fit` as `fixed`.
        """
        if self.undetermined:
            raise FitError(
                f"no calibration: {'; '.join(self.advice)}. Or give the open coefficients as fixed"
            )
        return replace(
            base,
            layout=self.structure.layout,
            symmetry=self.structure.symmetry,
            matrix=None,
            coefficients=self.coefficients,
            gain=self.gain,
            covariance=self.covariance,
            noise=base.noise * max(1.0, self.scale),
            created=created,
            source=source,
        )


def compute_measured_stress(
    base: Calibration,
    frequency: ArrayLike,
    temperature: Real | None = None,
) -> Array:
    """Compute the stresses on P pads under N loads (N, P), in Pa, from their frequencies.

    Args:
        base: Calibration with the pad law (relation of the frequency of a pad and the stress on it)
            and the frequencies without load.
        frequency: Frequencies (N, P), in Hz.
        temperature: Temperatures (N,), in °C, if they are known.

    Raises:
        FitError: The shape is wrong, or no stress belongs to a frequency by the pad law.
    """
    f = np.asarray(frequency, dtype=float)
    layout = base.layout
    if f.ndim != 2 or f.shape[1] != layout.n_pads:
        raise FitError(
            f"frequencies have shape {f.shape}; layout {layout.name!r} needs "
            f"(loads, {layout.n_pads})"
        )
    rest = base.rest_frequency
    if base.temperature is not None and temperature is not None:
        rest = rest * base.temperature.compute_factor(temperature)
    v = compute_pad_stress(f, rest, base.beta, base.modulus)
    invalid = np.argwhere(~np.isfinite(v))
    for load, pad in invalid.tolist():
        raise FitError(
            f"load {load + 1}, pad {layout.pads[pad]}: {f[load, pad]:g} Hz is outside the "
            "pad's range; correct or remove this row"
        )
    return v


def loads_from_forces(
    modes: Modes,
    force: Array,
    area: float,
) -> Array:
    """Compute the amplitudes of the modes of loads that are forces on a cube's face +z.

    A reference sensor measured the forces. They are taken as a uniform stress with the components
    zz, yz and zx. The normal stresses along the skin, xx and yy, are taken as 0, because nothing
    holds the layer sideways.

    Args:
        modes: The M modes (linear stress fields) of the cube.
        force: Forces (N, 3) in the frame of the cube, in N.
        area: Area that the forces act on, in m².

    Returns:
        Amplitudes of the modes (N, M), in Pa.

    Raises:
        FitError: The area is not above 0.
    """
    if not area > 0:
        raise FitError(f"the area that the forces act on is {area} m^2; it must be above 0")
    stress = np.zeros((len(force), 6))
    zx_yz_zz = [4, 3, 2]
    stress[:, zx_yz_zz] = force / area
    return modes.compute_amplitudes(stress)


def fit(
    structure: Structure,
    loads: ArrayLike,
    measured: ArrayLike,
    noise: ArrayLike = 1.0,
    fixed: Mapping[str, float] | None = None,
    gains: bool = True,
) -> Fit:
    """Fit the response of a cube (stress on its P pads per known stress) to N known loads.

    The response consists of coefficients, which are the same for pads that the symmetry maps onto
    each other, and of a gain (relative sensitivity) for each pad.

    Args:
        structure: Layout of the pads, modes and symmetry, which define the coefficients.
        loads: Amplitudes of the modes (linear stress fields) under each load (N, M), in Pa.
        measured: Measured pad stresses (N, P), in Pa.
        noise: Standard deviation of the measured pad stresses, one number or (P,), in Pa.
        fixed: Values of coefficients that are known from elsewhere, by name.
        gains: Whether gains are fitted. If False, every gain is 1; use it for loads that reach too
            few pads to separate gains from coefficients.

    Raises:
        FitError: Shapes or numbers are invalid, all loads are zero, or the loads determine no
            coefficient at all.
    """
    fixed = dict(fixed or {})
    x, y, sigma = _check_inputs(
        structure,
        loads,
        measured,
        noise,
        fixed,
    )
    model = _Model(structure, sigma, fixed, gains)
    design = model.compute_design(x)
    theta, weights, scale = model.solve(design, y)

    jacobian = model.compute_jacobian(theta, design)
    null = find_null_space(jacobian)
    n_free = len(model.free)
    is_open = find_undetermined(null, n_free)
    advice = _advise(model, theta, x, null, is_open)
    if n_free and is_open.all():
        raise FitError(f"these loads determine no coefficient: {'; '.join(advice)}")

    fitted = model.predict(theta, design)
    whitened = (y - fitted) / sigma
    residuals = whitened.ravel() / scale
    covariance = compute_robust_covariance(jacobian, residuals, scale)
    # Coefficients that the loads do not determine have an unknown variance (NaN). The covariance is
    # computed with a pseudo-inverse, which gives them a small variance.
    covariance[:n_free][is_open] = np.nan
    covariance[:, :n_free][:, is_open] = np.nan
    # Coefficients that the caller fixed have the variance 0.
    n = structure.n_coefficients
    of_coefficients = np.zeros((n, n))
    free = np.array(model.free, dtype=int)
    free_pairs = np.ix_(free, free)
    of_coefficients[free_pairs] = covariance[:n_free, :n_free]
    of_coordinates = covariance[n_free:, n_free:]
    of_gains = model.gains @ of_coordinates @ model.gains.T
    coefficients, gain = model.unpack(theta)
    undetermined = free[is_open]
    coefficients[undetermined] = np.nan
    deviations = np.sqrt(np.diag(of_coefficients))
    # Rounding can make a variance that should be 0 slightly negative.
    gain_variance = np.diag(of_gains).clip(0)

    def name_coefficients(values: Array) -> dict[str, float]:
        """Return values (K,) of the coefficients by the names of the coefficients."""
        return dict(zip(structure.names, values.tolist(), strict=True))

    is_used = weights > 0
    used = whitened[is_used]
    n_determined = jacobian.shape[1] - null.shape[1]
    return Fit(
        structure=structure,
        coefficients=name_coefficients(coefficients),
        deviations=name_coefficients(deviations),
        covariance=of_coefficients,
        gain=gain,
        gain_deviation=np.sqrt(gain_variance),
        scale=float(scale),
        chi2=float(np.sum(used**2)),
        dof=int(is_used.sum()) - n_determined,
        held_out=_cross_validate(model, design, y, is_used),
        fitted=fitted,
        outliers=~is_used,
        undetermined=tuple(structure.names[k] for k in undetermined),
        advice=tuple(advice),
    )


class _Model:
    """Model of the measured pad stresses (readings) as a function of parameters theta.

    The parameters are the coefficients of the response that the caller did not fix, then G
    coordinates of the gains (relative sensitivities of the P pads).

    Attributes:
        free: Numbers of the coefficients that are not fixed.
        gains: Changes of the gains (P, G) per unit of each coordinate. A coordinate raises the gain
            of one pad, and lowers that of the first pad of its orbit (set of pads that the symmetry
            maps onto each other) by as much. This keeps the average gain of the orbit at 1.
    """

    def __init__(
        self,
        structure: Structure,
        noise: Array,
        fixed: Mapping[str, float],
        gains: bool,
    ) -> None:
        self.structure, self.noise = structure, noise
        names = structure.names
        self.free = [k for k, name in enumerate(names) if name not in fixed]
        values = [fixed.get(name, 0.0) for name in names]
        self._fixed = np.array(values, dtype=float)
        n_pads = structure.layout.n_pads
        columns = []
        for first, *others in structure.pad_orbits if gains else ():
            for pad in others:
                column = np.zeros(n_pads)
                column[pad], column[first] = 1, -1
                columns.append(column)
        # The reshape gives the matrix the right shape (P, 0) if there are no gains to fit.
        rows: Array = np.array(columns)
        self.gains = rows.reshape(-1, n_pads).T

    def unpack(self, theta: Array) -> tuple[Array, Array]:
        """Convert parameters to all coefficients of the response (K,) and the pads' gains (P,).

        Args:
            theta: Parameters: the coefficients that are not fixed, then the coordinates of the
                gains. The gains are 1 plus the matrix `gains` times the coordinates.
        """
        coefficients = self._fixed.copy()
        coefficients[self.free] = theta[: len(self.free)]
        coordinates = theta[len(self.free) :]
        return coefficients, 1 + self.gains @ coordinates

    def compute_design(self, x: Array) -> Array:
        """Return the change of each reading (stress on a pad under a load) per coefficient.

        All gains are taken as 1. The result has the shape (loads N, pads P, coefficients K).

        Args:
            x: Amplitudes of the modes of the loads (N, M), in Pa.
        """
        basis = self.structure.basis
        by_coefficient = np.tensordot(x, basis, axes=(1, 2))
        return np.moveaxis(by_coefficient, 1, 2)

    def predict(
        self,
        theta: Array,
        design: Array,
    ) -> Array:
        """Return the stresses on P pads under N loads (N, P), in Pa, that the model predicts.

        Args:
            theta: Parameters (coefficients, then coordinates of the gains).
            design: Result of `compute_design` for the loads (N, P, K), in Pa.
        """
        coefficients, gain = self.unpack(theta)
        readings: Array = gain * (design @ coefficients)
        return readings

    def compute_jacobian(
        self,
        theta: Array,
        design: Array,
    ) -> Array:
        """Return the derivatives of the predicted pad stresses with respect to the parameters.

        Args:
            theta: Parameters (coefficients, then coordinates of the gains).
            design: Result of `compute_design` for N loads (N, P, K), in Pa.

        Returns:
            Derivatives (N P, parameters), divided by the noise of the pad.
        """
        coefficients, gain = self.unpack(theta)
        free = design[:, :, self.free]
        by_coefficient = free * gain[:, None]
        at_gain_1 = design @ coefficients
        by_gain = at_gain_1[:, :, None] * self.gains
        parts = [by_coefficient, by_gain]
        derivatives = np.concatenate(parts, axis=2)
        whitened: Array = derivatives / self.noise[:, None]
        return whitened.reshape(-1, theta.size)

    def solve(
        self,
        design: Array,
        y: Array,
    ) -> tuple[Array, Array, float]:
        """Fit the parameters to readings: with equal, then Huber's, then Tukey's weights.

        Args:
            design: Result of `compute_design` for the loads (N, P, K), in Pa.
            y: Measured pad stresses (N, P), in Pa.

        Returns:
            Parameters, weights of the readings (N, P) from 0 to 1, and scatter (standard deviation)
            of the residuals in units of the noise.
        """
        n_coordinates = self.gains.shape[1]
        n_parameters = len(self.free) + n_coordinates
        theta = np.zeros(n_parameters)
        weights = np.ones(y.size)
        scale = 1.0
        for stage, tolerance in STAGES.items():
            for _ in range(MAX_STEPS):
                difference = y - self.predict(theta, design)
                r = (difference / self.noise).ravel()
                if stage == "huber":
                    # Tukey's stage keeps the last scatter (standard deviation of the residuals) of
                    # Huber's, because with a new scatter in each step it might not converge.
                    scale = estimate_scatter(r)
                if stage != "plain":
                    weights = compute_weights(stage, r / scale)
                # Multiplying each row by the root of its weight turns weighted least squares into
                # ordinary least squares.
                root = np.sqrt(weights)
                jacobian = self.compute_jacobian(theta, design)
                weighted = root[:, None] * jacobian
                step = solve_least_squares(weighted, root * r)
                theta = theta + step
                # The tolerance of the step is relative to the norm of the parameters. Adding 1 to
                # the norm keeps the tolerance from becoming 0 for parameters near 0.
                size = np.linalg.norm(theta)
                limit = tolerance * (1 + size)
                if np.linalg.norm(step) <= limit:
                    break
        return theta, weights.reshape(y.shape), scale


def _check_inputs(
    structure: Structure,
    loads: ArrayLike,
    measured: ArrayLike,
    noise: ArrayLike,
    fixed: Mapping[str, float],
) -> tuple[Array, Array, Array]:
    """Check the arguments of `fit`, which explains them.

    Returns:
        Loads (N, M), measured pad stresses (N, P) and noise (P,), in Pa.

    Raises:
        FitError: An argument is invalid.
    """
    n_pads, n_modes = structure.basis.shape[1:]
    try:
        x = np.array(loads, dtype=float)
        y = np.array(measured, dtype=float)
        sigma = np.array(noise, dtype=float)
    except (TypeError, ValueError):
        raise FitError("loads, measured stresses and noise must be numbers") from None
    n_loads = len(x) if x.ndim else 0
    fits = x.shape == (n_loads, n_modes) and y.shape == (n_loads, n_pads)
    if not n_loads or not fits:
        raise FitError(
            f"loads have shape {x.shape} and readings {y.shape}; layout {structure.layout.name!r} "
            f"needs (loads, {n_modes}) and (loads, {n_pads}) with at least one load"
        )
    _refuse_unknown("load", x, structure.modes.names)
    _refuse_unknown("reading", y, structure.layout.pads)
    has_shape = sigma.shape in ((), (n_pads,))
    if not has_shape or not np.all(sigma > 0):
        raise FitError(
            f"noise is {sigma.tolist()}; it must be one number or {n_pads}, each above 0 Pa"
        )
    if not np.any(x):
        raise FitError("all loads are zero; record loads that press, shear or bend the skin")
    unknown = set(fixed) - set(structure.names)
    if unknown:
        raise FitError(
            f"unknown fixed coefficients {sorted(unknown)}; "
            f"the coefficients are {', '.join(structure.names)}"
        )
    return x, y, np.broadcast_to(sigma, (n_pads,))


def _refuse_unknown(
    kind: str,
    values: Array,
    columns: tuple[str, ...],
) -> None:
    """Raise FitError if a value is not finite; the error names the first such value.

    Args:
        kind: What a row of the values is called in the error, such as "load".
        values: Values (N, columns).
        columns: Names of the columns.
    """
    invalid = np.argwhere(~np.isfinite(values))
    for row, column in invalid.tolist():
        raise FitError(
            f"{kind} {row + 1}, {columns[column]}: {values[row, column]}; "
            "correct or remove this row"
        )


def _cross_validate(
    model: _Model,
    design: Array,
    y: Array,
    is_used: Mask,
) -> float:
    """Measure the error of the fit on loads that it does not know (cross-validation).

    Args:
        model: The model.
        design: Result of `_Model.compute_design` for the loads (N, P, K), in Pa.
        y: Measured pad stresses (N, P), in Pa.
        is_used: Whether a reading (stress on a pad under a load) is no outlier (N, P).

    Returns:
        Ratio of the rms error of predicted pad stresses to the rms of measured ones; NaN with fewer
        than two loads.
    """
    used = y[is_used]
    if len(y) < 2 or not used.any():
        return float("nan")
    n_folds = min(FOLDS, len(y))
    errors = np.empty_like(y)
    # Successive loads go to different parts, because tables often hold similar loads one after the
    # other.
    fold = np.arange(len(y)) % n_folds
    for k in range(n_folds):
        is_out = fold == k
        is_in = ~is_out
        theta, _, _ = model.solve(design[is_in], y[is_in])
        predicted = model.predict(theta, design[is_out])
        errors[is_out] = y[is_out] - predicted
    # Outliers are excluded, because they would dominate the mean squares of errors and readings.
    mean_square_error = np.mean(errors[is_used] ** 2)
    mean_square_reading = np.mean(used**2)
    return float(np.sqrt(mean_square_error / mean_square_reading))


def _advise(
    model: _Model,
    theta: Array,
    x: Array,
    null: Array,
    is_open: Mask,
) -> list[str]:
    """Find loads to add, so that all loads together determine all coefficients of the response.

    Each advised load has a single mode (linear stress field).

    Args:
        model: The model.
        theta: Fitted parameters (coefficients, then coordinates of the gains).
        x: Amplitudes of the modes of the given loads (N, M), in Pa.
        null: H independent changes of the parameters (parameters, H) that change no reading (stress
            on a pad under a load).
        is_open: For each coefficient that is not fixed, whether the loads leave it undetermined.

    Returns:
        One sentence for each load to add.
    """
    advice = []
    free = [model.structure.names[k] for k in model.free]
    # As an array of objects, the names can be selected with a mask.
    names = np.array(free, dtype=object)
    theta = theta.copy()
    # If an unknown coefficient was 0, it would cause no stress on its pads, and the gains of these
    # pads would seem undetermined, too. Any other value avoids this.
    theta[: len(names)][is_open] = 0.5
    # Each load that the user is advised to add has the rms amplitude of the given loads, because
    # amplitudes of this size gave large enough signals.
    amplitudes = x[x != 0]
    size = np.sqrt(np.mean(amplitudes**2))
    single_modes = size * np.eye(x.shape[1])
    loads = x
    while is_open.any():
        results = []
        for mode, load in enumerate(single_modes):
            candidate = np.vstack([loads, load])
            jacobian = model.compute_jacobian(theta, model.compute_design(candidate))
            new_null = find_null_space(jacobian)
            new_open = find_undetermined(new_null, len(names))
            # The best load leaves the fewest coefficients undetermined. Among loads that are equal
            # in this, it leaves the fewest independent changes of parameters without effect on any
            # reading.
            left = (new_open.sum(), new_null.shape[1], mode)
            results.append((left, candidate, new_null, new_open))
        best = min(results, key=itemgetter(0))
        (_, n_left, mode), loads, new_null, new_open = best
        if n_left >= null.shape[1]:
            advice.append(
                f"no load determines {', '.join(names[is_open])}: "
                "give them as fixed, or choose a larger symmetry"
            )
            break
        # The sentence for this load names the coefficients that become determined if the load is
        # added. If none does before a load of a later sentence is added, too, it names all that are
        # still undetermined.
        settled = names[is_open & ~new_open]
        subject = settled if len(settled) else names[is_open]
        name = model.structure.modes.names[mode]
        advice.append(
            f"these loads do not determine {', '.join(subject)}: add a load of {name} "
            f"alone, {describe_mode(name)}, of about {size:.3g} Pa"
        )
        null, is_open = new_null, new_open
    return advice


def describe_mode(name: str) -> str:
    """Return a mode (linear stress field) in words: for "zz_x", "sigma_zz growing along x"."""
    terms = []
    for part in name.split("-"):
        place = f" growing along {part[3]}" if "_" in part else ", uniform"
        terms.append(f"sigma_{part[:2]}{place}")
    return " against ".join(terms)
