# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""All errors of the package. Each message names the value found, the limit and the fix."""


class CubeError(Exception):
    """Base class of every error that the package raises on purpose."""


class LayoutError(CubeError):
    """A layout has impossible pads, or an array does not have the shape that a layout needs."""


class SymmetryError(CubeError):
    """A symmetry group is unknown, or it does not map the pads of a layout onto each other, or the
    modes (linear stress fields) onto combinations of each other."""


class CalibrationError(CubeError):
    """A calibration is malformed, was edited by hand, or belongs to another cube or layout."""


class FitError(CubeError):
    """No calibration can be fitted to the given loads or measurements."""


class ProtocolError(CubeError):
    """A field or an array of a frame is outside the range that the protocol can carry."""


class LinkError(CubeError):
    """A link cannot be opened, or it was lost.

    Attributes:
        kind: One word by which a program distinguishes the causes. The text of the error tells a
            person how to fix it.
    """

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message)
        self.kind = kind


class ElasticError(CubeError):
    """An elastic body, a mesh or a contact load is outside the range of the elasticity code."""


class ConfigError(CubeError):
    """A configuration file or a parameter is invalid.

    The message names the file, the key, the value found and the allowed values.
    """


class MessageError(CubeError):
    """The fields of a message contradict each other."""


class BagError(CubeError):
    """A bag cannot be read or written, or it lacks the data that a command needs."""


class TareError(CubeError):
    """A tare (taking the present frequencies as those without load) is refused.

    The signal of a pad moves, is noisy, or is too far from the calibration.
    """
