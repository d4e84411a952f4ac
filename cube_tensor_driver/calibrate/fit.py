"""Fit of a calibration from recorded loads: the symmetric coefficients and one gain per pad.

    v_np = g_p sum_k c_k (B_k s_n)_p + noise

s_n: known state of load n, v_np: stress that pad p showed, B_k: basis of the structure. The product
of g and c is settled by gains that average 1 over each set of pads that the symmetry carries onto
each other. Solved by Gauss-Newton steps on weighted residuals: Huber's weights first, then Tukey's,
which forget outliers altogether.
Source: Huber & Ronchetti, Robust Statistics, ch. 7, also for the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..core.calibration import Calibration
from ..core.errors import FitError
from ..core.modes import Modes
from ..core.oscillator import pad_stress
from ..core.symmetry import Structure
from .robust import (
    STAGES,
    STEPS,
    hidden_directions,
    least_squares,
    robust_covariance,
    scatter,
    touched,
    weights_of,
)

FOLDS = 10
"""Of the cross-validation."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What loads say about a structure.

    coefficients, deviations: {name: value} and standard deviations, Pa per Pa; NaN where the loads
        do not determine them
    covariance: (K, K) of the coefficients
    gain, gain_deviation: (P,)
    scale: scatter found, in units of the stated noise
    chi2, dof: over the readings that are not outliers
    held_out: rms error on loads left out of the fit over rms reading (cross-validation), without
        outliers
    fitted: (N, P) Pa
    outliers: (N, P) bool, readings that had no weight
    undetermined: names of coefficients that these loads leave open
    advice: which loads to add, in words
    """

    structure: Structure
    coefficients: dict[str, float]
    deviations: dict[str, float]
    covariance: np.ndarray
    gain: np.ndarray
    gain_deviation: np.ndarray
    scale: float
    chi2: float
    dof: int
    held_out: float
    fitted: np.ndarray
    outliers: np.ndarray
    undetermined: tuple[str, ...]
    advice: tuple[str, ...]

    def calibration(self, base: Calibration, created: str = "", source: str = "") -> Calibration:
        """base with what was fitted, and with its noise raised to the scatter found.

        FitError when coefficients are undetermined: add the loads of `advice`, or give them as
        `fixed`.
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
    base: Calibration, frequency: np.ndarray, temperature: np.ndarray | None = None
) -> np.ndarray:
    """(N, P) Pa from frequencies (N, P) by a calibration's pad law; FitError names one out of
    range."""
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
    if not np.all(np.isfinite(v)):
        n, p = np.argwhere(~np.isfinite(v))[0]
        raise FitError(
            f"load {n + 1}, pad {base.layout.pads[p]}: {f[n, p]:g} Hz is outside the pad's range; "
            "correct or remove this row"
        )
    return v


def traction_loads(modes: Modes, force: np.ndarray, area: float) -> np.ndarray:
    """(N, M) states for forces (N, 3) in N of a reference sensor over an area in m^2 of the face
    +z.

    Uniform zz, yz and zx; the stresses along the skin are taken as 0: nothing holds the layer
    sideways.
    """
    f = np.asarray(force, dtype=float)
    if f.ndim != 2 or f.shape[1] != 3 or not area > 0:
        raise FitError(
            f"forces have shape {f.shape} and the area is {area} m^2; "
            "needed are (loads, 3) and above 0"
        )
    stress = np.zeros((len(f), 6))
    stress[:, [4, 3, 2]] = f / area
    return modes.state(stress)


