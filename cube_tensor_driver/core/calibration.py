"""Calibration: what turns a cube's frequencies into stress, as one frozen value with an id."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from .defaults import BETA, FOAM_MODULUS, FREQUENCY_NOISE, HALF_SIDE, REST_FREQUENCY
from .errors import CalibrationError, LayoutError, SymmetryError
from .layout import LAYOUTS, Layout, find_layout
from .modes import Modes
from .oscillator import TemperatureModel
from .response import illustrative_coefficients, response
from .symmetry import Structure, default_modes, find_structure

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is known about one cube, or about all cubes of a kind.

    layout: its pads
    symmetry: the group that its coefficients respect
    coefficients: {name: value} in Pa per Pa, see symmetry.Structure; or instead
    matrix: (P, M) the whole response before gains; exactly one of the two is given
    gain: (P,) sensitivity of a pad relative to the symmetric response, 1 on average
    beta: (P,) parasitic over active capacitance at rest
    modulus: (P,) E in Pa
    rest_frequency: (P,) Hz without load, at the reference of the temperature model
    noise: (P,) standard deviation of a pad's stress, Pa
    half_side: d0, m
    covariance: (K, K) of the coefficients, if known
    temperature: model of f0(T), if known
    neglect: names of modes stated to be zero, so that fewer pads can recover the others
    uid: of the cube; None: it holds for any cube
    created: ISO 8601 time
    source: what it was made from
    One number may be given for a (P,) field. CalibrationError says what is wrong.
    """

    layout: Layout
    rest_frequency: np.ndarray
    noise: np.ndarray
    modulus: np.ndarray
    half_side: float
    symmetry: str = "full"
    coefficients: Mapping[str, float] | None = None
    matrix: np.ndarray | None = None
    gain: np.ndarray = field(default_factory=lambda: np.array(1.0))
    beta: np.ndarray = field(default_factory=lambda: np.array(0.0))
    covariance: np.ndarray | None = None
    temperature: TemperatureModel | None = None
    neglect: tuple[str, ...] = ()
    uid: int | None = None
    created: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        for name in _PER_PAD:
            put(name, self._per_pad(name))
        put("half_side", _number(self.half_side, "half_side"))
        if self.half_side <= 0:
            raise CalibrationError(f"half_side is {self.half_side} m; it must be above 0")
        try:
            modes, structure = self.modes, self.structure
            modes.index(self.neglect)
        except (LayoutError, SymmetryError) as error:
            raise CalibrationError(f"calibration: {error}") from error
        put("neglect", tuple(self.neglect))
        if (self.coefficients is None) == (self.matrix is None):
            raise CalibrationError(
                "a calibration holds either coefficients or a matrix; found "
                f"{'neither' if self.matrix is None else 'both'}"
            )
        if self.coefficients is not None:
            response(structure, _coefficients(self.coefficients))  # raises when it does not fit
            put("coefficients", {name: float(self.coefficients[name]) for name in structure.names})
        else:
            put("matrix", _array(self.matrix, (self.layout.n_pads, modes.n_modes), "matrix"))
        if self.covariance is not None:
            k = structure.n_coefficients
            put("covariance", _array(self.covariance, (k, k), "covariance"))
        if (
            self.temperature is not None
            and len(self.temperature.coefficients) != self.layout.n_pads
        ):
            raise CalibrationError(
                f"temperature has {len(self.temperature.coefficients)} lists of coefficients; "
                f"layout {self.layout.name!r} has {self.layout.n_pads} pads"
            )
        if self.uid is not None and (
            isinstance(self.uid, bool) or not isinstance(self.uid, int) or not 0 <= self.uid < 2**64
        ):
            raise CalibrationError(
                f"uid is {self.uid!r}; it must be a whole number from 0 to 2^64 - 1"
            )

    def _per_pad(self, name: str) -> np.ndarray:
        n, value = self.layout.n_pads, getattr(self, name)
        array = _array(value, None, name)
        if array.shape not in ((), (n,)):
            raise CalibrationError(
                f"{name} has shape {array.shape}; layout {self.layout.name!r} has {n} pads: "
                f"give one number or {n}"
            )
        low = 0.0 if name == "beta" else np.nextafter(0, 1)
        if np.any(array < low):
            raise CalibrationError(
                f"{name} holds {array.min():g}; it must be {'at least' if low == 0 else 'above'} 0"
            )
        array = np.broadcast_to(array, (n,)).copy()
        array.flags.writeable = False
        return array

    @property
    def modes(self) -> Modes:
        return default_modes(self.layout)

    @property
    def structure(self) -> Structure:
        return find_structure(self.layout, self.symmetry)

    @cached_property
    def response(self) -> np.ndarray:
        """(P, M) Pa per Pa with the gains in: measured pad stresses are response @ state."""
        a = (
            self.matrix
            if self.coefficients is None
            else response(self.structure, self.coefficients)
        )
        result = self.gain[:, None] * a
        result.flags.writeable = False
        return result

    @cached_property
    def id(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of the content in canonical JSON."""
        text = json.dumps(self._content(), sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def check(self, layout: Layout | None = None, uid: int | None = None) -> None:
        """Raises CalibrationError when this was made for another layout or another cube."""
        if layout is not None and not self.layout.same_as(layout):
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

    def to_dict(self) -> dict[str, Any]:
        """Plain types, the id first; from_dict gives the same calibration back."""
        return {"id": self.id, **self._content()}

    def _content(self) -> dict[str, Any]:
        known = LAYOUTS.get(self.layout.name)
        is_built_in = known is not None and known.same_as(self.layout)
        content: dict[str, Any] = {
            "schema": SCHEMA,
            "layout": self.layout.name if is_built_in else self.layout.to_dict(),
            "symmetry": self.symmetry,
        }
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in content or value is None or (item.name == "neglect" and not value):
                continue
            if item.name in _PER_PAD:
                value = value.tolist() if np.ptp(value) else float(value[0])
            elif isinstance(value, np.ndarray):
                value = value.tolist()
            elif isinstance(value, TemperatureModel):
                value = value.to_dict()
            elif isinstance(value, tuple):
                value = list(value)
            content[item.name] = dict(value) if isinstance(value, Mapping) else value
        return content

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Calibration:
        """A calibration from plain types. CalibrationError names the wrong key, type, shape or id.

        An id must match the content. Without one the content is accepted as it is: a calibration
        that somebody begins by hand.
        """
        if not isinstance(data, Mapping):
            raise CalibrationError(f"a calibration is a table; found {data!r}")
        allowed = {item.name for item in fields(cls)}
        needed = {"layout", "rest_frequency", "noise", "modulus", "half_side", "schema"}
        unknown, missing = set(data) - allowed - {"id", "schema"}, needed - set(data)
        if unknown or missing:
            raise CalibrationError(
                f"calibration: unknown keys {sorted(map(str, unknown))}, missing keys "
                f"{sorted(missing)}; allowed are {', '.join(sorted(allowed | {'id', 'schema'}))}"
            )
        if data["schema"] != SCHEMA:
            raise CalibrationError(
                f"calibration: schema {data['schema']!r}; this version reads schema {SCHEMA}"
            )
        values = {key: value for key, value in data.items() if key in allowed}
        layout, neglect = values["layout"], values.get("neglect", ())
        model = values.get("temperature")
        is_table = isinstance(layout, Mapping)
        try:
            values["layout"] = Layout.from_dict(layout) if is_table else find_layout(layout)
        except LayoutError as error:
            raise CalibrationError(f"calibration: {error}") from error
        if isinstance(neglect, str) or not isinstance(neglect, Sequence):
            raise CalibrationError(
                f"calibration: neglect is {neglect!r}; it must be a list of names of modes"
            )
        values["neglect"] = tuple(neglect)
        values["temperature"] = None if model is None else TemperatureModel.from_dict(model)
        for key in ("symmetry", "created", "source"):
            if not isinstance(values.get(key, ""), str):
                raise CalibrationError(f"calibration: {key} is {values[key]!r}; it must be text")
        calibration = cls(**values)
        if "id" in data and data["id"] != calibration.id:
            raise CalibrationError(
                f"calibration: the id says {data['id']!r} but the content gives "
                f"{calibration.id!r}: it was edited by hand or damaged. Restore the file, or "
                "remove the id to accept it"
            )
        return calibration


_PER_PAD = ("rest_frequency", "noise", "modulus", "gain", "beta")


def illustrative(
    layout_name: str, neglect: Sequence[str] = (), uid: int | None = None
) -> Calibration:
    """The illustrative calibration of a built-in layout, for demonstrations: no cube was measured
    for it."""
    layout = find_layout(layout_name)
    symmetry = "slab" if layout_name == "quad" else "full"
    return Calibration(
        layout=layout,
        symmetry=symmetry,
        neglect=tuple(neglect),
        uid=uid,
        half_side=HALF_SIDE,
        coefficients=illustrative_coefficients(find_structure(layout, symmetry)),
        rest_frequency=np.array(REST_FREQUENCY),
        beta=np.array(BETA),
        modulus=np.array(FOAM_MODULUS),
        noise=np.array(FOAM_MODULUS * (1 + BETA) * FREQUENCY_NOISE),
        source="illustrative",
    )


def _number(value: Any, name: str) -> float:
    return float(_array(value, (), name))


def _coefficients(value: Any) -> Mapping[str, float]:
    if not isinstance(value, Mapping):
        raise CalibrationError(
            f"coefficients is {value!r}; it must be a table of names and numbers"
        )
    return {name: _number(item, f"coefficient {name!r}") for name, item in value.items()}


def _array(value: Any, shape: tuple[int, ...] | None, name: str) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        # numpy would make numbers of some of these.
        items = np.asarray(value, dtype=object).ravel()
        if any(isinstance(item, (str, bool)) or item is None for item in items):
            raise CalibrationError(
                f"{name} is {value!r}; it must be numbers (write 2.0e-3 with its point)"
            )
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} is {value!r}; it must be numbers") from None
    if shape is not None and array.shape != shape:
        raise CalibrationError(f"{name} has shape {array.shape}; it must be {shape}")
    if not np.all(np.isfinite(array)):
        raise CalibrationError(f"{name} holds NaN or Inf; every value must be finite")
    array.flags.writeable = False
    return array
