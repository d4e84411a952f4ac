# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration: the values that turn the frequencies of a cube into stress, with an id."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from .arguments import read_numbers
from .arrays import Array, stack_pad_table
from .compensation.models import CreepModel, EffectModel, ThermalModel, WeightModel
from .defaults import BETA, FOAM_MODULUS, FREQUENCY_NOISE, HALF_SIDE, REST_FREQUENCY
from .errors import CalibrationError, LayoutError, SymmetryError
from .layout import LAYOUTS, Layout, find_layout
from .modes import COMPONENTS, STRESS, Modes
from .oscillator import TemperatureModel
from .response import choose_illustrative_coefficients, compute_response
from .symmetry import Structure, choose_default_modes, find_largest_symmetry, find_structure

SCHEMA = 1
"""Version of the format of calibration files, which each file states under the key "schema"."""

MAX_UID = 2**64 - 1
"""Largest unique id of a cube, because a hub sends the id in 8 bytes."""

MAX_DRIFT = 0.01
"""Largest standard deviation of the common drift of the pads, relative to their frequencies.

With a larger one, stresses that the drift resembles would count as not measured.
"""

PAD_QUANTITIES = ("rest_frequency", "noise", "modulus", "gain", "beta")
"""Names of the attributes of a calibration that have one value per pad: frequency without load,
noise, modulus of the foam, gain, and beta (ratio of parasitic to active capacitance)."""