def fit(
    structure: Structure,
    loads: np.ndarray,
    measured: np.ndarray,
    noise: np.ndarray | float = 1.0,
    fixed: Mapping[str, float] | None = None,
    gains: bool = True,
) -> Fit:
    """Coefficients and gains from loads (N, M) in Pa and measured pad stresses (N, P) in Pa.

    noise: standard deviation of the readings in Pa, one or (P,)
    fixed: coefficients known from elsewhere
    gains: False takes every gain as 1, for loads that reach too few pads to separate gains from
        coefficients
    FitError: wrong shapes, NaN, loads of zero, or loads that determine no coefficient at all.
    """
    fixed = dict(fixed or {})
    x, y, sigma = _check(structure, loads, measured, noise, fixed)
    model = _Model(structure, sigma, fixed, gains)
    design = model.design(x)
    theta, weights, scale = model.solve(design, y)
    jacobian = model.jacobian(theta, design)
    hidden = hidden_directions(jacobian)
    open_ = touched(hidden, len(model.free))
    names = [structure.names[k] for k in model.free]
    if len(names) and open_.all():
        raise FitError(
            "these loads determine no coefficient: "
            + "; ".join(_advise(model, theta, x, hidden, open_))
        )
    covariance = robust_covariance(jacobian, model.residuals(theta, design, y) / scale, scale)
    covariance[: len(names)][open_] = covariance[:, : len(names)][:, open_] = np.nan
    k = np.full((structure.n_coefficients,) * 2, 0.0)
    k[np.ix_(model.free, model.free)] = covariance[: len(names), : len(names)]
    c, g = model.unpack(theta)
    c[np.array(model.free, dtype=int)[open_]] = np.nan
    spread = model.gains @ covariance[len(names) :, len(names) :] @ model.gains.T
    fitted = model.predict(theta, design)
    kept = weights > 0
    return Fit(
        structure,
        dict(zip(structure.names, c.tolist(), strict=True)),
        dict(zip(structure.names, np.sqrt(np.diag(k)).tolist(), strict=True)),
        k,
        g,
        np.sqrt(np.diag(spread).clip(0)),
        float(scale),
        float(np.sum(((y - fitted) / sigma)[kept] ** 2)),
        int(kept.sum()) - (jacobian.shape[1] - hidden.shape[1]),
        _held_out(model, design, y, kept),
        fitted,
        ~kept,
        tuple(n for n, o in zip(names, open_, strict=True) if o),
        tuple(_advise(model, theta, x, hidden, open_)),
    )


