"""Hubs on the wire: protocol, links, the reader thread, device time. Bytes in, frames and host times out."""
