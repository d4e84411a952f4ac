"""The wire protocol in C (native/python_wire.c); device/wire/native.py tells whether it exists."""

from collections.abc import Callable

class Decoder:
    """Decodes the bytes of one link: cube_decoder of native/cube_wire.h."""

    def feed(self, data: bytes | bytearray) -> list[bytes]:
        """Return the frames that `data` completes, each from type to CRC, with valid lengths."""
    def reset(self) -> None:
        """Discard an unfinished frame, because the stream ended."""
    def counters(self) -> tuple[int, ...]:
        """Return the counters in the order of `decoder.Counters`."""
    def other_version(self) -> int | None:
        """Return the protocol version of the last valid frame of another version, if any."""

def cobs_encode(data: bytes | bytearray) -> bytes:
    """Return the COBS encoding of any bytes."""

def cobs_decode(code: bytes | bytearray) -> bytes | None:
    """Return the bytes that a COBS encoding stands for; None if it is not valid."""

def read_links(
    links: list[tuple[Decoder, int]], clock_ns: Callable[[], int]
) -> tuple[int, list[tuple[int, list[bytes]]]]:
    """Read each file descriptor once, without blocking, and decode the bytes.

    Meanwhile other threads run, and the decoders cannot be used for anything else.

    Args:
        links: Decoder and file descriptor of each link.
        clock_ns: The clock of arrivals.

    Returns:
        The time after reading; and for each link the number of bytes, or minus the errno of the
        error, and the frames that the bytes complete.
    """

def place_rows(samples: list[bytes], stamps_ns: list[int], n_pads: int, memory: bytearray) -> None:
    """Write the rows of decoded SAMPLEs as columns, one after the other.

    The columns are stamp_ns (N,) int64, sequence (N,) uint32, pad_fault (N,) uint32, temperature
    (N,) float32 in °C and frequency (N, n_pads) float32 in Hz. Values are NaN where they are
    unknown or a cube has no such pad.

    Args:
        samples: Bytes of the samples, from type to CRC.
        stamps_ns: Stamp of each sample.
        n_pads: Number of pads of the widest cube.
        memory: Memory of the columns, N (20 + 4 n_pads) bytes.
    """
