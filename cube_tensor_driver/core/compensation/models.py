# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Models of the effects on the pads that are no load, as blocks of a calibration.

P is the number of pads of the cube; tension is positive. The stresses that `WeightModel` states do
not include the pads' gains (relative sensitivities), so that a model computed for the layout holds
for each cube. Those that `ThermalModel` states include the gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import ClassVar, TypeVar

import numpy as np

from ..arrays import Array
from ..errors import CalibrationError


@dataclass(frozen=True, eq=False)
class EffectModel:
    """Base class of the models of weight, creep and temperature, which act on pads without a load.

    The attributes of a model are arrays of finite numbers.

    Attributes:
        key: Name of the model's block in a calibration file.
        axes: A letter for each axis of each attribute, by its name. Axes with the same letter have
            the same length; P is the number of pads, and a digit is the length itself.

    Raises:
        CalibrationError: A value has the wrong shape, is not finite, or contradicts another.
    """

    key: ClassVar[str]
    axes: ClassVar[Mapping[str, str]]

    def __post_init__(self) -> None:
        lengths = {"3": 3}
        for name, axes in self.axes.items():
            value = getattr(self, name)
            if value is None:
                continue
            try:
                array = np.array(value, dtype=float)
            except (TypeError, ValueError):
                raise CalibrationError(f"{self.key}: {name} is {value!r}; give numbers") from None
            is_finite = np.isfinite(array).all()
            if array.ndim != len(axes) or not is_finite or not array.size:
                raise CalibrationError(
                    f"{self.key}: {name} is {value!r}; it must be finite numbers "
                    f"with {len(axes)} axes, one list per pad if there are two"
                )
            shape = array.shape
            wanted = tuple(map(lengths.setdefault, axes, shape))
            if shape != wanted:
                raise CalibrationError(f"{self.key}: {name} has shape {shape}; it must be {wanted}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def n_pads(self) -> int:
        """Number of pads of the model."""
        per_pad = [name for name, axes in self.axes.items() if axes.startswith("P")]
        values = getattr(self, per_pad[0])
        return len(values)

    def to_dict(self) -> dict[str, object]:
        """Return the model as a table of numbers and lists, which `from_dict` reads."""
        table: dict[str, object] = {}
        for name in self.axes:
            value = getattr(self, name)
            if value is not None:
                table[name] = value.tolist()
        return table

    @classmethod
    def from_dict(cls: type[_Model], data: object) -> _Model:
        """Construct a model from the plain types that `to_dict` returns.

        Raises:
            CalibrationError: A key is missing or unknown, or a value is invalid.
        """
        required = {item.name for item in fields(cls) if item.default is MISSING}
        allowed = set(cls.axes)
        if not isinstance(data, Mapping) or not required <= set(data) <= allowed:
            raise CalibrationError(
                f"{cls.key}: found {data!r}; it is a table of {', '.join(cls.axes)}"
            )
        return cls(**data)


_Model = TypeVar("_Model", bound=EffectModel)


def tabulate(
    models: Sequence[EffectModel | None],
    name: str,
    shape: tuple[int, ...],
) -> Array:
    """Return an attribute of the models of C cubes as a table (C, ...).

    It is 0 where a cube has no model, or its attribute has fewer entries than that of others.

    Args:
        models: Models of the cubes.
        name: Name of the attribute.
        shape: Smallest shape of the attribute in the table.
    """
    values = {cube: getattr(model, name, None) for cube, model in enumerate(models)}
    stated = {cube: value for cube, value in values.items() if value is not None}
    largest = np.max([shape, *(value.shape for value in stated.values())], axis=0)
    table = np.zeros((len(models), *largest.astype(int)))
    for cube, value in stated.items():
        part: tuple[int | slice, ...] = (cube, *map(slice, value.shape))
        table[part] = value
    return table


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
    axes: ClassVar[Mapping[str, str]] = {"response": "P3", "deviation": "P3"}

    response: Array
    deviation: Array | None = None


@dataclass(frozen=True, eq=False)
class CreepModel(EffectModel):
    """Linear viscoelastic law of the foam of each pad: a generalised Maxwell body.

    The reading u of a pad is its strain times its instantaneous modulus. If a strain is held for
    the time t, the stress relaxes from u to u (1 - sum_k amplitude_pk (1 - exp(-t / time_k))).

    Attributes:
        time: Relaxation times (K,), in s, in rising order.
        amplitude: Amplitudes of each pad (P, K), relative to the instantaneous stress.
        deviation: Errors of `amplitude` by S independent causes (S, P, K), each with the size of
            one standard deviation; None: they are not known.
    """

    key = "creep"
    axes: ClassVar[Mapping[str, str]] = {"time": "K", "amplitude": "PK", "deviation": "SPK"}

    time: Array
    amplitude: Array
    deviation: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        steps = np.diff(self.time, prepend=0)
        total = self.amplitude.sum(axis=1)
        if (steps <= 0).any() or (total >= 1).any():
            raise CalibrationError(
                "creep: times must be above 0 and rise, and amplitudes of a pad add up to less "
                "than 1, or the foam would flow away under a load"
            )


@dataclass(frozen=True, eq=False)
class ThermalModel(EffectModel):
    """Stress, in Pa, that each pad of a cube in the skin measures without load, over temperature.

    It contains the drift of the electronics and the thermal stress that the expansion of the
    elastomer causes, both including the gains (relative sensitivities) of the pads. The elastomer
    lags behind the thermometer. Pad p measures::

        sum_d coefficient_pd u^d + sum_l lagging_pl (T - x_l),      d = 1, 2, ...

    T is the measured temperature and x_l the output of low-pass filter l. u is the mean of x_l
    minus `reference`, or, without `lagging`, the output of the filters in series minus `reference`.

    Attributes:
        reference: Temperature, in °C, at which the rest frequencies of the calibration hold.
        lag: Time constants (L,), in s, of low-pass filters, all different; 0: no lag.
        coefficient: Coefficients of each pad (P, D), in Pa/K^d, the linear term first.
        deviation: Standard deviations of `coefficient` (P, D). The errors of all pads in a column
            are fully correlated; pads with equal signs err in the same direction. None: unknown.
        ramp: Errors of the pads' stresses by K independent causes (P, K), each with the size of one
            standard deviation, in Pa per K of difference between the measured and the filtered
            temperature; None: they are not known.
        lagging: Coefficients of each pad and filter (P, L), in Pa/K; None: the filters are in
            series.
    """

    key = "thermal"
    axes: ClassVar[Mapping[str, str]] = {
        "reference": "",
        "lag": "L",
        "coefficient": "PD",
        "deviation": "PD",
        "ramp": "PK",
        "lagging": "PL",
    }

    reference: Array
    lag: Array
    coefficient: Array
    deviation: Array | None = None
    ramp: Array | None = None
    lagging: Array | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        n_different = len(np.unique(self.lag))
        if n_different < len(self.lag) or self.lag.min() < 0:
            raise CalibrationError(
                f"thermal: lag is {self.lag.tolist()} s; time constants are different, at least 0"
            )