class _Model:
    """theta = free coefficients, then coordinates of the gains around 1."""

    def __init__(
        self, structure: Structure, noise: np.ndarray, fixed: Mapping[str, float], gains: bool
    ) -> None:
        self.structure, self.noise = structure, noise
        self.free = [k for k, name in enumerate(structure.names) if name not in fixed]
        self.start = np.array([fixed.get(name, 0.0) for name in structure.names], dtype=float)
        columns = []
        for first, *others in structure.pad_orbits if gains else ():
            for pad in others:
                column = np.zeros(structure.layout.n_pads)
                column[pad], column[first] = 1, -1
                columns.append(column)
        self.gains = np.array(columns).reshape(-1, structure.layout.n_pads).T

    def unpack(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c = self.start.copy()
        c[self.free] = theta[: len(self.free)]
        return c, 1 + self.gains @ theta[len(self.free) :]

    def design(self, x: np.ndarray) -> np.ndarray:
        """(N, P, K): what each coefficient adds to each reading at gain 1, for loads (N, M)."""
        return np.moveaxis(np.tensordot(x, self.structure.basis, axes=(1, 2)), 1, 2)

    def predict(self, theta: np.ndarray, design: np.ndarray) -> np.ndarray:
        c, g = self.unpack(theta)
        return g * (design @ c)

    def residuals(self, theta: np.ndarray, design: np.ndarray, y: np.ndarray) -> np.ndarray:
        return ((y - self.predict(theta, design)) / self.noise).ravel()

    def jacobian(self, theta: np.ndarray, design: np.ndarray) -> np.ndarray:
        """(N P, parameters) derivatives of the whitened predictions."""
        c, g = self.unpack(theta)
        by_c = design[:, :, self.free] * g[:, None]
        by_g = (design @ c)[:, :, None] * self.gains
        return (np.concatenate([by_c, by_g], axis=2) / self.noise[:, None]).reshape(-1, theta.size)

    def solve(self, design: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """theta, the weights (N, P) of the readings, and the scatter in units of the noise."""
        theta = np.zeros(len(self.free) + self.gains.shape[1])
        weights, scale = np.ones(y.size), 1.0
        for stage, small in STAGES.items():
            for _ in range(STEPS):
                r = self.residuals(theta, design, y)
                if stage == "huber":  # the scale of the last stage stays, so that it settles
                    scale = scatter(r)
                if stage != "plain":
                    weights = weights_of(stage, r / scale)
                root = np.sqrt(weights)
                step = least_squares(root[:, None] * self.jacobian(theta, design), root * r)
                theta = theta + step
                if np.linalg.norm(step) <= small * (1 + np.linalg.norm(theta)):
                    break
        return theta, weights.reshape(y.shape), scale


def _check(structure, loads, measured, noise, fixed):
    n_pads, n_modes = structure.basis.shape[1:]
    try:
        x, y, noise = (np.array(a, dtype=float) for a in (loads, measured, noise))
    except (TypeError, ValueError):
        raise FitError("loads, measured stresses and noise must be numbers") from None
    if x.ndim != 2 or x.shape[1] != n_modes or y.shape != (len(x), n_pads) or not len(x):
        raise FitError(
            f"loads have shape {x.shape} and readings {y.shape}; layout {structure.layout.name!r} "
            f"needs (loads, {n_modes}) and (loads, {n_pads}) with at least one load"
        )
    for what, array, columns in (
        ("load", x, structure.modes.names),
        ("reading", y, structure.layout.pads),
    ):
        if not np.all(np.isfinite(array)):
            n, i = np.argwhere(~np.isfinite(array))[0]
            raise FitError(
                f"{what} {n + 1}, {columns[i]}: {array[n, i]}; correct or remove this row"
            )
    if noise.shape not in ((), (n_pads,)) or not np.all(noise > 0):
        raise FitError(
            f"noise is {noise.tolist()}; it must be one number or {n_pads}, each above 0 Pa"
        )
    if not np.any(x):
        raise FitError("all loads are zero; record loads that press, shear or bend the skin")
    unknown = set(fixed) - set(structure.names)
    if unknown:
        raise FitError(
            f"unknown fixed coefficients {sorted(unknown)}; "
            f"the coefficients are {', '.join(structure.names)}"
        )
    return x, y, np.broadcast_to(noise, (n_pads,))


def _held_out(model: _Model, design: np.ndarray, y: np.ndarray, kept: np.ndarray) -> float:
    if len(y) < 2 or not np.any(y[kept]):
        return float("nan")
    errors = np.empty_like(y)
    fold = np.arange(len(y)) % min(FOLDS, len(y))
    for k in range(fold.max() + 1):
        theta, _, _ = model.solve(design[fold != k], y[fold != k])
        errors[fold == k] = y[fold == k] - model.predict(theta, design[fold == k])
    return float(np.sqrt(np.mean(errors[kept] ** 2) / np.mean(y[kept] ** 2)))


def _advise(
    model: _Model, theta: np.ndarray, x: np.ndarray, hidden: np.ndarray, open_: np.ndarray
) -> list[str]:
    """Sentences that name single-mode loads, found greedily, which would determine what is open."""
    advice = []
    theta = theta.copy()
    # Any value: without one, the gains of the new load would seem undetermined.
    theta[: len(open_)][open_] = 0.5
    loads, size = x, np.sqrt(np.mean(x[x != 0] ** 2))
    while open_.any():
        trials = [np.vstack([loads, size * np.eye(x.shape[1])[m]]) for m in range(x.shape[1])]
        hiddens = [
            hidden_directions(model.jacobian(theta, model.design(trial))) for trial in trials
        ]
        counts = [(touched(h, len(open_)).sum(), h.shape[1]) for h in hiddens]
        best = min(range(len(counts)), key=counts.__getitem__)
        still = touched(hiddens[best], len(open_))
        names = [model.structure.names[k] for k, o in zip(model.free, open_, strict=True) if o]
        if hiddens[best].shape[1] >= hidden.shape[1]:
            advice.append(
                f"no load determines {', '.join(names)}: "
                "give them as fixed, or choose a larger symmetry"
            )
            break
        settled = [
            model.structure.names[k]
            for k, now, then in zip(model.free, open_, still, strict=True)
            if now and not then
        ]
        mode = model.structure.modes.names[best]
        advice.append(
            f"these loads do not determine {', '.join(settled or names)}: add a load of {mode} "
            f"alone, {describe_mode(mode)}, of about {size:.3g} Pa"
        )
        loads, hidden, open_ = trials[best], hiddens[best], still
    return advice


def describe_mode(name: str) -> str:
    """A mode's name in words, such as "sigma_zz growing along x"."""
    return " against ".join(
        f"sigma_{part[:2]}" + (f" growing along {part[3]}" if "_" in part else ", uniform")
        for part in name.split("-")
    )
