"""Fit of a calibration to known loads: the symmetric coefficients, and one gain per pad.

    v_np = g_p sum_k c_k (B_k s_n)_p + noise

    s_n   known state of load n
    v_np  stress that pad p measured under load n
    B_k   basis matrices of the structure
    c_k   coefficients
    g_p   gains

Only the product of g and c is determined by loads. So gains average 1 over each set of pads that
the symmetry maps onto each other. The fit takes Gauss-Newton steps on weighted residuals: with
equal weights, then with Huber's, and at last with Tukey's, which ignore outliers altogether.

Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array, Mask
from ..core.calibration import Calibration
from ..core.errors import FitError
from ..core.modes import Modes
from ..core.oscillator import pad_stress
from ..core.symmetry import Structure
from .robust import (
    MAX_STEPS,
    STAGES,
    compute_weights,
    estimate_scatter,
    find_undetermined,
    least_squares,
    null_space,
    robust_covariance,
)

FOLDS = 10
"""Number of parts of the cross-validation; each part is left out once."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit to N loads.

    Attributes:
        structure: Structure of the response.
        coefficients: Values by name, in Pa per Pa; NaN where the loads do not determine them.
        deviations: Standard deviations by name, in Pa per Pa.
        covariance: Covariance (K, K) of the coefficients.
        gain, gain_deviation: Gains and their standard deviations (P,).
        scale: Scatter of the residuals, in units of the stated noise.
        chi2, dof: Chi-square and its degrees of freedom, of the readings that are no outliers.
        held_out: Ratio of the rms error on loads that are left out of the fit (cross-validation) to
            the rms reading, without outliers.
        fitted: Fitted pad stresses (N, P), in Pa.
        outliers: Which readings had no weight (N, P).
        undetermined: Names of the coefficients that the loads do not determine.
        advice: Sentences that tell which loads to add.
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

    def calibration(
        self,
        base: Calibration,
        created: str = "",
        source: str = "",
    ) -> Calibration:
        """Return a calibration with the fitted values.

        Args:
            base: Calibration with all other values. Its noise is raised to the scatter found.
            created: Time of creation, ISO 8601.
            source: Origin of the values.

        Raises:
            FitError: Coefficients are undetermined. Add the loads of `advice`, or give the
                coefficients as `fixed`.
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


def measured_stress(
    base: Calibration,
    frequency: ArrayLike,
    temperature: Array | None = None,
) -> Array:
    """Compute pad stresses (N, P), in Pa, by the pad law of a calibration.

    Args:
        base: Calibration with the pad law and the rest frequencies.
        frequency: Frequencies (N, P), in Hz.
        temperature: Temperatures (N,), in °C, if they are known.

    Raises:
        FitError: The shape is wrong, or a frequency is outside the range of the pad law.
    """
    f = np.asarray(frequency, dtype=float)
    if f.ndim != 2 or f.shape[1] != base.layout.n_pads:
        raise FitError(
            f"frequencies have shape {f.shape}; layout {base.layout.name!r} needs "
            f"(loads, {base.layout.n_pads})"
        )
    rest = base.rest_frequency
    if base.temperature is not None and temperature is not None:
        rest = rest * base.temperature.factor(temperature)
    v = pad_stress(f, rest, base.beta, base.modulus)
    for load, pad in np.argwhere(~np.isfinite(v)).tolist():
        raise FitError(
            f"load {load + 1}, pad {base.layout.pads[pad]}: {f[load, pad]:g} Hz is outside the "
            "pad's range; correct or remove this row"
        )
    return v


def loads_from_forces(
    modes: Modes,
    force: ArrayLike,
    area: float,
) -> Array:
    """Compute the states of forces that a reference sensor measured on the face +z.

    The stress is uniform in zz, yz and zx. The stresses along the skin are taken as 0, because
    nothing holds the layer sideways.

    Args:
        modes: The M modes.
        force: Forces (N, 3), in N.
        area: Area that the forces act on, in m².

    Returns:
        States (N, M), in Pa.

    Raises:
        FitError: The shape is wrong, or the area is not above 0.
    """
    f = np.asarray(force, dtype=float)
    if f.ndim != 2 or f.shape[1] != 3 or not area > 0:
        raise FitError(
            f"forces have shape {f.shape} and the area is {area} m^2; "
            "needed are (loads, 3) and above 0"
        )
    stress = np.zeros((len(f), 6))
    zx_yz_zz = [4, 3, 2]
    stress[:, zx_yz_zz] = f / area
    return modes.state(stress)


def fit(
    structure: Structure,
    loads: ArrayLike,
    measured: ArrayLike,
    noise: ArrayLike = 1.0,
    fixed: Mapping[str, float] | None = None,
    gains: bool = True,
) -> Fit:
    """Fit coefficients and gains to loads.

    Args:
        structure: Structure of the response.
        loads: Known states (N, M), in Pa.
        measured: Measured pad stresses (N, P), in Pa.
        noise: Standard deviation of the readings, one number or (P,), in Pa.
        fixed: Coefficients that are known from elsewhere, by name.
        gains: Whether gains are fitted. False takes every gain as 1, for loads that reach too few
            pads to separate gains from coefficients.

    Raises:
        FitError: Shapes or numbers are invalid, all loads are zero, or the loads determine no
            coefficient at all.
    """
    fixed = dict(fixed or {})
    x, y, sigma = _check_inputs(structure, loads, measured, noise, fixed)
    model = _Model(structure, sigma, fixed, gains)
    design = model.design(x)
    theta, weights, scale = model.solve(design, y)

    jacobian = model.jacobian(theta, design)
    null = null_space(jacobian)
    n_free = len(model.free)
    is_open = find_undetermined(null, n_free)
    names = [structure.names[k] for k in model.free]
    advice = _advise(model, theta, x, null, is_open)
    if names and is_open.all():
        raise FitError(f"these loads determine no coefficient: {'; '.join(advice)}")

    residuals = model.residuals(theta, design, y) / scale
    covariance = robust_covariance(jacobian, residuals, scale)
    # The pseudo-inverse gives undetermined coefficients a small variance, which means nothing.
    covariance[:n_free][is_open] = np.nan
    covariance[:, :n_free][:, is_open] = np.nan
    # Fixed coefficients have no error.
    n = structure.n_coefficients
    of_coefficients = np.zeros((n, n))
    free = np.array(model.free, dtype=int)
    of_coefficients[np.ix_(free, free)] = covariance[:n_free, :n_free]
    of_coordinates = covariance[n_free:, n_free:]
    of_gains = model.gains @ of_coordinates @ model.gains.T
    coefficients, gain = model.unpack(theta)
    coefficients[free[is_open]] = np.nan
    deviations = np.sqrt(np.diag(of_coefficients))
    # Rounding can make the variance of a gain without error slightly negative.
    gain_variance = np.diag(of_gains).clip(0)

    fitted = model.predict(theta, design)
    is_used = weights > 0
    whitened = (y - fitted) / sigma
    n_determined = jacobian.shape[1] - null.shape[1]
    return Fit(
        structure=structure,
        coefficients=dict(zip(structure.names, coefficients.tolist(), strict=True)),
        deviations=dict(zip(structure.names, deviations.tolist(), strict=True)),
        covariance=of_coefficients,
        gain=gain,
        gain_deviation=np.sqrt(gain_variance),
        scale=float(scale),
        chi2=float(np.sum(whitened[is_used] ** 2)),
        dof=int(is_used.sum()) - n_determined,
        held_out=_cross_validate(model, design, y, is_used),
        fitted=fitted,
        outliers=~is_used,
        undetermined=tuple(np.array(names, dtype=object)[is_open]),
        advice=tuple(advice),
    )


class _Model:
    """The model whose parameters theta are the free coefficients, then coordinates of the gains.

    Attributes:
        free: Numbers of the coefficients that are not fixed.
        gains: Changes of the gains (P, G) per coordinate. Each raises one pad and lowers the first
            pad of its orbit, which keeps the average at 1.
    """

    def __init__(
        self,
        structure: Structure,
        noise: Array,
        fixed: Mapping[str, float],
        gains: bool,
    ) -> None:
        self.structure, self.noise = structure, noise
        self.free = [k for k, name in enumerate(structure.names) if name not in fixed]
        values = [fixed.get(name, 0.0) for name in structure.names]
        self._fixed = np.array(values, dtype=float)
        n_pads = structure.layout.n_pads
        columns = []
        for first, *others in structure.pad_orbits if gains else ():
            for pad in others:
                column = np.zeros(n_pads)
                column[pad], column[first] = 1, -1
                columns.append(column)
        # The reshape gives an empty matrix its width if there are no gains to fit.
        self.gains: Array = np.array(columns).reshape(-1, n_pads).T

    def unpack(self, theta: Array) -> tuple[Array, Array]:
        """Return the coefficients (K,), including fixed ones, and the gains (P,) of parameters."""
        coefficients = self._fixed.copy()
        coefficients[self.free] = theta[: len(self.free)]
        coordinates = theta[len(self.free) :]
        return coefficients, 1 + self.gains @ coordinates

    def design(self, x: Array) -> Array:
        """Return what each coefficient adds to each reading (N, P, K) for loads (N, M), at gain
        1."""
        by_coefficient = np.tensordot(x, self.structure.basis, axes=(1, 2))
        return np.moveaxis(by_coefficient, 1, 2)

    def predict(self, theta: Array, design: Array) -> Array:
        """Return the predicted readings (N, P), in Pa."""
        coefficients, gain = self.unpack(theta)
        readings: Array = gain * (design @ coefficients)
        return readings

    def residuals(
        self,
        theta: Array,
        design: Array,
        y: Array,
    ) -> Array:
        """Return the whitened residuals (N P,)."""
        difference = y - self.predict(theta, design)
        residuals: Array = difference / self.noise
        return residuals.ravel()

    def jacobian(self, theta: Array, design: Array) -> Array:
        """Return the derivatives (N P, parameters) of the whitened predictions."""
        coefficients, gain = self.unpack(theta)
        by_coefficient = design[:, :, self.free] * gain[:, None]
        at_gain_1 = design @ coefficients
        by_gain = at_gain_1[:, :, None] * self.gains
        derivatives = np.concatenate([by_coefficient, by_gain], axis=2)
        whitened: Array = derivatives / self.noise[:, None]
        return whitened.reshape(-1, theta.size)

    def solve(self, design: Array, y: Array) -> tuple[Array, Array, float]:
        """Fit the parameters.

        Returns:
            Parameters, weights of the readings (N, P), and scatter in units of the noise.
        """
        n_parameters = len(self.free) + self.gains.shape[1]
        theta = np.zeros(n_parameters)
        weights = np.ones(y.size)
        scale = 1.0
        for stage, tolerance in STAGES.items():
            for _ in range(MAX_STEPS):
                r = self.residuals(theta, design, y)
                if stage == "huber":
                    # Tukey's stage keeps the last scale, without which it might not settle.
                    scale = estimate_scatter(r)
                if stage != "plain":
                    weights = compute_weights(stage, r / scale)
                # Rows times the roots of their weights make a weighted least squares problem.
                root = np.sqrt(weights)
                weighted = root[:, None] * self.jacobian(theta, design)
                step = least_squares(weighted, root * r)
                theta = theta + step
                # The 1 makes the tolerance absolute for parameters near 0.
                limit = tolerance * (1 + np.linalg.norm(theta))
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
    """Return loads (N, M), readings (N, P) and noise (P,). FitError: see `fit`."""
    n_pads, n_modes = structure.basis.shape[1:]
    try:
        x, y, sigma = (np.array(values, dtype=float) for values in (loads, measured, noise))
    except (TypeError, ValueError):
        raise FitError("loads, measured stresses and noise must be numbers") from None
    has_loads = x.ndim == 2 and len(x) > 0 and x.shape[1] == n_modes
    if not has_loads or y.shape != (len(x), n_pads):
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
    """Raise FitError that names the first value that is not finite."""
    for row, column in np.argwhere(~np.isfinite(values)).tolist():
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
    """Return the ratio of the rms error on loads that are left out to the rms reading."""
    if len(y) < 2 or not np.any(y[is_used]):
        return float("nan")
    errors = np.empty_like(y)
    # Loads are taken in turn, because tables often hold similar loads one after the other.
    fold = np.arange(len(y)) % min(FOLDS, len(y))
    for k in range(fold.max() + 1):
        is_out = fold == k
        theta, _, _ = model.solve(design[~is_out], y[~is_out])
        errors[is_out] = y[is_out] - model.predict(theta, design[is_out])
    # Outliers would dominate both means.
    mean_square_error = np.mean(errors[is_used] ** 2)
    mean_square_reading = np.mean(y[is_used] ** 2)
    return float(np.sqrt(mean_square_error / mean_square_reading))


def _advise(
    model: _Model,
    theta: Array,
    x: Array,
    null: Array,
    is_open: Mask,
) -> list[str]:
    """Find loads of a single mode that would determine the undetermined coefficients.

    Args:
        model: The model.
        theta: Fitted parameters.
        x: Loads (N, M), in Pa.
        null: Directions of the parameters that change no reading.
        is_open: Which free coefficients the loads do not determine.

    Returns:
        One sentence for each load to add.
    """
    advice = []
    # As arrays of objects, names can be selected with masks.
    free = np.array(model.free, dtype=int)
    names = np.array(model.structure.names, dtype=object)[free]
    theta = theta.copy()
    # At the value 0 of a coefficient, the gains of the new load would seem undetermined.
    theta[: len(names)][is_open] = 0.5
    # The advised loads are as large as those given, with which the fit was good.
    size = np.sqrt(np.mean(x[x != 0] ** 2))
    single_modes = size * np.eye(x.shape[1])
    loads = x
    while is_open.any():
        candidates = [np.vstack([loads, load]) for load in single_modes]
        designs = [model.design(candidate) for candidate in candidates]
        null_spaces = [null_space(model.jacobian(theta, design)) for design in designs]
        opens = [find_undetermined(each, len(names)) for each in null_spaces]
        # The best load determines most coefficients, then most directions of the parameters.
        left = [
            (open_.sum(), each.shape[1]) for open_, each in zip(opens, null_spaces, strict=True)
        ]
        best = left.index(min(left))
        if null_spaces[best].shape[1] >= null.shape[1]:
            advice.append(
                f"no load determines {', '.join(names[is_open])}: "
                "give them as fixed, or choose a larger symmetry"
            )
            break
        # A load may determine a gain first, and a coefficient only together with the next load.
        settled = names[is_open & ~opens[best]]
        subject = settled if len(settled) else names[is_open]
        mode = model.structure.modes.names[best]
        advice.append(
            f"these loads do not determine {', '.join(subject)}: add a load of {mode} "
            f"alone, {describe_mode(mode)}, of about {size:.3g} Pa"
        )
        loads, null, is_open = candidates[best], null_spaces[best], opens[best]
    return advice


def describe_mode(name: str) -> str:
    """Return a mode's name in words, such as "sigma_zz growing along x"."""
    terms = []
    for part in name.split("-"):
        place = f" growing along {part[3]}" if "_" in part else ", uniform"
        terms.append(f"sigma_{part[:2]}{place}")
    return " against ".join(terms)
