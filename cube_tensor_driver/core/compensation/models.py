# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Values of effects on the pads that are no load, as blocks of a calibration.

P is the number of pads of the cube. Stresses on pads are without the pads' gains (relative
sensitivities), like the response matrix, so that a model computed for the layout holds for each
cube; tension is positive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, ClassVar, TypeVar

import numpy as np

from ..arrays import Array
from ..errors import CalibrationError


@dataclass(frozen=True, eq=False)
class EffectModel:
    """Base class of the models, whose attributes are finite numbers of a stated number of axes.

    Attributes:
        key: Name of the block in the calibration.
        axes: Number of axes of each attribute. The first axis of arrays with two axes is the pads.

    Raises:
        CalibrationError: A value has the wrong shape, is not finite, or contradicts another.
    """

    key: ClassVar[str]
    axes: ClassVar[Mapping[str, int]]

    def __post_init__(self) -> None:
        shapes: dict[int, tuple[int, ...]] = {}
        for name, n_axes in self.axes.items():
            value = getattr(self, name)
            if value is None:
                continue
            try:
                array = np.array(value, dtype=float)
            except (TypeError, ValueError):
                raise CalibrationError(f"{self.key}: {name} is {value!r}; give numbers") from None
            if array.ndim != n_axes or not np.isfinite(array).all() or not array.size:
                raise CalibrationError(
                    f"{self.key}: {name} is {value!r}; it must be finite numbers "
                    f"with {n_axes} axes, one list per pad if there are two"
                )
            # Patterns of deviations may be more or fewer than the values that they are for.
            shape = array.shape[:1] if name == "ramp" else array.shape
            wanted = shapes.setdefault(n_axes, array.shape)[: len(shape)]
            if shape != wanted:
                raise CalibrationError(f"{self.key}: {name} has shape {shape}; it must be {wanted}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def n_pads(self) -> int:
        """Number of pads of the model."""
        name = next(name for name, n_axes in self.axes.items() if n_axes == 2)
        return len(getattr(self, name))

    def to_dict(self) -> dict[str, Any]:
        """Return the model as a table of numbers and lists, which `from_dict` reads."""
        values = ((name, getattr(self, name)) for name in self.axes)
        return {name: value.tolist() for name, value in values if value is not None}

    @classmethod
    def from_dict(cls: type[_Model], data: Any) -> _Model:
        """Construct a model from the plain types that `to_dict` returns.

        Raises:
            CalibrationError: A key is missing or unknown, or a value is invalid.
        """
        required = {item.name for item in fields(cls) if item.default is MISSING}
        if not isinstance(data, Mapping) or not required <= set(data) <= set(cls.axes):
            raise CalibrationError(
                f"{cls.key}: found {data!r}; it is a table of {', '.join(cls.axes)}"
            )
        return cls(**data)


_Model = TypeVar("_Model", bound=EffectModel)


@dataclass(frozen=True, eq=False)
class WeightModel(EffectModel):
    """Response of the pads to weight and inertia of the cube and of the elastomer around it.

    Attributes:
        response: Stress on each pad per specific force along x, y and z of the cube's frame (P, 3),
            in Pa per m/s². The specific force is what an accelerometer measures: acceleration
            minus gravity, so 9.81 m/s² upwards at rest.
        deviation: Standard deviation of `response` (P, 3); None: it is not known.
    """

    key = "weight"
    axes: ClassVar[Mapping[str, int]] = {"response": 2, "deviation": 2}

    response: Array
    deviation: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.response.shape[1] != 3:
            raise CalibrationError(
                f"weight: response has shape {self.response.shape}; it must be (pads, 3)"
            )


@dataclass(frozen=True, eq=False)
class CreepModel(EffectModel):
    """Linear viscoelastic law of the foam of each pad: a generalised Maxwell body.

    The reading u of a pad is its strain times the modulus that it has at once. If a strain lasts
    for the time t, the stress relaxes to u (1 - sum_k amplitude_pk (1 - exp(-t / time_k))).

    Attributes:
        time: Relaxation times (K,), in s, in rising order.
        amplitude: Amplitudes of each pad (P, K), relative to the stress at once.
        deviation: Patterns (S, P, K) of one standard deviation of `amplitude` each, which are
            independent of each other; None: they are not known.
    """

    key = "creep"
    axes: ClassVar[Mapping[str, int]] = {"time": 1, "amplitude": 2, "deviation": 3}

    time: Array
    amplitude: Array
    deviation: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = len(self.amplitude), len(self.time)
        deviation = np.zeros((0, *shape)) if self.deviation is None else self.deviation
        if self.amplitude.shape != shape or deviation.shape[1:] != shape:
            raise CalibrationError(
                f"creep: amplitude and deviation have the shapes {self.amplitude.shape} and "
                f"{deviation.shape}; give {len(self.time)} numbers per pad, one for each time"
            )
        if (np.diff(self.time, prepend=0) <= 0).any() or (self.amplitude.sum(axis=1) >= 1).any():
            raise CalibrationError(
                "creep: times must be above 0 and rise, and amplitudes of a pad add up to less "
                "than 1, or the foam would flow away under a load"
            )


@dataclass(frozen=True, eq=False)
class ThermalModel(EffectModel):
    """Reading of each pad over temperature without load, in place, with the lag of the elastomer.

    It contains the drift of the electronics and the thermal stress that the expansion of the
    elastomer causes, so the readings are with the pads' gains. With u the measured temperature
    minus `reference` after a low-pass filter, pad p reads sum_d coefficient_pd u^d, d = 1, 2, ...

    Attributes:
        reference: Temperature, in °C, at which the rest frequencies of the calibration hold.
        lag: Time constants (L,), in s, of low-pass filters in a row, all different; 0: no lag.
        coefficient: Coefficients of each pad (P, D), in Pa/K^d, the linear term first.
        deviation: Standard deviation of `coefficient` (P, D), which is common to all pads up to its
            sign; None: it is not known.
        ramp: Patterns (P, K) of one standard deviation each, in Pa per K by which the temperature
            after the filter lags behind the measured one; None: they are not known.
    """

    key = "thermal"
    axes: ClassVar[Mapping[str, int]] = {
        "reference": 0,
        "lag": 1,
        "coefficient": 2,
        "deviation": 2,
        "ramp": 2,
    }

    reference: Array
    lag: Array
    coefficient: Array
    deviation: Array | None = None
    ramp: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(np.unique(self.lag)) < len(self.lag) or self.lag.min() < 0:
            raise CalibrationError(
                f"thermal: lag is {self.lag.tolist()} s; time constants are different, at least 0"
            )
