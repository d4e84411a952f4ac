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

TRACK_SIZE: int
"""Size of cube_track (native/cube_track.h), in bytes."""

def read_links(
    links: list[tuple[Decoder, int, int]],
    wake_fd: int,
    timeout_s: float,
    gather_s: float,
    expected: int,
    clock_ns: Callable[[], int],
) -> tuple[bool, list[int], list[bytes], list[int], list[tuple[int, int, int, list[bytes]]]]:
    """Wait for data of the links, read and decode them, and take usual samples.

    Meanwhile other threads run, and the decoders cannot be used for anything else.

    Args:
        links: Decoder, file descriptor (-1: closed) and address of the `LinkTrack` of each link.
        wake_fd: File descriptor whose bytes end the wait; they are discarded.
        timeout_s: Longest wait for data.
        gather_s: Longest wait, after the first frame, for frames of the other links.
        expected: Number of links with frames at which this wait ends.
        clock_ns: The clock of arrivals, read after the bytes of a link and before they are decoded.

    Returns:
        Whether data were there without waiting; index of the link, bytes (from type to CRC) and
        stamp of each usual sample; and index of the link, arrival time, number of bytes (0 at the
        end of the stream, or minus the errno of an error) and frames of each other read.
    """

def place_rows(
    samples: list[bytes],
    stamps_ns: list[int],
    n_rows: int,
    n_pads: int,
    addresses: tuple[int, ...],
) -> None:
    """Write the rows of decoded SAMPLEs into columns in memory.

    Values are NaN where they are unknown or a cube has no such pad.

    Args:
        samples: Bytes of the samples, from type to CRC.
        stamps_ns: Stamp of each sample.
        n_rows: Number of rows N, one for each cube of the samples.
        n_pads: Number of pads of the widest cube.
        addresses: Addresses of the contiguous columns stamp_ns (N,) int64, sequence (N,) uint32,
            pad_fault (N,) uint32, temperature (N,) float32 in °C and frequency (N, n_pads) float32
            in Hz.
    """