EFFECTS: dict[str, type[EffectModel]] = {
    model.key: model for model in (TemperatureModel, WeightModel, CreepModel, ThermalModel)
}
"""Classes of the models of effects that are no load, by the name of the attribute of a calibration
that holds the model."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Properties of one cube, or of all cubes of a kind.

    For an attribute of shape (P,), a single number may be given; it then holds for all P pads.

    Attributes:
        layout: Layout of the pads.
        rest_frequency: Frequency without load (P,), in Hz, at the reference temperature of the
            model `temperature`.
        noise: Standard deviation of a pad's stress (P,), in Pa.
        modulus: Modulus E of a pad's foam (P,), in Pa.
        half_side: Half side d0 of the cube, in m.
        symmetry: Name of the symmetry group that the coefficients respect.
        coefficients: Values of the K coefficients of the response matrix by name, in Pa per Pa, see
            `symmetry.Structure`.
        matrix: Response matrix (P, M) from modes to pads without gains, in Pa per Pa. Exactly one
            of `coefficients` and `matrix` is given.
        gain: Sensitivity of a pad relative to the symmetric response (P,), 1 on average.
        beta: Ratio of the parasitic to the active capacitance of a pad without load (P,).
        covariance: Covariance (K, K) of the coefficients, if it is known.
        temperature: Model of the rest frequency over temperature, if it is known.
        weight: Response of the pads to weight and inertia, if it is known.
        creep: Creep of the elastomer at each pad, if it is known.
        thermal: Reading of each pad over temperature without load, if it is known.
        drift: Standard deviation of the drift that the frequencies of all pads have in common since
            the last tare, divided by the frequency. If it is given, dummy pads measure this drift,
            and it is a part of the stated errors. None: drift is not taken into account.
        neglect: Names of modes whose amplitude is assumed to be zero. The pads then determine more
            of the other modes.
        uid: Unique id of the cube. None means that the calibration holds for any cube.
        created: Time of creation, ISO 8601.
        source: Origin of the values, such as a file or "illustrative".

    Raises:
        CalibrationError: A value is invalid; the message names it.
    """

    layout: Layout
    rest_frequency: Array
    noise: Array
    modulus: Array
    half_side: float
    symmetry: str = "full"
    coefficients: Mapping[str, float] | None = None
    matrix: Array | None = None
    gain: Array = field(default_factory=lambda: np.array(1.0))
    beta: Array = field(default_factory=lambda: np.array(0.0))
    covariance: Array | None = None
    temperature: TemperatureModel | None = None
    weight: WeightModel | None = None
    creep: CreepModel | None = None
    thermal: ThermalModel | None = None
    drift: float | None = None
    neglect: tuple[str, ...] = ()
    uid: int | None = None
    created: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        for name in PAD_QUANTITIES:
            self._set(name, self._read_pad_quantity(name))
        self._set("half_side", _read_number(self.half_side, "half_side"))
        if self.half_side <= 0:
            raise CalibrationError(f"half_side is {self.half_side} m; it must be above 0")
        if self.drift is not None:
            self._set("drift", _read_number(self.drift, "drift"))
            if not 0 < self.drift <= MAX_DRIFT:
                raise CalibrationError(
                    f"drift is {self.drift}; it must be above 0 and at most {MAX_DRIFT}"
                )
        try:
            structure = self.structure
            self.modes.find_indices(self.neglect)
        except (LayoutError, SymmetryError) as error:
            raise CalibrationError(f"calibration: {error}") from error
        self._set("neglect", tuple(self.neglect))
        self._read_response(structure)
        self._check_effects()
        self._check_uid()

    def __repr__(self) -> str:
        owner = "any cube" if self.uid is None else f"cube {self.uid:#018x}"
        source = self.source or "unknown source"
        return f"Calibration({self.id}, layout {self.layout.name!r}, {owner}, {source})"

    def _set(self, name: str, value: object) -> None:
        """Replace the attribute with this name by its checked value.

        A frozen dataclass refuses an ordinary assignment.
        """
        object.__setattr__(self, name, value)

    def _read_pad_quantity(self, name: str) -> Array:
        """Return an attribute of `PAD_QUANTITIES` as a read-only array (P,).

        Raises:
            CalibrationError: The shape is wrong, or a value is negative, or it is 0 and not a beta.
        """
        n_pads = self.layout.n_pads
        array = read_numbers(getattr(self, name), name, CalibrationError)
        if array.shape not in ((), (n_pads,)):
            raise CalibrationError(
                f"{name} has shape {array.shape}; layout {self.layout.name!r} has {n_pads} pads: "
                f"give one number or {n_pads}"
            )
        # A pad may have no parasitic capacitance (beta = 0). All other quantities must be positive.
        lowest = array.min()
        may_be_zero = name == "beta"
        if lowest < 0 or (lowest == 0 and not may_be_zero):
            limit = "at least" if may_be_zero else "above"
            raise CalibrationError(f"{name} holds {lowest:g}; it must be {limit} 0")
        per_pad: Array = np.broadcast_to(array, (n_pads,)).copy()
        per_pad.flags.writeable = False
        return per_pad

    def _read_response(self, structure: Structure) -> None:
        """Check coefficients, matrix and covariance, and store them as read-only values.

        Args:
            structure: Structure of the response, which states names and shapes.

        Raises:
            CalibrationError: Names or shapes differ from those of the structure.
        """
        if (self.coefficients is None) == (self.matrix is None):
            found = "neither" if self.matrix is None else "both"
            raise CalibrationError(
                f"a calibration holds either coefficients or a matrix; found {found}"
            )
        if self.coefficients is not None:
            coefficients = _read_coefficients(self.coefficients)
            compute_response(structure, coefficients)  # raises an error if they do not fit
            ordered = {name: coefficients[name] for name in structure.names}
            self._set("coefficients", ordered)
        else:
            shape = (self.layout.n_pads, structure.modes.n_modes)
            self._set(
                "matrix",
                read_numbers(
                    self.matrix,
                    "matrix",
                    CalibrationError,
                    shape,
                ),
            )
        if self.covariance is not None:
            square = (structure.n_coefficients, structure.n_coefficients)
            covariance = read_numbers(
                self.covariance,
                "covariance",
                CalibrationError,
                square,
            )
            self._set("covariance", covariance)

    def _check_effects(self) -> None:
        """Raise CalibrationError unless each effect has values for every pad."""
        for key in EFFECTS:
            model: EffectModel | None = getattr(self, key)
            if model is not None and model.n_pads != self.layout.n_pads:
                raise CalibrationError(
                    f"{key} has values of {model.n_pads} pads; "
                    f"layout {self.layout.name!r} has {self.layout.n_pads} pads"
                )

    def _check_uid(self) -> None:
        """Raise CalibrationError if the unique id is neither None nor a whole number of 8 bytes."""
        if self.uid is None:
            return
        # True and False are integers in Python, but never an id.
        is_integer = isinstance(self.uid, int) and not isinstance(self.uid, bool)
        if not is_integer or not 0 <= self.uid <= MAX_UID:
            raise CalibrationError(
                f"uid is {self.uid!r}; it must be a whole number from 0 to 2^64 - 1"
            )

    @property
    def modes(self) -> Modes:
        """The M modes (linear stress fields). The response matrix (P, M) turns their amplitudes
        into the stresses on the P pads of this pad layout."""
        return choose_default_modes(self.layout)

    @property
    def structure(self) -> Structure:
        """Structure (names of coefficients, basis matrices) of the responses that the symmetry
        allows."""
        return find_structure(self.layout, self.symmetry)

    @cached_property
    def response(self) -> Array:
        """Response matrix (P, M) including the gains, in Pa per Pa.

        The stresses on the pads are response @ amplitudes of the modes.
        """
        if self.coefficients is not None:
            matrix = compute_response(self.structure, self.coefficients)
        else:
            matrix = np.asarray(self.matrix)
        result: Array = self.gain[:, None] * matrix
        result.flags.writeable = False
        return result

    @property
    def drift_stress(self) -> Array:
        """Stress that one standard deviation of the common drift seems to cause (P,), in Pa."""
        stress: Array = (self.drift or 0.0) * self.modulus * (1 + self.beta)
        return stress

    @property
    def component_scale(self) -> Array:
        """Factors (15,) that take components with gradients times the half side, in Pa, to the
        published components, in Pa and Pa/m."""
        is_stress = np.arange(len(COMPONENTS)) < len(STRESS)
        return np.where(is_stress, 1.0, 1 / self.half_side)

    @cached_property
    def id(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 hash of the content in canonical JSON."""
        # Sorted keys and fixed separators give the same text, and so the same id, for the same
        # content on every machine.
        text = json.dumps(
            self._make_content(),
            sort_keys=True,
            separators=(",", ":"),
            allow_nan=False,
        )
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def check(
        self,
        layout: Layout | None = None,
        uid: int | None = None,
    ) -> None:
        """Check that the calibration belongs to a cube.

        Args:
            layout: Layout of the cube, if it is known.
            uid: Unique id of the cube, if it is known.

        Raises:
            CalibrationError: The calibration was made for another layout or another cube.
        """
        if layout is not None and not self.layout.has_same_pads(layout):
            raise CalibrationError(
                f"calibration {self.id} is for layout {self.layout.name!r} "
                f"({self.layout.n_pads} pads), the cube has layout {layout.name!r} "
                f"({layout.n_pads} pads); use a calibration made for that layout"
            )
        if uid is not None and self.uid is not None and uid != self.uid:
            raise CalibrationError(
                f"calibration {self.id} is for the cube with uid {self.uid:#018x}, this one has "
                f"{uid:#018x}; use the calibration of this cube"
            )

    def to_dict(self) -> dict[str, object]:
        """Return the calibration in types that JSON has, the id first; `from_dict` reads them."""
        return {"id": self.id, **self._make_content()}

    def _make_content(self) -> dict[str, object]:
        """Return all attributes that have a value, in types that JSON has, without the id."""
        built_in = LAYOUTS.get(self.layout.name)
        is_built_in = built_in is not None and built_in.has_same_pads(self.layout)
        # The name of a built-in layout is enough to find its pads, and keeps files short.
        content: dict[str, object] = {
            "schema": SCHEMA,
            "layout": self.layout.name if is_built_in else self.layout.to_dict(),
            "symmetry": self.symmetry,
        }
        for item in fields(self):
            value = getattr(self, item.name)
            is_given = value is not None and not (item.name == "neglect" and not value)
            if is_given and item.name not in content:
                content[item.name] = _to_plain(value, item.name in PAD_QUANTITIES)
        return content

    @classmethod
    def from_dict(cls, data: object) -> Calibration:
        """Construct a calibration from types that JSON has, as a file holds them.

        If the data have an id, it must be the hash of the content. Data without an id are accepted,
        so that a person can write a calibration.

        Raises:
            CalibrationError: A key, type, shape or the id is wrong; the message names it.
        """
        if not isinstance(data, Mapping):
            raise CalibrationError(f"a calibration is a table; found {data!r}")
        attributes = {item.name for item in fields(cls)}
        _check_keys(data, attributes)
        values = {key: data[key] for key in attributes & set(data)}
        layout = values["layout"]
        neglect = values.get("neglect", ())
        try:
            if isinstance(layout, Mapping):
                values["layout"] = Layout.from_dict(layout)
            else:
                values["layout"] = find_layout(layout)
        except LayoutError as error:
            raise CalibrationError(f"calibration: {error}") from error
        if isinstance(neglect, str) or not isinstance(neglect, Sequence):
            raise CalibrationError(
                f"calibration: neglect is {neglect!r}; it must be a list of names of modes"
            )
        values["neglect"] = tuple(neglect)
        for key, model in EFFECTS.items():
            if values.get(key) is not None:
                values[key] = model.from_dict(values[key])
        for key in ("symmetry", "created", "source"):
            if not isinstance(values.get(key, ""), str):
                raise CalibrationError(f"calibration: {key} is {values[key]!r}; it must be text")

        calibration = cls(**values)
        # The id is computed from the checked values (floats), so that a file with 1 instead of 1.0
        # has the same id.
        if data.get("id", calibration.id) != calibration.id:
            raise CalibrationError(
                f"calibration: the id says {data['id']!r} but the content gives "
                f"{calibration.id!r}: it was edited by hand or damaged. Restore the file, or "
                "remove the id to accept it"
            )
        return calibration


def tabulate_pads(
    calibrations: Sequence[Calibration],
    name: str,
    n_pads: int,
    fill: float,
) -> Array:
    """Return a quantity of the pads of several cubes as a table (cubes, n_pads).

    Args:
        calibrations: Calibration of each cube.
        name: Name of the quantity, one of `PAD_QUANTITIES`.
        n_pads: Number of columns, the largest number of pads of a cube.
        fill: Value of the entries for pads that a cube does not have.
    """
    values = [getattr(calibration, name) for calibration in calibrations]
    return stack_pad_table(values, n_pads, fill)


def make_illustrative_calibration(
    layout_name: str,
    neglect: Sequence[str] = (),
    uid: int | None = None,
) -> Calibration:
    """Return the illustrative calibration of a built-in layout.

    It is for demonstrations: its values are plausible, but no cube was measured for them.

    Args:
        layout_name: Name of the layout: quad, planar or cube.
        neglect: Names of modes (linear stress fields) whose amplitude is assumed to be zero.
        uid: Unique id of the cube; None means any cube.
    """
    layout = find_layout(layout_name)
    symmetry = find_largest_symmetry(layout)
    structure = find_structure(layout, symmetry)
    return Calibration(
        layout=layout,
        symmetry=symmetry,
        neglect=tuple(neglect),
        uid=uid,
        half_side=HALF_SIDE,
        coefficients=choose_illustrative_coefficients(structure),
        rest_frequency=np.array(REST_FREQUENCY),
        beta=np.array(BETA),
        modulus=np.array(FOAM_MODULUS),
        # Noise of the stress v is noise of the frequency f times the slope dv/df = E (1 + beta) /
        # f0 of the pad law (v as a function of f) without load.
        noise=np.array(FOAM_MODULUS * (1 + BETA) * FREQUENCY_NOISE),
        source="illustrative",
    )


def _check_keys(
    data: Mapping[str, object],
    attributes: set[str],
) -> None:
    """Raise CalibrationError if keys are missing or unknown, or the schema is not `SCHEMA`.

    Args:
        data: Calibration as a file holds it.
        attributes: Names of the attributes of `Calibration`.
    """
    allowed = attributes | {"id", "schema"}
    required = {"layout", "rest_frequency", "noise", "modulus", "half_side", "schema"}
    unknown = set(data) - allowed
    missing = required - set(data)
    if unknown or missing:
        raise CalibrationError(
            f"calibration: unknown keys {sorted(map(str, unknown))}, missing keys "
            f"{sorted(missing)}; allowed are {', '.join(sorted(allowed))}"
        )
    if data["schema"] != SCHEMA:
        raise CalibrationError(
            f"calibration: schema {data['schema']!r}; this version reads schema {SCHEMA}"
        )


def _to_plain(value: object, is_per_pad: bool) -> object:
    """Return the value of an attribute in types that JSON has.

    Args:
        value: The value.
        is_per_pad: Whether it is an array with one value per pad; equal values become one number.
    """
    if isinstance(value, np.ndarray):
        has_one_value = is_per_pad and not np.ptp(value)
        return float(value[0]) if has_one_value else value.tolist()
    if isinstance(value, EffectModel):
        return value.to_dict()
    if isinstance(value, tuple):
        return list(value)
    return dict(value) if isinstance(value, Mapping) else value


def _read_number(value: object, name: str) -> float:
    """Return a value of a file as a float; `name` stands for it in the error message.

    Raises:
        CalibrationError: The value is no finite number.
    """
    return float(read_numbers(value, name, CalibrationError, ()))


def _read_coefficients(value: object) -> dict[str, float]:
    """Return the coefficients of a file as floats, by name.

    Raises:
        CalibrationError: The value is no table, or an entry is no number.
    """
    if not isinstance(value, Mapping):
        raise CalibrationError(
            f"coefficients is {value!r}; it must be a table of names and numbers"
        )
    return {name: _read_number(item, f"coefficient {name!r}") for name, item in value.items()}
