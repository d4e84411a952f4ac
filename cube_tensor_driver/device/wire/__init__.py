"""The wire protocol: bytes to frames and frames to bytes. No I/O and no clock."""
