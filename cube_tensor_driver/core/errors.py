"""All errors of the package. Each message names the value found, the limit and the fix."""


class CubeError(Exception):
    """Base of every error that the package raises on purpose."""


class LayoutError(CubeError):
    """A layout, or an array that should match one, has the wrong pads."""


class SymmetryError(CubeError):
    """A symmetry that is unknown, or that the layout or the modes do not have."""


class CalibrationError(CubeError):
    """A calibration that is malformed, edited by hand, or made for something else."""


class FitError(CubeError):
    """Loads or measurements from which no calibration can be fitted."""


class ProtocolError(CubeError):
    """A frame that cannot be put into bytes: a field or an array outside what the protocol
    carries."""


class LinkError(CubeError):
    """A link that cannot be opened or was lost; `kind` is one word for programs, the text names the
    fix."""

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message)
        self.kind = kind


class ElasticError(CubeError):
    """A body, mesh or contact load outside what the elasticity code can compute."""


class ConfigError(CubeError):
    """A configuration file or parameter that cannot be used: file, key, what was found, what is
    allowed."""


class MessageError(CubeError):
    """A message whose fields contradict each other."""


class BagError(CubeError):
    """A bag that cannot be read or written, or that lacks what a command needs."""


class TareError(CubeError):
    """Tare refused: which pad of which cube moves, is noisy, or is too far from its calibration."""
