"""The wire in C: native/python_wire.c. device/wire/native.py says whether it is there."""

from collections.abc import Callable

class Decoder:
    """Bytes in, frames out: cube_decoder of native/cube_wire.h."""

    def feed(self, data: bytes | bytearray) -> list[bytes]:
        """The frames that `data` completes, each from type to CRC; their lengths fit."""
    def reset(self) -> None: ...
    def counters(self) -> tuple[int, ...]:
        """In the order of decoder.Counters."""
    def other_version(self) -> int | None: ...

def cobs_encode(data: bytes | bytearray) -> bytes: ...
def cobs_decode(code: bytes | bytearray) -> bytes | None: ...
def read_links(
    links: list[tuple[Decoder, int]], clock_ns: Callable[[], int]
) -> tuple[int, list[tuple[int, list[bytes]]]]:
    """Read each file descriptor once, without blocking, and decode what came.

    The time after reading; and for each link how many bytes came, or minus the number of the error,
    and their frames. While it works, other threads run, and its decoders can do nothing else.
    """

def place_rows(samples: list[bytes], stamps_ns: list[int], n_pads: int, memory: bytearray) -> None:
    """Write the rows of decoded SAMPLEs, one after the other, as columns one behind the other.

    stamp_ns (N,) int64, sequence (N,) uint32, pad_fault (N,) uint32, temperature (N,) float32 in
    °C, frequency (N, n_pads) float32 in Hz; NaN where it is unknown or the cube has no such pad.
    memory: of exactly that size, N (20 + 4 n_pads) bytes.
    """
