"""For people who build hubs: does a hub keep docs/protocol.md, and hubs in C as examples.

    wire ── bytes ── decoder ── frames ── Conversation ── Transcript ── rules ── results

Only `PortWire` has I/O and a clock. ROS is not imported.
"""
