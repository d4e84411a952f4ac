"""Does a hub keep docs/protocol.md? A conversation with it, and one function for each rule that
judges what was said.

    wire ── bytes ── Ear ── frames ── Conversation ── Transcript ── rules ── verdicts

Only `PortWire` has I/O and a clock. What is shown of the verdicts is the terminal's.
"""
